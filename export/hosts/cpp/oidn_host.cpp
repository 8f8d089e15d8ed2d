// Runs an ngpt model that corrects Open Image Denoise, ngpt-combine or ngpt-primal, with its images: a host in C++.
//
//     ngpt-oidn-host MODEL.onnx FOLDER OUTPUT.pfm [MEMORY]
//
// FOLDER is as `ngpt unpack STACK.exr FOLDER` makes it. MEMORY is what the network's tiles may take, in MiB, 0 for
// 2048; OIDN makes its own. Needs OIDN 2.

#include "caustic.hpp"

#include <OpenImageDenoise/oidn.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>

class Oidn {
public:
    Oidn() : device_(oidnNewDevice(OIDN_DEVICE_TYPE_CPU)) {
        oidnCommitDevice(device_);
        check();
    }
    ~Oidn() { oidnReleaseDevice(device_); }

    // A feature, "albedo" or "normal", denoised by OIDN's own model for it. "High" takes more than twice as long, and
    // gains nothing.
    Layer prefiltered(const char *name, const Layer &feature) {
        const bool empty = std::all_of(feature.pixels.begin(), feature.pixels.end(), [](float x) { return x == 0; });
        return empty ? feature : filtered({{name, &feature}}, false, OIDN_QUALITY_BALANCED);
    }

    // An image with emission seen directly, by features that count as clean, or do not.
    Layer denoised(const Layer &color, const Layer &albedo, const Layer &normal, OIDNQuality quality, bool clean = true) {
        return filtered({{"color", &color}, {"albedo", &albedo}, {"normal", &normal}}, clean, quality);
    }

private:
    OIDNDevice device_;

    Layer filtered(const std::map<std::string, const Layer *> &images, bool clean, OIDNQuality quality) {
        const Layer &first = *images.begin()->second;
        const size_t height = first.height, width = first.width;
        OIDNFilter filter = oidnNewFilter(device_, "RT");
        std::vector<std::vector<float>> buffers;
        for (auto &[name, image] : images) {
            buffers.push_back(interleaved(*image));
            oidnSetSharedFilterImage(filter, name.c_str(), buffers.back().data(), OIDN_FORMAT_FLOAT3, width, height, 0, 0, 0);
        }
        std::vector<float> output(3 * height * width);
        oidnSetSharedFilterImage(filter, "output", output.data(), OIDN_FORMAT_FLOAT3, width, height, 0, 0, 0);
        oidnSetFilterBool(filter, "hdr", images.count("color") > 0);
        oidnSetFilterBool(filter, "cleanAux", clean);
        oidnSetFilterInt(filter, "quality", quality);
        oidnCommitFilter(filter);
        oidnExecuteFilter(filter);
        oidnReleaseFilter(filter);
        check();
        return planar(output, height, width);
    }

    void check() {
        const char *message = nullptr;
        if (oidnGetDeviceError(device_, &message) != OIDN_ERROR_NONE) throw std::runtime_error(std::string("OIDN: ") + message);
    }

    static std::vector<float> interleaved(const Layer &layer) {
        const size_t pixels = layer.height * layer.width;
        std::vector<float> values(3 * pixels);
        for (size_t c = 0; c < 3; c++)
            for (size_t i = 0; i < pixels; i++) values[3 * i + c] = layer.pixels[c * pixels + i];
        return values;
    }

    static Layer planar(const std::vector<float> &values, size_t height, size_t width) {
        Layer layer(3, height, width);
        for (size_t c = 0; c < 3; c++)
            for (size_t i = 0; i < height * width; i++) layer.pixels[c * height * width + i] = values[3 * i + c];
        return layer;
    }
};

float at(const Layer &layer, int c, int y, int x) {
    return layer.pixels[(size_t(c) * layer.height + y) * layer.width + x];
}

// The means of 2x2 pixels; sides of odd length have their last pixels twice.
Layer halved(const Layer &layer) {
    Layer half(layer.channels, (layer.height + 1) / 2, (layer.width + 1) / 2);
    float *pixel = half.pixels.data();
    for (int c = 0; c < half.channels; c++)
        for (int y = 0; y < layer.height; y += 2)
            for (int x = 0; x < layer.width; x += 2) {
                const int below = std::min(y + 1, layer.height - 1), right = std::min(x + 1, layer.width - 1);
                *pixel++ = (at(layer, c, y, x) + at(layer, c, y, right) + at(layer, c, below, x) +
                            at(layer, c, below, right)) / 4;
            }
    return half;
}

// Bilinear at twice the size, of which that many rows and columns are wanted.
Layer doubled(const Layer &half, int height, int width) {
    Layer layer(half.channels, height, width);
    float *pixel = layer.pixels.data();
    for (int c = 0; c < half.channels; c++)
        for (int y = 0; y < height; y++)
            for (int x = 0; x < width; x++) {
                const int v = std::clamp(y / 2 + (y % 2 ? 1 : -1), 0, half.height - 1);
                const int u = std::clamp(x / 2 + (x % 2 ? 1 : -1), 0, half.width - 1);
                *pixel++ = 0.75f * (0.75f * at(half, c, y / 2, x / 2) + 0.25f * at(half, c, y / 2, u)) +
                           0.25f * (0.75f * at(half, c, v, x / 2) + 0.25f * at(half, c, v, u));
            }
    return layer;
}

double sum(const Layer &layer) {
    double total = 0;
    for (const float value : layer.pixels) total += value;
    return total;
}

int main(int count, char **arguments) try {
    if (count < 4 || count > 5 || (count == 5 && std::string(arguments[4]).find_first_not_of("0123456789") != std::string::npos)) {
        std::fprintf(stderr, "usage: ngpt-oidn-host MODEL.onnx FOLDER OUTPUT.pfm [MEMORY]\n");
        return 2;
    }
    Network network(arguments[1]);
    const auto reads = [&](const char *name) {
        return std::find(network.inputs.begin(), network.inputs.end(), name) != network.inputs.end();
    };
    if (!reads("denoised")) throw std::runtime_error("the model reads no images of OIDN: use ngpt-host");
    Layers layers = read_layers(arguments[2], network);
    const Layers light = take_out_caustic(arguments[2], network.inputs, layers);
    for (const auto &[name, layer] : layers) network.give(name, layer);
    const int height = layers.at("primal").height, width = layers.at("primal").width;
    Layer primal(3, height, width), albedo = primal, normal = primal, base = primal;
    network.take("oidn_primal", primal);
    network.take("oidn_albedo", albedo);
    network.take("oidn_normal", normal);
    if (reads("denoised_base")) network.take("oidn_base", base);
    network.prepare(width, height);

    Oidn oidn;
    const Layer clean_albedo = oidn.prefiltered("albedo", albedo), clean_normal = oidn.prefiltered("normal", normal);
    const Layer denoised = oidn.denoised(primal, clean_albedo, clean_normal, OIDN_QUALITY_HIGH);
    network.give("denoised", denoised);
    Layer denoised_base;
    if (reads("denoised_base")) {
        denoised_base = oidn.denoised(base, clean_albedo, clean_normal, OIDN_QUALITY_FAST);
        network.give("denoised_base", denoised_base);
        network.give("base", base);
    }
    Layer image(3, height, width);
    network.take("image", image);
    network.run(width, height, count > 4 ? std::atoi(arguments[4]) : 0);
    if (!light.empty()) {
        const Layer given = halved(light.at("caustic"));
        Layer made = oidn.denoised(given, halved(albedo), halved(normal), OIDN_QUALITY_HIGH, false);
        for (float &value : made.pixels) value = std::max(value, 0.0f);
        // What OIDN took for noise is given back.
        const double before = sum(given), after = sum(made);
        if (before > 0 && after > 0)
            for (float &value : made.pixels) value *= float(std::min(before / after, 4.0));
        add(image, doubled(made, height, width));
    }
    write_pfm(arguments[3], image);
} catch (const std::exception &error) {
    std::fprintf(stderr, "ngpt-oidn-host: %s\n", error.what());
    return 1;
}
