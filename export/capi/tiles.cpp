#include "tiles.hpp"

#include <algorithm>

namespace ngpt {
namespace {

// All ways, coarsest first.
std::vector<Cut> cuts(int64_t length, int64_t alignment, int64_t overlap) {
    std::vector<Cut> ways;
    for (int64_t pieces = 1; pieces <= std::max<int64_t>(1, length / alignment); pieces++) {
        const int64_t step = (length + pieces * alignment - 1) / (pieces * alignment) * alignment;
        const int64_t count = (length + step - 1) / step;
        // Two pieces have a neighbour on one side only.
        const int64_t beside = std::min<int64_t>(count - 1, 2) * overlap;
        const int64_t size = std::min(step + beside + length % alignment, length);
        if (ways.empty() || size < ways.back().size) ways.push_back({step, size, count});
    }
    return ways;
}

}  // namespace

Tile Tiles::tile(int64_t index) const {
    const int64_t y = index / columns.count * rows.step, x = index % columns.count * columns.step;
    const int64_t top = std::min(std::max<int64_t>(y - overlap, 0), height - rows.size);
    const int64_t left = std::min(std::max<int64_t>(x - overlap, 0), width - columns.size);
    return {{y, x, std::min(rows.step, height - y), std::min(columns.step, width - x)},
            {top, left, rows.size, columns.size}};
}

Tiles cut(int64_t width, int64_t height, int64_t alignment, int64_t overlap, int64_t most) {
    const std::vector<Cut> down = cuts(height, alignment, overlap), across = cuts(width, alignment, overlap);
    Tiles best{width, height, overlap, down.back(), across.back()};
    int64_t least = 0;
    for (const Cut &tall : down)
        for (const Cut &wide : across)
            if (tall.size * wide.size <= most) {
                const int64_t work = tall.count * wide.count * tall.size * wide.size;
                if (!least || work < least) best.rows = tall, best.columns = wide, least = work;
                break;
            }
    return best;
}

}  // namespace ngpt
