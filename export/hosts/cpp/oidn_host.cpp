// Runs an ngpt model that corrects Open Image Denoise, ngpt-combine or ngpt-primal, with its images: a host in C++.
//
//     ngpt-oidn-host MODEL.onnx FOLDER OUTPUT.pfm [MEMORY]
//
// FOLDER is as `ngpt unpack STACK.exr FOLDER` makes it. MEMORY is what the network's tiles may take, in MiB, 0 for
// 2048; OIDN makes its own. Needs OIDN 2.

#include "caustic.hpp"

#include <OpenImageDenoise/oidn.h>

#include <cstdio>
#include <cstdlib>

class Oidn {
public:
    Oidn() : device_(oidnNewDevice(OIDN_DEVICE_TYPE_CPU)) {
        oidnCommitDevice(device_);
        check();
    }
    ~Oidn() { oidnReleaseDevice(device_); }

    // A feature, "albedo" or "normal", denoised by OIDN's own model for it.
    Layer prefiltered(const char *name, const Layer &feature) {
        const bool empty = std::all_of(feature.pixels.begin(), feature.pixels.end(), [](float x) { return x == 0; });
        return empty ? feature : filtered({{name, &feature}}, false);
    }

    // An image with emission seen directly, by features that are prefiltered.
    Layer denoised(const Layer &color, const Layer &albedo, const Layer &normal) {
        return filtered({{"color", &color}, {"albedo", &albedo}, {"normal", &normal}}, true);
    }

private:
    OIDNDevice device_;

    Layer filtered(const std::map<const char *, const Layer *> &images, bool is_color) {
        const Layer &first = *images.begin()->second;
        const size_t height = first.height, width = first.width;
        OIDNFilter filter = oidnNewFilter(device_, "RT");
        std::vector<std::vector<float>> buffers;
        for (auto &[name, image] : images) {
            buffers.push_back(interleaved(*image));
            oidnSetSharedFilterImage(filter, name, buffers.back().data(), OIDN_FORMAT_FLOAT3, width, height, 0, 0, 0);
        }
        std::vector<float> output(3 * height * width);
        oidnSetSharedFilterImage(filter, "output", output.data(), OIDN_FORMAT_FLOAT3, width, height, 0, 0, 0);
        if (is_color) {
            oidnSetFilterBool(filter, "hdr", true);
            oidnSetFilterBool(filter, "cleanAux", true);
        } else {
            // Of features, "high" takes more than twice as long and gains nothing.
            oidnSetFilterInt(filter, "quality", OIDN_QUALITY_BALANCED);
        }
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
    const Layer denoised = oidn.denoised(primal, clean_albedo, clean_normal);
    network.give("denoised", denoised);
    Layer denoised_base;
    if (reads("denoised_base")) {
        denoised_base = oidn.denoised(base, clean_albedo, clean_normal);
        network.give("denoised_base", denoised_base);
        network.give("base", base);
    }
    Layer image(3, height, width);
    network.take("image", image);
    network.run(width, height, count > 4 ? std::atoi(arguments[4]) : 0);
    if (!light.empty()) {
        // The mean of OIDN's image of the light alone, and of what its image of all has beyond that of the rest
        const Layer &caustic = light.at("caustic");
        Layer all = primal;
        add(all, caustic);
        const Layer with = oidn.denoised(all, albedo, normal), without = oidn.denoised(primal, albedo, normal);
        Layer half = oidn.denoised(caustic, albedo, normal);
        for (size_t i = 0; i < half.pixels.size(); i++)
            half.pixels[i] = 0.5f * std::max(half.pixels[i] + with.pixels[i] - without.pixels[i], 0.0f);
        add(image, half);
    }
    write_pfm(arguments[3], image);
} catch (const std::exception &error) {
    std::fprintf(stderr, "ngpt-oidn-host: %s\n", error.what());
    return 1;
}
