// An ngpt model in ONNX Runtime, whole or in tiles: what the hosts in C++ share. Needs C++17.
// What a model wants is in export/CONTRACT.md.
#pragma once

#define ORT_API_MANUAL_INIT
#include <onnxruntime_cxx_api.h>

#include <algorithm>
#include <map>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

struct Layer {
    int64_t channels = 0, height = 0, width = 0;
    std::vector<float> pixels;  // channel by channel, row by row

    Layer() = default;
    Layer(int64_t channels, int64_t height, int64_t width)
        : channels(channels), height(height), width(width), pixels(channels * height * width) {}
    float *row(int64_t channel, int64_t y) { return pixels.data() + (channel * height + y) * width; }
};
using Layers = std::map<std::string, Layer>;

// What the statistics model makes of a whole image.
struct Prepared {
    std::vector<float> statistics;
    Layers images;  // for models that read another denoiser's images: what that is to be given, oidn_*
};

class Model {
    Ort::Env environment_;
    Ort::SessionOptions options_;
    Ort::Session image_, statistics_;
    Ort::AllocatorWithDefaultOptions allocator_;

public:
    std::vector<std::string> inputs, optional;  // the layers it reads; those of them that may be zeros
    int64_t alignment, overlap, overlap_with_base;

    // Beside MODEL.onnx there must be MODEL.statistics.onnx.
    explicit Model(const std::string &path)
        : environment_(start()), options_(quiet()), image_(environment_, path.c_str(), options_),
          statistics_(environment_, (path.substr(0, path.rfind(".onnx")) + ".statistics.onnx").c_str(), options_),
          inputs(names("ngpt.inputs")), optional(names("ngpt.optional")), alignment(std::stoll(metadata("ngpt.alignment"))),
          overlap(std::stoll(metadata("ngpt.overlap"))), overlap_with_base(std::stoll(metadata("ngpt.overlap with base"))) {}

    bool may_lack(const std::string &name) const {
        return std::find(optional.begin(), optional.end(), name) != optional.end();
    }

    Prepared prepare(Layers &layers) {
        Prepared prepared;
        for (auto &[name, layer] : run(statistics_, layers, nullptr))
            if (name == "statistics") prepared.statistics = std::move(layer.pixels);
            else prepared.images[name] = std::move(layer);
        return prepared;
    }

    // The image of all `inputs`, and of "base" where that is among the layers.
    Layer whole(Layers &layers, Prepared *prepared = nullptr) {
        return std::move(run(image_, layers, prepared).at("image"));
    }

    // In tiles of `size` pixels. All share the statistics of the whole image, so that no seam shows.
    Layer tiled(Layers &layers, Prepared &prepared, int64_t size) {
        size = std::max(alignment, size / alignment * alignment);
        const int64_t height = layers.at("primal").height, width = layers.at("primal").width;
        const int64_t more = layers.count("base") ? overlap_with_base : overlap;
        Layer image(3, height, width);
        for (int64_t y = 0; y < height; y += size)
            for (int64_t x = 0; x < width; x += size) {
                const int64_t top = std::max<int64_t>(0, y - more), bottom = std::min(height, y + size + more);
                const int64_t left = std::max<int64_t>(0, x - more), right = std::min(width, x + size + more);
                Layers parts;
                for (auto &[name, layer] : layers) parts[name] = cropped(layer, top, left, bottom - top, right - left);
                Layer result = whole(parts, &prepared);
                const int64_t rows = std::min(size, height - y), columns = std::min(size, width - x);
                for (int64_t c = 0; c < 3; c++)
                    for (int64_t i = 0; i < rows; i++)
                        std::copy_n(result.row(c, y - top + i) + x - left, columns, image.row(c, y + i) + x);
            }
        return image;
    }

private:
    static Ort::Env start() {
        const OrtApi *api = OrtGetApiBase()->GetApi(ORT_API_VERSION);
        if (!api) throw std::runtime_error(std::string("ONNX Runtime ") + OrtGetApiBase()->GetVersionString() +
                                           " is older than the headers this was built with");
        Ort::InitApi(api);
        return Ort::Env(ORT_LOGGING_LEVEL_ERROR);
    }

    // Its warnings are about inputs that have defaults, which is meant.
    static Ort::SessionOptions quiet() {
        Ort::SessionOptions options;
        options.SetLogSeverityLevel(ORT_LOGGING_LEVEL_ERROR);
        return options;
    }

    std::string metadata(const char *key) {
        auto value = image_.GetModelMetadata().LookupCustomMetadataMapAllocated(key, allocator_);
        if (!value) throw std::runtime_error(std::string("the model lacks the metadata ") + key);
        return value.get();
    }

    std::vector<std::string> names(const char *key) {
        std::vector<std::string> found;
        std::istringstream listed(metadata(key));
        for (std::string name; std::getline(listed >> std::ws, name, ',');) found.push_back(name);
        return found;
    }

    static Layer cropped(Layer &layer, int64_t top, int64_t left, int64_t height, int64_t width) {
        Layer part(layer.channels, height, width);
        for (int64_t c = 0; c < part.channels; c++)
            for (int64_t y = 0; y < height; y++) std::copy_n(layer.row(c, top + y) + left, width, part.row(c, y));
        return part;
    }

    Layers run(Ort::Session &session, Layers &layers, Prepared *prepared) {
        auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
        std::vector<std::string> given, made;
        std::vector<Ort::Value> values;
        auto give = [&](const std::string &name, std::vector<float> &data, std::vector<int64_t> shape) {
            given.push_back(name);
            values.push_back(Ort::Value::CreateTensor<float>(memory, data.data(), data.size(), shape.data(), shape.size()));
        };
        for (size_t i = 0; i < session.GetInputCount(); i++) {
            const std::string name = session.GetInputNameAllocated(i, allocator_).get();
            Layer &layer = layers.at(name);
            give(name, layer.pixels, {1, layer.channels, layer.height, layer.width});
        }
        if (prepared) give("statistics", prepared->statistics, {5});
        if (auto base = layers.find("base"); base != layers.end())
            give("base", base->second.pixels, {1, 3, base->second.height, base->second.width});
        for (size_t i = 0; i < session.GetOutputCount(); i++)
            made.push_back(session.GetOutputNameAllocated(i, allocator_).get());
        auto results = session.Run({}, pointers(given).data(), values.data(), values.size(), pointers(made).data(), made.size());
        Layers images;
        for (size_t i = 0; i < made.size(); i++) {
            auto shape = results[i].GetTensorTypeAndShapeInfo().GetShape();
            while (shape.size() < 4) shape.insert(shape.begin(), 1);  // statistics
            Layer image(shape[1], shape[2], shape[3]);
            std::copy_n(results[i].GetTensorData<float>(), image.pixels.size(), image.pixels.begin());
            images[made[i]] = std::move(image);
        }
        return images;
    }

    static std::vector<const char *> pointers(const std::vector<std::string> &names) {
        std::vector<const char *> all;
        for (const std::string &name : names) all.push_back(name.c_str());
        return all;
    }
};
