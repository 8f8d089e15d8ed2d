// Runs an ngpt model that corrects Open Image Denoise, ngpt-combine or ngpt-primal, with its images: a host in C++.
//
//     ngpt-oidn-host MODEL.onnx FOLDER OUTPUT.pfm [TILE]
//
// FOLDER is as `ngpt unpack STACK.exr FOLDER` makes it. TILE is the side of the network's tiles, 0 for the whole image
// at once; OIDN makes its own. Needs OIDN 2.

#include "files.hpp"

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
        std::fprintf(stderr, "usage: ngpt-oidn-host MODEL.onnx FOLDER OUTPUT.pfm [TILE]\n");
        return 2;
    }
    Model model(arguments[1]);
    Layers layers = read_layers(arguments[2], model);
    Prepared prepared = model.prepare(layers);
    if (!prepared.images.count("oidn_primal")) throw std::runtime_error("the model reads no images of OIDN: use ngpt-host");

    Oidn oidn;
    const Layer albedo = oidn.prefiltered("albedo", prepared.images["oidn_albedo"]);
    const Layer normal = oidn.prefiltered("normal", prepared.images["oidn_normal"]);
    layers["denoised"] = oidn.denoised(prepared.images["oidn_primal"], albedo, normal);
    if (auto base = prepared.images.find("oidn_base"); base != prepared.images.end()) {
        layers["denoised_base"] = oidn.denoised(base->second, albedo, normal);
        layers["base"] = base->second;
    }

    const int64_t tile = count > 4 ? std::atoll(arguments[4]) : 0;
    Layer image = tile ? model.tiled(layers, prepared, tile) : model.whole(layers, &prepared);
    write_pfm(arguments[3], image);
} catch (const std::exception &error) {
    std::fprintf(stderr, "ngpt-oidn-host: %s\n", error.what());
    return 1;
}
