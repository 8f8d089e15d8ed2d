// Messages: one line of valid UTF-8 without control characters, whatever a file or a caller has in its names.
#pragma once

#include <cstddef>
#include <string>

namespace ngpt {

// Words by single spaces; what is no printable UTF-8 becomes "?". At most `most` bytes, and no letter is cut.
std::string one_line(const std::string &text, size_t most = 400);

// Copies a line to where `size` bytes are, a final 0 among them, and cuts no letter. Does not throw.
void copy_line(const char *line, char *to, size_t size) noexcept;

}  // namespace ngpt
