// Layers in files, as `ngpt unpack` and export/vector have them, and images as portable float maps.
#pragma once

#include <algorithm>
#include <fstream>
#include <iterator>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

class Folder {
public:
    int height = 0, width = 0;  // of "primal", and so of all layers

    explicit Folder(const std::string &path) : path_(path), listing_(bytes("layers.json")) {
        std::string shape = listing_.substr(listing_.find('[', listing_.find("\"primal\"")) + 1);
        std::replace(shape.begin(), shape.end(), ',', ' ');
        int one = 0, channels = 0;
        std::istringstream(shape) >> one >> channels >> height >> width;
        if (!has("primal") || one != 1 || channels != 3 || std::min(height, width) < 1)
            throw std::runtime_error(path + "/layers.json: the shape of primal must be [1, 3, height, width]");
    }
    bool has(const std::string &name) const { return listing_.find("\"" + name + "\"") != std::string::npos; }

    // The layer of that name, channel by channel, row by row.
    std::vector<float> layer(const std::string &name, int channels) const {
        std::vector<float> pixels(size_t(channels) * height * width);
        const std::string data = bytes(name + ".f32");
        if (data.size() != pixels.size() * sizeof(float))
            throw std::runtime_error(path_ + "/" + name + ".f32: is not of the size of primal");
        std::copy(data.begin(), data.end(), reinterpret_cast<char *>(pixels.data()));
        return pixels;
    }

private:
    std::string path_, listing_;

    std::string bytes(const std::string &name) const {
        std::ifstream file(path_ + "/" + name, std::ios::binary);
        if (!file) throw std::runtime_error(path_ + "/" + name + ": cannot be read");
        return {std::istreambuf_iterator<char>(file), {}};
    }
};

// A portable float map of pixels of three floats: the last row first, little-endian.
inline void write_pfm(const std::string &path, const std::vector<float> &image, int width, int height) {
    std::ofstream file(path, std::ios::binary);
    file << "PF\n" << width << " " << height << "\n-1.0\n";
    for (int y = height - 1; y >= 0; y--)
        file.write(reinterpret_cast<const char *>(&image[size_t(3) * y * width]), size_t(12) * width);
    if (!file.flush()) throw std::runtime_error(path + ": cannot be written");
}
