// Images in the memory of others: any strides, float or half.
#pragma once

#include "ngpt.h"

#include <cstdint>
#include <vector>

namespace ngpt {

// Pixels that are not ours; strides in bytes, 0 for those without gaps.
struct View {
    void *pixels;
    int format;  // of ngpt_format
    int channels;
    ptrdiff_t channel_stride, pixel_stride, row_stride;
};

// Where a part of an image is, and how large it is.
struct Window {
    int64_t top, left, height, width;
    int64_t area() const { return height * width; }
};

// Whether all its pixels have an address. Strides that lead beyond are the caller's error, and would overflow.
bool addressable(const View &view, int64_t width, int64_t height, int channels);

// The first `channels` of a window, out of an image `width` wide, channel by channel, row by row.
void read(const View &view, int64_t width, const Window &window, int channels, float *planes);

// The reverse, for a whole image of three channels.
void write(const View &view, int64_t width, int64_t height, const float *planes);

}  // namespace ngpt
