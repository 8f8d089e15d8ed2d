// Runs an ngpt model that corrects Open Image Denoise, ngpt-combine or ngpt-primal, with its images: a host in C++.
//
//     ngpt-oidn-host MODEL.onnx FOLDER OUTPUT.pfm [MEMORY]
//
// FOLDER is as `ngpt unpack STACK.exr FOLDER` makes it. MEMORY is what the network's tiles may take, in MiB, 0 for
// 2048; OIDN makes its own. Needs OIDN 2.

#include "files.hpp"

#include <OpenImageDenoise/oidn.h>

#include <cstdio>
#include <cstdlib>
#include <list>
#include <map>
#include <ngpt.h>
#include <numeric>

using Image = std::vector<float>;  // pixels of three floats
using Images = std::map<std::string, Image>;

class Oidn {
public:
    Oidn(int width, int height) : device_(oidnNewDevice(OIDN_DEVICE_TYPE_CPU)), width_(width), height_(height) {
        oidnCommitDevice(device_);
        check();
    }
    ~Oidn() { oidnReleaseDevice(device_); }

    // A feature, "albedo" or "normal", denoised by OIDN's own model for it. "High" takes more than twice as long, and
    // gains nothing.
    Image prefiltered(const char *name, const Image &feature) {
        const bool empty = std::all_of(feature.begin(), feature.end(), [](float x) { return x == 0; });
        return empty ? feature : filtered({{name, feature}}, false, OIDN_QUALITY_BALANCED);
    }

    // An image, "color", with features that count as clean, or a feature by itself.
    Image filtered(Images images, bool clean, OIDNQuality quality) {
        OIDNFilter filter = oidnNewFilter(device_, "RT");
        Image output(images.begin()->second.size());
        const auto set = [&](const char *name, Image &image) {
            oidnSetSharedFilterImage(filter, name, image.data(), OIDN_FORMAT_FLOAT3, width_, height_, 0, 0, 0);
        };
        for (auto &[name, image] : images) set(name.c_str(), image);
        set("output", output);
        oidnSetFilterBool(filter, "hdr", images.count("color") > 0);
        oidnSetFilterBool(filter, "cleanAux", clean);
        oidnSetFilterInt(filter, "quality", quality);
        oidnCommitFilter(filter);
        oidnExecuteFilter(filter);
        oidnReleaseFilter(filter);
        check();
        return output;
    }

private:
    OIDNDevice device_;
    size_t width_, height_;

    void check() {
        const char *message = nullptr;
        if (oidnGetDeviceError(device_, &message) != OIDN_ERROR_NONE) throw std::runtime_error(std::string("OIDN: ") + message);
    }
};

// What OIDN has made of `light`, with what it took for noise given back, and nothing below zero where no light is.
Image given_back(Image found, const Image &light) {
    const float least = std::min(0.0f, *std::min_element(light.begin(), light.end()));
    for (float &value : found) value = std::max(value, least);
    const auto sum = [](const Image &image) { return std::accumulate(image.begin(), image.end(), 0.0); };
    const double before = sum(light), after = sum(found);
    if (before > 0 && after > 0)
        for (float &value : found) value *= float(std::min(before / after, 4.0));
    return found;
}

int main(int count, char **arguments) try {
    if (count < 4 || count > 5 || (count == 5 && std::string(arguments[4]).find_first_not_of("0123456789") != std::string::npos))
        throw std::invalid_argument("usage: ngpt-oidn-host MODEL.onnx FOLDER OUTPUT.pfm [MEMORY]");
    char message[512];
    ngpt_network *network = ngpt_open(arguments[1], 0, message, sizeof message);
    if (!network) throw std::runtime_error(message);
    ngpt_job *job = ngpt_job_new(network);
    const auto check = [&](ngpt_status status) {
        if (status != NGPT_OK) throw std::runtime_error(ngpt_message(job));
    };
    const Folder folder(arguments[2]);
    const int width = folder.width, height = folder.height;
    const ptrdiff_t plane = ptrdiff_t(4) * width * height;  // bytes of a channel
    std::list<Image> layers;
    for (int i = 0; i < ngpt_layer_count(network); i++) {
        const char *name = ngpt_layer_name(network, i);
        const int channels = ngpt_layer_channels(network, i);
        if (!folder.has(name)) continue;
        layers.push_back(folder.layer(name, channels));
        check(ngpt_set_layer(job, name, layers.back().data(), NGPT_FLOAT, channels, plane, 4, 4 * width));
    }
    Images made;
    for (const char *name : {"primal", "albedo", "normal", "base", "caustic"}) {
        Image image(size_t(3) * width * height);
        if (ngpt_set_output(job, (std::string("oidn_") + name).c_str(), image.data(), NGPT_FLOAT, 3, 0, 0, 0) == NGPT_OK)
            made[name] = std::move(image);
    }
    if (!made.count("primal")) throw std::runtime_error("the model reads no images of OIDN: use ngpt-host");
    check(ngpt_prepare(job, width, height, nullptr, nullptr));

    Oidn oidn(width, height);
    const Image albedo = oidn.prefiltered("albedo", made["albedo"]), normal = oidn.prefiltered("normal", made["normal"]);
    const auto give = [&](const char *name, const Image &image) {
        layers.push_back(image);
        check(ngpt_set_layer(job, name, layers.back().data(), NGPT_FLOAT, 3, 0, 0, 0));
    };
    const auto denoised = [&](const char *name, OIDNQuality quality) {
        return oidn.filtered({{"color", made[name]}, {"albedo", albedo}, {"normal", normal}}, true, quality);
    };
    give("denoised", denoised("primal", OIDN_QUALITY_HIGH));
    if (made.count("base")) {
        give("denoised_base", denoised("base", OIDN_QUALITY_FAST));
        give("base", made["base"]);
    }
    if (made.count("caustic")) {
        // Most images have no such light.
        const Image &light = made["caustic"];
        const bool dark = std::all_of(light.begin(), light.end(), [](float x) { return x == 0; });
        give("denoised_caustic", dark ? light : given_back(denoised("caustic", OIDN_QUALITY_HIGH), light));
    }
    Image image(size_t(3) * width * height);
    check(ngpt_set_output(job, "image", image.data(), NGPT_FLOAT, 3, 0, 0, 0));
    check(ngpt_run(job, width, height, count > 4 ? std::atoi(arguments[4]) : 0, nullptr, nullptr));
    write_pfm(arguments[3], image, width, height);
    ngpt_job_free(job);
    ngpt_close(network);
} catch (const std::exception &error) {
    std::fprintf(stderr, "ngpt-oidn-host: %s\n", error.what());
    return dynamic_cast<const std::invalid_argument *>(&error) ? 2 : 1;
}
