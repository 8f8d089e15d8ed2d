// Light that gradients hold nothing of: taken out of what a network with gradients is given, and spread over its
// neighbourhood to be added to what it gives, as ngpt/denoisers/caustic.py does. See export/CONTRACT.md.
#pragma once

#include "files.hpp"

#include <cmath>

// Albedo, normals and the logarithm of the depth: two pixels that differ by 1 in them exchange 1/e of their light.
inline Layer surfaces(const Layers &held, int height, int width) {
    Layer all(7, height, width);
    auto to = all.pixels.begin();
    for (const char *name : {"albedo", "normal", "depth"}) {
        const auto found = held.find(name);
        if (found != held.end()) {
            const auto &pixels = found->second.pixels;
            std::transform(pixels.begin(), pixels.end(), to, [](float x) { return std::isfinite(x) ? x : 0; });
        }
        if (to - all.pixels.begin() < 6 * all.plane()) to += 3 * all.plane();
    }
    const float farthest = *std::max_element(to, all.pixels.end());
    if (farthest > 0)
        std::transform(to, all.pixels.end(), to, [=](float z) { return std::log(std::max(z, 1e-6f * farthest)); });
    return all;
}

// `caustic`, spread: as much light, with less noise.
inline Layer spread(const Layers &held) {
    const Layer &caustic = held.at("caustic");
    const int height = caustic.height, width = caustic.width;
    const ptrdiff_t n = caustic.plane();
    const auto given = held.find("caustic_var");
    const Layer surface = surfaces(held, height, width);
    double scale = 0, floor = 1e-37;
    for (float x : caustic.pixels)
        if (std::isfinite(x)) scale = std::max(scale, double(std::abs(x)));
    Layer light(3, height, width), variance(1, height, width);
    for (ptrdiff_t i = 0; i < 3 * n && scale > 0; i++) {
        light.pixels[i] = std::isfinite(caustic.pixels[i]) ? caustic.pixels[i] / scale : 0;
        const double own = double(light.pixels[i]) * light.pixels[i];
        const bool known = given != held.end() && std::isfinite(given->second.pixels[i]);
        // What is not known of a variance is that of an estimate that is all noise.
        variance.pixels[i % n] += (known ? std::max(given->second.pixels[i] / scale / scale, 0.0) : own) / 3;
        floor += 1e-12 * own / (3 * n);
    }
    const struct {
        int down, right;
        double weight;
    } neighbours[] = {{0, 1, 1 / 8.}, {1, 0, 1 / 8.}, {1, 1, 1 / 16.}, {1, -1, 1 / 16.}};
    for (int distance : {1, 2, 4, 8, 16, 32, 1, 2}) {
        Layer next = light;
        std::vector<float> kept(n, 1), taken(n, 0);
        for (const auto &[down, right, weight] : neighbours) {
            const int dy = distance * down, dx = distance * right;
            for (int y = 0; y + dy < height; y++)
                for (int x = std::max(0, -dx); x < std::min(width, width - dx); x++) {
                    const ptrdiff_t here = ptrdiff_t(y) * width + x, there = here + ptrdiff_t(dy) * width + dx;
                    const double noise = double(variance.pixels[here]) + variance.pixels[there];
                    const auto square = [=](const Layer &layer) {
                        double sum = 0;
                        for (ptrdiff_t at = 0; at < layer.channels * n; at += n)
                            sum += std::pow(double(layer.pixels[at + there]) - layer.pixels[at + here], 2);
                        return sum;
                    };
                    const double beyond = std::max(square(light) / 3 - noise, 0.0) / (9 * noise + floor);
                    const double share = weight * std::exp(-beyond - square(surface));
                    for (ptrdiff_t at = 0; at < 3 * n; at += n) {
                        const double step = share * (double(light.pixels[at + there]) - light.pixels[at + here]);
                        next.pixels[at + here] += step;
                        next.pixels[at + there] -= step;
                    }
                    kept[here] -= share, kept[there] -= share;
                    taken[here] += share * share * variance.pixels[there];
                    taken[there] += share * share * variance.pixels[here];
                }
        }
        light = std::move(next);
        for (ptrdiff_t i = 0; i < n; i++) variance.pixels[i] = kept[i] * kept[i] * variance.pixels[i] + taken[i];
    }
    for (float &x : light.pixels) x *= scale;
    return light;
}

// If the folder holds such light, takes it out of `primal` for a network that reads gradients, and returns it and the
// features beside it. Any other network sees all light; its noise is that of both parts.
inline Layers take_out_caustic(const std::string &folder, const std::vector<std::string> &inputs, Layers &layers) {
    const std::string listing = slurp(folder + "/layers.json");
    const auto has = [&](const std::string &name) { return listing.find("\"" + name + "\"") != std::string::npos; };
    if (!has("caustic")) return {};
    Layers held;
    for (const char *name : {"caustic", "caustic_var", "albedo", "normal", "depth"})
        if (has(name)) held[name] = read_layer(folder, listing, name);
    Layer &caustic = held.at("caustic"), &primal = layers.at("primal");
    if (caustic.pixels.size() != primal.pixels.size()) throw std::runtime_error("caustic is not of the size of primal");
    const bool gradients = std::find(inputs.begin(), inputs.end(), "dx") != inputs.end();
    for (size_t i = 0; i < primal.pixels.size(); i++) {
        if (gradients)
            primal.pixels[i] -= caustic.pixels[i];
        else if (layers.count("primal_var") && (has("caustic_var") || caustic.pixels[i] != 0))
            layers["primal_var"].pixels[i] += has("caustic_var") ? held["caustic_var"].pixels[i] : NAN;
        if (!std::isfinite(caustic.pixels[i])) caustic.pixels[i] = 0;
    }
    return gradients ? held : Layers();
}

inline void add(Layer &image, const Layer &added) {
    for (size_t i = 0; i < image.pixels.size(); i++) image.pixels[i] += added.pixels[i];
}
