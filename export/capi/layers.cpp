#include "layers.hpp"

#include <array>
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

int size_of(const View &view) { return view.format == NGPT_HALF ? 2 : 4; }

// From a channel, pixel and row to the next, in a type that holds them.
template <typename Number> std::array<Number, 3> strides(const View &view, int64_t width) {
    const Number channel = view.channel_stride ? Number(view.channel_stride) : Number(size_of(view));
    const Number pixel = view.pixel_stride ? Number(view.pixel_stride) : Number(size_of(view)) * Number(view.channels);
    return {channel, pixel, view.row_stride ? Number(view.row_stride) : pixel * Number(width)};
}

template <typename Access>
void each(const View &view, int64_t width, const Window &window, int channels, Access access) {
    const auto [channel, pixel, row] = strides<ptrdiff_t>(view, width);
    for (int c = 0; c < channels; c++)
        for (int64_t y = 0; y < window.height; y++) {
            char *at = static_cast<char *>(view.pixels) + c * channel + (window.top + y) * row + window.left * pixel;
            // Not by steps: the one beyond the last pixel may be no address.
            for (int64_t x = 0; x < window.width; x++) access(at + x * pixel);
        }
}

}  // namespace

// In double, which has room for any product of strides and sizes.
bool addressable(const View &view, int64_t width, int64_t height, int channels) {
    const auto [channel, pixel, row] = strides<double>(view, width);
    double before = 0, behind = size_of(view);
    for (const double reach : {channel * double(channels - 1), pixel * double(width - 1), row * double(height - 1)})
        (reach < 0 ? before : behind) += std::abs(reach);
    const double first = double(reinterpret_cast<uintptr_t>(view.pixels)), last = double(PTRDIFF_MAX) / 2;
    return before + behind <= last && before <= first && first + behind <= double(UINTPTR_MAX);
}

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
