#include "memory.hpp"

#include <algorithm>
#include <fstream>
#include <limits>
#include <sstream>
#include <string>

#ifdef _WIN32
#define NOMINMAX
#include <windows.h>
#elif !defined(__linux__)
#include <unistd.h>
#endif

namespace ngpt {
namespace {

constexpr uint64_t NO_LIMIT = std::numeric_limits<uint64_t>::max();

#ifdef __linux__
// The number after a word in a file, the first one without a word; `otherwise` if there is none.
uint64_t number_in(const std::string &path, const std::string &word, uint64_t otherwise) {
    std::ifstream file(path);
    uint64_t number;
    for (std::string found; word.empty() || file >> found;)
        if (found == word) return file >> number ? number : otherwise;
    return otherwise;
}

// Limits of the process' group and of all that it is in. Pages of files do not count: the system takes those back.
uint64_t left_in_groups() {
    uint64_t left = NO_LIMIT;
    std::ifstream groups("/proc/self/cgroup");
    for (std::string line; std::getline(groups, line);) {
        const bool second = !line.compare(0, 3, "0::");
        const size_t path = line.find('/');
        if (path == std::string::npos || (!second && line.find(":memory:") == std::string::npos)) continue;
        std::string group = line.substr(path);
        while (true) {
            const std::string folder = (second ? "/sys/fs/cgroup" : "/sys/fs/cgroup/memory") + group;
            const uint64_t most = number_in(folder + (second ? "/memory.max" : "/memory.limit_in_bytes"), "", NO_LIMIT);
            const uint64_t used = number_in(folder + "/memory.stat", second ? "anon" : "total_rss", 0);
            left = std::min(left, most - std::min(most, used));
            if (group.size() <= 1) break;
            group.resize(std::max<size_t>(group.rfind('/'), 1));
        }
    }
    return left;
}
#endif

}  // namespace

uint64_t memory_left() {
#ifdef _WIN32
    MEMORYSTATUSEX status;
    status.dwLength = sizeof status;
    return GlobalMemoryStatusEx(&status) ? status.ullAvailPageFile : NO_LIMIT;
#elif defined(__linux__)
    const uint64_t available = number_in("/proc/meminfo", "MemAvailable:", NO_LIMIT >> 10);
    const uint64_t swap = number_in("/proc/meminfo", "SwapFree:", 0);
    return std::min(available + swap < NO_LIMIT >> 10 ? (available + swap) << 10 : NO_LIMIT, left_in_groups());
#else
    const long pages = sysconf(_SC_PHYS_PAGES), size = sysconf(_SC_PAGE_SIZE);
    return pages > 0 && size > 0 ? uint64_t(pages) * uint64_t(size) : NO_LIMIT;
#endif
}

}  // namespace ngpt
