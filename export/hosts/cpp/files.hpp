// Layers in files, as `ngpt unpack` and export/vector have them, and images as portable float maps.
#pragma once

#include "network.hpp"

#include <algorithm>
#include <fstream>
#include <iterator>
#include <map>
#include <sstream>

using Layers = std::map<std::string, Layer>;

inline std::string slurp(const std::string &path) {
    std::ifstream file(path, std::ios::binary);
    if (!file) throw std::runtime_error(path + ": cannot be read");
    return {std::istreambuf_iterator<char>(file), {}};
}

// The layer called `name`, float32 in the order (1, C, height, width), its shape taken from layers.json.
inline Layer read_layer(const std::string &folder, const std::string &listing, const std::string &name) {
    std::string shape = listing.substr(listing.find('[', listing.find("\"" + name + "\"")) + 1);
    shape = shape.substr(0, shape.find(']'));
    std::replace(shape.begin(), shape.end(), ',', ' ');
    std::istringstream numbers(shape);
    int one, channels, height, width;
    if (!(numbers >> one >> channels >> height >> width) || one != 1 || std::min({channels, height, width}) < 1)
        throw std::runtime_error(folder + "/layers.json: the shape of " + name + " must be [1, C, height, width]");
    Layer layer(channels, height, width);
    const std::string path = folder + "/" + name + ".f32", data = slurp(path);
    if (data.size() != layer.pixels.size() * sizeof(float))
        throw std::runtime_error(path + ": has " + std::to_string(data.size()) + " bytes, not those of its shape");
    std::copy(data.begin(), data.end(), reinterpret_cast<char *>(layer.pixels.data()));
    return layer;
}

// All that the network reads and the folder holds, but for other denoisers' images.
inline Layers read_layers(const std::string &folder, const Network &network) {
    const std::string listing = slurp(folder + "/layers.json");
    Layers layers;
    for (const std::string &name : network.inputs)
        if (name.rfind("denoised", 0) != 0 && listing.find("\"" + name + "\"") != std::string::npos)
            layers[name] = read_layer(folder, listing, name);
    for (const std::string &name : network.required)
        if (name.rfind("denoised", 0) != 0 && !layers.count(name))
            throw std::runtime_error(folder + "/layers.json: the model needs \"" + name + "\"");
    const Layer &primal = layers.at("primal");
    for (auto &[name, layer] : layers)
        if (layer.height != primal.height || layer.width != primal.width)
            throw std::runtime_error(name + " is not of the size of primal");
    return layers;
}

// A portable float map: pixel by pixel, the last row first, little-endian.
inline void write_pfm(const std::string &path, const Layer &image) {
    std::ofstream file(path, std::ios::binary);
    file << "PF\n" << image.width << " " << image.height << "\n-1.0\n";
    for (int y = image.height - 1; y >= 0; y--)
        for (int x = 0; x < image.width; x++)
            for (int c = 0; c < 3; c++) {
                const float *value = &image.pixels[c * image.plane() + ptrdiff_t(y) * image.width + x];
                file.write(reinterpret_cast<const char *>(value), sizeof *value);
            }
    if (!file.flush()) throw std::runtime_error(path + ": cannot be written");
}
