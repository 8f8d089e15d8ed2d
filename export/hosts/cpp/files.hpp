// Layers in files, as `ngpt unpack` and export/vector have them, and images as portable float maps.
#pragma once

#include "model.hpp"

#include <fstream>
#include <iterator>

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
    int64_t one, channels, height, width;
    if (!(numbers >> one >> channels >> height >> width) || one != 1 || std::min({channels, height, width}) < 1)
        throw std::runtime_error(folder + "/layers.json: the shape of " + name + " must be [1, C, height, width]");
    Layer layer(channels, height, width);
    const std::string path = folder + "/" + name + ".f32", data = slurp(path);
    if (data.size() != layer.pixels.size() * sizeof(float))
        throw std::runtime_error(path + ": has " + std::to_string(data.size()) + " bytes, not those of its shape");
    std::copy(data.begin(), data.end(), reinterpret_cast<char *>(layer.pixels.data()));
    return layer;
}

// All that the model reads, but for other denoisers' images; zeros for what the folder lacks and the model can miss.
inline Layers read_layers(const std::string &folder, const Model &model) {
    const std::string listing = slurp(folder + "/layers.json");
    Layers layers;
    for (const std::string &name : model.inputs) {
        if (name.rfind("denoised", 0) == 0) continue;
        if (listing.find("\"" + name + "\"") != std::string::npos) layers[name] = read_layer(folder, listing, name);
        else if (!model.may_lack(name)) throw std::runtime_error(folder + "/layers.json: the model needs \"" + name + "\"");
    }
    const int64_t height = layers.at("primal").height, width = layers.at("primal").width;
    for (const std::string &name : model.optional)
        if (!layers.count(name)) layers[name] = Layer(name == "depth" ? 1 : 3, height, width);
    for (auto &[name, layer] : layers)
        if (layer.height != height || layer.width != width) throw std::runtime_error(name + " is not of the size of primal");
    return layers;
}

// A portable float map: pixel by pixel, the last row first, little-endian.
inline void write_pfm(const std::string &path, Layer &image) {
    std::ofstream file(path, std::ios::binary);
    file << "PF\n" << image.width << " " << image.height << "\n-1.0\n";
    for (int64_t y = image.height - 1; y >= 0; y--)
        for (int64_t x = 0; x < image.width; x++)
            for (int64_t c = 0; c < 3; c++) file.write(reinterpret_cast<char *>(image.row(c, y) + x), sizeof(float));
    if (!file.flush()) throw std::runtime_error(path + ": cannot be written");
}
