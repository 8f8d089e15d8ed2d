#include "network.hpp"
#include "text.hpp"

#include <algorithm>
#include <chrono>
#include <future>
#include <sstream>

namespace ngpt {
namespace {

std::vector<std::string> listed(const std::string &text) {
    std::istringstream names(text);
    std::vector<std::string> list;
    for (std::string name; std::getline(names >> std::ws, name, ',');) list.push_back(name);
    return list;
}

template <typename List, typename Item> bool holds(const List &list, const Item &item) {
    return std::find(list.begin(), list.end(), item) != list.end();
}

bool ends_with(const std::string &text, const std::string &end) {
    return text.size() >= end.size() && !text.compare(text.size() - end.size(), end.size(), end);
}

}  // namespace

Network::Network(const std::string &path, const std::string &device, int threads)
    : path(path), environment_(environment()), image_(load(environment_, path, device, threads)) {
    Ort::AllocatorWithDefaultOptions allocator;
    const Ort::ModelMetadata about = image_.session.GetModelMetadata();
    for (const auto &key : about.GetCustomMetadataMapKeysAllocated(allocator))
        metadata[key.get()] = about.LookupCustomMetadataMapAllocated(key.get(), allocator).get();
    alignment_ = number("ngpt.alignment", 1, 4096);
    overlap_ = number("ngpt.overlap", 0, 4096);
    overlap_with_base_ = number("ngpt.overlap with base", 0, 4096);
    bytes_per_pixel_ = number("ngpt.bytes per pixel", 1, 1 << 30);
    list_inputs();
    load_statistics(threads);
}

// Its lack is an error only where it is needed.
void Network::load_statistics(int threads) {
    const std::string stem = ends_with(path, ".onnx") ? path.substr(0, path.size() - 5) : path;
    try {
        // Of a whole image, for which devices have no room.
        statistics_ = load(environment_, stem + ".statistics.onnx", "cpu", threads);
        for (const std::string &name : statistics_.names)
            if (!input(name))
                throw Failure(NGPT_BAD_NETWORK,
                              stem + ".statistics.onnx: belongs to another network, it reads " + name);
        if (!holds(statistics_.outputs, "statistics"))
            throw Failure(NGPT_BAD_NETWORK, stem + ".statistics.onnx: makes no statistics; export it anew");
        for (const std::string &name : statistics_.outputs)
            if (name != "statistics") prepared.push_back(name);
    } catch (const Failure &error) {
        if (error.status == NGPT_OUT_OF_MEMORY) throw;
        no_statistics_ = error.what();
    }
}

const std::string &Network::value(const std::string &key) const {
    const auto found = metadata.find(key);
    if (found == metadata.end())
        throw Failure(NGPT_BAD_NETWORK, path + ": lacks the metadata " + key + " of an ngpt network; export it anew");
    return found->second;
}

int64_t Network::number(const std::string &key, int64_t least, int64_t most) const {
    std::istringstream text(value(key));
    int64_t number = 0;
    if (text >> number && text.eof() && number >= least && number <= most) return number;
    throw Failure(NGPT_BAD_NETWORK, path + ": its " + key + " is '" + one_line(value(key), 40) + "'; it must be " +
                                        std::to_string(least) + " to " + std::to_string(most) + ": export it anew");
}

// Those that the metadata list, in their order, and then those that the graph has values for.
void Network::list_inputs() {
    const auto optional = listed(metadata.count("ngpt.optional") ? metadata["ngpt.optional"] : "");
    std::vector<std::string> names = listed(value("ngpt.inputs"));
    for (size_t i = image_.must; i < image_.names.size(); i++)
        if (image_.names[i] != "statistics" && !holds(names, image_.names[i])) names.push_back(image_.names[i]);
    for (const std::string &name : names) {
        const size_t i = std::find(image_.names.begin(), image_.names.end(), name) - image_.names.begin();
        if (i == image_.names.size() || image_.shapes[i].size() != 4 || image_.shapes[i][1] < 1 ||
            image_.shapes[i][1] > 16)
            throw Failure(NGPT_BAD_NETWORK, path + ": its metadata list a layer " + name + ", its graph reads none");
        const bool variance = ends_with(name, "_var"), has_value = i >= image_.must;
        inputs.push_back({name, int(image_.shapes[i][1]), !has_value && !variance && !holds(optional, name), has_value,
                          variance ? -1.0f : 0.0f});
    }
    if (!holds(names, "primal") || !holds(image_.names, "statistics") || inputs.size() + 1 != image_.names.size())
        throw Failure(NGPT_BAD_NETWORK,
                      path + ": its graph reads layers that its metadata do not list; export it anew");
    if (!holds(image_.outputs, "image")) throw Failure(NGPT_BAD_NETWORK, path + ": makes no image; export it anew");
}

const Input *Network::input(const std::string &name) const {
    for (const Input &one : inputs)
        if (one.name == name) return &one;
    return nullptr;
}

bool Network::prepares_with(const std::string &name) const { return holds(statistics_.names, name); }

Tiles Network::plan(int64_t width, int64_t height, int64_t memory, bool with_base) const {
    const int64_t most = (memory << 20) / bytes_per_pixel_;
    const Tiles tiles = cut(width, height, alignment_, with_base ? overlap_with_base_ : overlap_, most);
    if (tiles.area() > most)
        throw Failure(NGPT_OUT_OF_MEMORY,
                      path + ": its smallest tile takes " +
                          std::to_string((tiles.area() * bytes_per_pixel_ >> 20) + 1) + " MiB, and " +
                          std::to_string(memory) + " MiB are allowed or left; allow more, or free some");
    return tiles;
}

Images Network::prepare(std::vector<std::string> names, const Layers &layers, int64_t width, int64_t height,
                        const Cancelled &cancelled) {
    if (!no_statistics_.empty())
        throw Failure(NGPT_BAD_NETWORK, no_statistics_ + "; tiles and ngpt_prepare need it: put it there");
    names.push_back("statistics");
    return run(statistics_, names, layers, width, {0, 0, height, width}, {}, cancelled);
}

std::vector<float> Network::run(const Layers &layers, int64_t width, const Window &window,
                                const std::vector<float> &statistics, const Cancelled &cancelled) {
    return std::move(run(image_, {"image"}, layers, width, window, statistics, cancelled).at("image"));
}

// What a graph makes is what it says only after a look.
std::vector<float> Network::taken(const Ort::Value &value, const std::string &name, const Window &window) const {
    const std::vector<int64_t> image{1, 3, window.height, window.width}, statistics{5};
    if (value.IsTensor()) {
        const auto tensor = value.GetTensorTypeAndShapeInfo();
        if (tensor.GetElementType() == ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT &&
            tensor.GetShape() == (name == "statistics" ? statistics : image)) {
            const float *data = value.GetTensorData<float>();
            return {data, data + tensor.GetElementCount()};
        }
    }
    throw Failure(NGPT_BAD_NETWORK, path + ": its " + name + " has another size than is due; export it anew");
}

Images Network::run(Graph &graph, const std::vector<std::string> &outputs, const Layers &layers, int64_t width,
                    const Window &window, const std::vector<float> &statistics, const Cancelled &cancelled) {
    const auto memory = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
    std::vector<std::vector<float>> pixels;
    std::vector<const char *> names;
    std::vector<Ort::Value> values;
    const auto pass = [&](const char *name, std::vector<float> data, const std::vector<int64_t> &shape) {
        pixels.push_back(std::move(data));
        names.push_back(name);
        values.push_back(Ort::Value::CreateTensor<float>(memory, pixels.back().data(), pixels.back().size(),
                                                         shape.data(), shape.size()));
    };
    for (const std::string &name : graph.names) {
        const Input *one = input(name);
        const auto given = layers.find(name);
        if (!one || (given == layers.end() && one->has_value)) continue;
        std::vector<float> planes(one->channels * window.area(), one->missing);
        if (given != layers.end()) read(given->second, width, window, one->channels, planes.data());
        pass(name.c_str(), std::move(planes), {1, one->channels, window.height, window.width});
    }
    if (!statistics.empty()) pass("statistics", statistics, {int64_t(statistics.size())});

    Ort::RunOptions options;
    std::vector<const char *> made;
    for (const std::string &name : outputs) made.push_back(name.c_str());
    const auto run = [&] {
        return graph.session.Run(options, names.data(), values.data(), values.size(), made.data(), made.size());
    };
    auto future = std::async(cancelled ? std::launch::async : std::launch::deferred, run);
    bool ended = false;
    while (cancelled && future.wait_for(std::chrono::milliseconds(50)) != std::future_status::ready)
        if (!ended && (ended = cancelled())) options.SetTerminate();
    if (ended) {
        future.wait();
        throw Failure(NGPT_CANCELLED, "cancelled");
    }
    Images images;
    try {
        const std::vector<Ort::Value> result = future.get();
        for (size_t i = 0; i < outputs.size(); i++) images[outputs[i]] = taken(result[i], outputs[i], window);
    } catch (const Ort::Exception &error) {
        throw Failure(tells_of_memory(error.what()) ? NGPT_OUT_OF_MEMORY : NGPT_FAILED,
                      path + ": ONNX Runtime cannot run it: " + error.what());
    }
    return images;
}

}  // namespace ngpt
