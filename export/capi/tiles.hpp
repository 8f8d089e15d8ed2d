// How an image is cut for a network; the same tiles as in ngpt/network/tiles.py.
#pragma once

#include "layers.hpp"

namespace ngpt {

// What a tile is for, and what it sees.
struct Tile {
    Window inner, outer;
};

// A way to cut a side: pieces of one size, which is why the last ones begin earlier, at multiples of the alignment.
struct Cut {
    int64_t step, size, count;
};

// Tiles of an image, row by row; made one by one, since a large image may have millions of them.
struct Tiles {
    int64_t width, height, overlap;
    Cut rows, columns;

    int64_t count() const { return rows.count * columns.count; }
    int64_t area() const { return rows.size * columns.size; }
    Tile tile(int64_t index) const;
};

// The least work with at most `most` pixels in a tile; without such tiles, the smallest.
Tiles cut(int64_t width, int64_t height, int64_t alignment, int64_t overlap, int64_t most);

}  // namespace ngpt
