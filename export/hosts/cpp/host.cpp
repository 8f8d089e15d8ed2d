// Runs an ngpt model on the layers of one image, whole or in tiles: a host in C++, to learn from and to copy.
//
//     ngpt-host MODEL.onnx FOLDER OUTPUT.pfm [TILE [RUNS]]
//
// FOLDER holds NAME.f32, float32 in the order (1, C, height, width), and vector.json with their shapes, as
// export/vector does. TILE is the side of the tiles, 0 for the whole image at once. What a model wants is in
// export/CONTRACT.md. Needs C++17 and ONNX Runtime.

#define ORT_API_MANUAL_INIT
#include <onnxruntime_cxx_api.h>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iterator>
#include <map>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

struct Layer {
    int64_t channels, height, width;
    std::vector<float> pixels;  // channel by channel, row by row

    Layer(int64_t channels, int64_t height, int64_t width)
        : channels(channels), height(height), width(width), pixels(channels * height * width) {}
    float *row(int64_t channel, int64_t y) { return pixels.data() + (channel * height + y) * width; }
};
using Layers = std::map<std::string, Layer>;

std::string slurp(const std::string &path) {
    std::ifstream file(path, std::ios::binary);
    if (!file) throw std::runtime_error(path + ": cannot be read");
    return {std::istreambuf_iterator<char>(file), {}};
}

// The layer called `name`, its shape taken from vector.json.
Layer read_layer(const std::string &folder, const std::string &name) {
    const std::string listing = slurp(folder + "/vector.json"), key = "\"" + name + "\"";
    size_t at = listing.find(key);
    at = at == std::string::npos ? at : listing.find('[', at);
    if (at == std::string::npos) throw std::runtime_error(folder + "/vector.json: the model needs " + key);
    std::string shape = listing.substr(at + 1, listing.find(']', at) - at - 1);
    std::replace(shape.begin(), shape.end(), ',', ' ');
    std::istringstream numbers(shape);
    int64_t one, channels, height, width;
    if (!(numbers >> one >> channels >> height >> width) || one != 1 || std::min({channels, height, width}) < 1)
        throw std::runtime_error(folder + "/vector.json: the shape of " + key + " must be [1, C, height, width]");
    Layer layer(channels, height, width);
    const std::string path = folder + "/" + name + ".f32", data = slurp(path);
    if (data.size() != layer.pixels.size() * sizeof(float))
        throw std::runtime_error(path + ": has " + std::to_string(data.size()) + " bytes, not those of its shape");
    std::copy(data.begin(), data.end(), reinterpret_cast<char *>(layer.pixels.data()));
    return layer;
}

Layer cropped(Layer &layer, int64_t top, int64_t left, int64_t height, int64_t width) {
    Layer part(layer.channels, height, width);
    for (int64_t c = 0; c < part.channels; c++)
        for (int64_t y = 0; y < height; y++) std::copy_n(layer.row(c, top + y) + left, width, part.row(c, y));
    return part;
}

class Model {
public:
    std::vector<std::string> inputs;  // the layers it reads
    int64_t alignment, overlap;

    explicit Model(const std::string &path)
        : options_(quiet()), image_(environment_, path.c_str(), options_),
          statistics_(environment_, (path.substr(0, path.rfind(".onnx")) + ".statistics.onnx").c_str(), options_) {
        std::istringstream names(metadata("ngpt.inputs"));
        for (std::string name; std::getline(names >> std::ws, name, ',');) inputs.push_back(name);
        alignment = std::stoll(metadata("ngpt.alignment"));
        overlap = std::stoll(metadata("ngpt.overlap"));
    }

    Layer whole(Layers &layers) {
        Layer &primal = layers.at("primal"), image(3, primal.height, primal.width);
        image.pixels = run(image_, "image", layers);
        return image;
    }

    // Tiles of `size` pixels. All share the statistics of the whole image, so that no seam shows.
    Layer tiled(Layers &layers, int64_t size) {
        size = std::max(alignment, size / alignment * alignment);
        const int64_t height = layers.at("primal").height, width = layers.at("primal").width;
        std::vector<float> statistics = run(statistics_, "statistics", layers);
        Layer image(3, height, width);
        for (int64_t y = 0; y < height; y += size)
            for (int64_t x = 0; x < width; x += size) {
                const int64_t top = std::max<int64_t>(0, y - overlap), bottom = std::min(height, y + size + overlap);
                const int64_t left = std::max<int64_t>(0, x - overlap), right = std::min(width, x + size + overlap);
                Layers parts;
                for (const std::string &name : inputs)
                    parts.emplace(name, cropped(layers.at(name), top, left, bottom - top, right - left));
                Layer result(3, bottom - top, right - left);
                result.pixels = run(image_, "image", parts, &statistics);
                const int64_t rows = std::min(size, height - y), columns = std::min(size, width - x);
                for (int64_t c = 0; c < 3; c++)
                    for (int64_t i = 0; i < rows; i++)
                        std::copy_n(result.row(c, y - top + i) + x - left, columns, image.row(c, y + i) + x);
            }
        return image;
    }

private:
    Ort::Env environment_{ORT_LOGGING_LEVEL_ERROR};
    Ort::SessionOptions options_;
    Ort::Session image_, statistics_;
    Ort::AllocatorWithDefaultOptions allocator_;

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

    std::vector<float> run(Ort::Session &session, const char *output, Layers &layers, std::vector<float> *statistics = {}) {
        auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
        std::vector<std::string> names;
        std::vector<const char *> pointers;
        std::vector<Ort::Value> values;
        for (size_t i = 0; i < session.GetInputCount(); i++)
            names.push_back(session.GetInputNameAllocated(i, allocator_).get());
        for (const std::string &name : names) {
            Layer &layer = layers.at(name);
            const int64_t shape[] = {1, layer.channels, layer.height, layer.width};
            pointers.push_back(name.c_str());
            values.push_back(Ort::Value::CreateTensor<float>(memory, layer.pixels.data(), layer.pixels.size(), shape, 4));
        }
        if (statistics) {
            const int64_t shape[] = {5};
            pointers.push_back("statistics");
            values.push_back(Ort::Value::CreateTensor<float>(memory, statistics->data(), 5, shape, 1));
        }
        auto result = session.Run({}, pointers.data(), values.data(), values.size(), &output, 1);
        const float *data = result[0].GetTensorData<float>();
        return {data, data + result[0].GetTensorTypeAndShapeInfo().GetElementCount()};
    }
};

// A portable float map: pixel by pixel, the last row first, little-endian.
void write_pfm(const std::string &path, Layer &image) {
    std::ofstream file(path, std::ios::binary);
    file << "PF\n" << image.width << " " << image.height << "\n-1.0\n";
    for (int64_t y = image.height - 1; y >= 0; y--)
        for (int64_t x = 0; x < image.width; x++)
            for (int64_t c = 0; c < 3; c++) file.write(reinterpret_cast<char *>(image.row(c, y) + x), sizeof(float));
    if (!file.flush()) throw std::runtime_error(path + ": cannot be written");
}

int main(int count, char **arguments) try {
    bool understood = count >= 4 && count <= 6;
    for (int i = 4; i < count; i++)
        understood &= std::string(arguments[i]).find_first_not_of("0123456789") == std::string::npos;
    if (!understood) {
        std::fprintf(stderr, "usage: ngpt-host MODEL.onnx FOLDER OUTPUT.pfm [TILE [RUNS]]\n");
        return 2;
    }
    const OrtApi *api = OrtGetApiBase()->GetApi(ORT_API_VERSION);
    if (!api) throw std::runtime_error(std::string("ONNX Runtime ") + OrtGetApiBase()->GetVersionString() +
                                       " is older than the headers this was built with");
    Ort::InitApi(api);
    const int64_t tile = count > 4 ? std::atoll(arguments[4]) : 0;
    const int runs = count > 5 ? std::max(1, std::atoi(arguments[5])) : 1;
    Model model(arguments[1]);
    Layers layers;
    for (const std::string &name : model.inputs) layers.emplace(name, read_layer(arguments[2], name));
    for (auto &[name, layer] : layers)
        if (layer.height != layers.at("primal").height || layer.width != layers.at("primal").width)
            throw std::runtime_error(name + " is not of the size of primal");
    Layer image(0, 0, 0);
    for (int i = 0; i < runs; i++) {
        const auto start = std::chrono::steady_clock::now();
        image = tile ? model.tiled(layers, tile) : model.whole(layers);
        std::printf("%.1f ms\n", std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - start).count());
    }
    write_pfm(arguments[3], image);
} catch (const std::exception &error) {
    std::fprintf(stderr, "ngpt-host: %s\n", error.what());
    return 1;
}
