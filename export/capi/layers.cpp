#include "layers.hpp"

#include <cmath>
#include <cstring>

namespace ngpt {
namespace {

float from_half(uint16_t bits) {
    const int exponent = bits >> 10 & 31, fraction = bits & 1023;
    const float magnitude = exponent == 31  ? (fraction ? NAN : INFINITY)
                            : exponent == 0 ? std::ldexp(float(fraction), -24)
                                            : std::ldexp(float(fraction | 1024), exponent - 25);
    return bits >> 15 ? -magnitude : magnitude;
}

// To the nearest, to the even one if there are two.
uint16_t to_half(float value) {
    const uint16_t sign = std::signbit(value) ? 0x8000 : 0;
    const float magnitude = std::fabs(value);
    if (std::isnan(value)) return sign | 0x7e00;
    if (magnitude >= 65520) return sign | 0x7c00;
    int exponent = 0;
    std::frexp(magnitude, &exponent);  // magnitude in [2^(exponent - 1), 2^exponent)
    const int shift = exponent < -13 ? -24 : exponent - 11;
    const long steps = std::lrint(std::ldexp(magnitude, -shift));  // of 2^shift; 2048 at most, which carries over
    return uint16_t(sign + ((shift + 24) << 10) + steps);
}

template <typename Access> void each(const View &view, int64_t width, const Window &window, int channels, Access access) {
    const ptrdiff_t size = view.format == NGPT_HALF ? 2 : 4;
    const ptrdiff_t channel = view.channel_stride ? view.channel_stride : size;
    const ptrdiff_t pixel = view.pixel_stride ? view.pixel_stride : size * view.channels;
    const ptrdiff_t row = view.row_stride ? view.row_stride : pixel * width;
    for (int c = 0; c < channels; c++)
        for (int64_t y = 0; y < window.height; y++) {
            char *at = static_cast<char *>(view.pixels) + c * channel + (window.top + y) * row + window.left * pixel;
            for (int64_t x = 0; x < window.width; x++, at += pixel) access(at);
        }
}

}  // namespace

// Values may lie at odd addresses, which is why they are copied as bytes.
void read(const View &view, int64_t width, const Window &window, int channels, float *planes) {
    if (view.format == NGPT_HALF)
        each(view, width, window, channels, [&](const char *at) {
            uint16_t bits;
            std::memcpy(&bits, at, sizeof bits);
            *planes++ = from_half(bits);
        });
    else
        each(view, width, window, channels, [&](const char *at) { std::memcpy(planes++, at, sizeof *planes); });
}

void write(const View &view, int64_t width, int64_t height, const float *planes) {
    const Window all{0, 0, height, width};
    if (view.format == NGPT_HALF)
        each(view, width, all, 3, [&](char *at) {
            const uint16_t bits = to_half(*planes++);
            std::memcpy(at, &bits, sizeof bits);
        });
    else
        each(view, width, all, 3, [&](char *at) { std::memcpy(at, planes++, sizeof *planes); });
}

}  // namespace ngpt
