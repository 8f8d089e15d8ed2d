#include "text.hpp"

#include <cstring>

namespace ngpt {
namespace {

// Bytes of the letter that begins there, 0 for what is no letter: control characters, too, which steer terminals.
size_t letter(const std::string &text, size_t at) {
    const auto byte = [&](size_t i) { return at + i < text.size() ? static_cast<unsigned char>(text[at + i]) : 0u; };
    const unsigned first = byte(0);
    if (first < 0x80) return first >= 0x20 && first != 0x7f;
    if (first < 0xc2 || first > 0xf4) return 0;
    const size_t length = first < 0xe0 ? 2 : first < 0xf0 ? 3 : 4;
    unsigned code = first & (0xff >> (length + 1));
    for (size_t i = 1; i < length; i++) {
        if ((byte(i) & 0xc0) != 0x80) return 0;
        code = code << 6 | (byte(i) & 0x3f);
    }
    // The shortest form only, no surrogates, no control characters of Latin 1.
    const unsigned least[] = {0, 0, 0xa0, 0x800, 0x10000};
    return code < least[length] || code > 0x10ffff || (code >= 0xd800 && code < 0xe000) ? 0 : length;
}

}  // namespace

std::string one_line(const std::string &text, size_t most) {
    std::string line;
    bool space = false;
    for (size_t at = 0; at < text.size();) {
        if (std::strchr(" \t\n\r\f\v", text[at]) && text[at]) {
            space = !line.empty();
            at++;
            continue;
        }
        const size_t length = letter(text, at);
        if (line.size() + space + (length ? length : 1) > most) break;
        if (space) line += ' ';
        space = false;
        line += length ? text.substr(at, length) : "?";
        at += length ? length : 1;
    }
    return line;
}

void copy_line(const char *line, char *to, size_t size) noexcept {
    if (!to || !size) return;
    size_t length = std::strlen(line);
    if (length >= size) {
        length = size - 1;
        while (length && (static_cast<unsigned char>(line[length]) & 0xc0) == 0x80) length--;
    }
    std::memmove(to, line, length);
    to[length] = 0;
}

}  // namespace ngpt
