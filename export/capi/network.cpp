#include "network.hpp"

#include <algorithm>
#include <chrono>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <future>
#include <iterator>
#include <mutex>
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

// The functions of the library that is loaded: constants, and the same for all handles.
void find_runtime() {
    static std::once_flag once;
    std::call_once(once, [] {
        // Official builds send telemetry by themselves, unless this is set before the first environment is made.
#ifdef _WIN32
        _putenv_s("ORT_DISABLE_TELEMETRY", "1");
#else
        setenv("ORT_DISABLE_TELEMETRY", "1", 0);
#endif
        const OrtApi *api = OrtGetApiBase()->GetApi(ORT_API_VERSION);
        if (!api)
            throw Failure(NGPT_FAILED, std::string("ONNX Runtime ") + OrtGetApiBase()->GetVersionString() +
                                           " is older than the headers that ngpt was built with; use a newer one");
        Ort::InitApi(api);
    });
}

// A way to cut a side: pieces of one size, which is why the last ones begin earlier, at multiples of the alignment.
struct Cut {
    int64_t step, size, count;
};

// All ways, coarsest first.
std::vector<Cut> cuts(int64_t length, int64_t alignment, int64_t overlap) {
    std::vector<Cut> ways;
    for (int64_t pieces = 1; pieces <= std::max<int64_t>(1, length / alignment); pieces++) {
        const int64_t step = (length + pieces * alignment - 1) / (pieces * alignment) * alignment;
        const int64_t size = std::min(step + 2 * overlap + length % alignment, length);
        if (ways.empty() || size < ways.back().size) ways.push_back({step, size, (length + step - 1) / step});
    }
    return ways;
}

}  // namespace

std::string one_line(const std::string &text) {
    std::istringstream words(text);
    std::string line;
    for (std::string word; words >> word && line.size() + word.size() < 400;) line += (line.empty() ? "" : " ") + word;
    return line;
}

Network::Network(const std::string &path, int threads) : path(path) {
    find_runtime();
    // What goes wrong comes as an exception; in the log it would stand a second time.
    environment_ = Ort::Env(ORT_LOGGING_LEVEL_FATAL, "ngpt");
    environment_.DisableTelemetryEvents();
    image_ = load(path, threads);
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

Network::Graph Network::load(const std::string &path, int threads) {
    // Read here, since ONNX Runtime has another kind of paths on Windows.
    std::ifstream file(std::filesystem::u8path(path), std::ios::binary);
    const std::string data{std::istreambuf_iterator<char>(file), {}};
    if (data.empty()) throw Failure(NGPT_BAD_NETWORK, path + ": cannot be read, or is empty");
    Ort::SessionOptions options;
    options.SetLogSeverityLevel(ORT_LOGGING_LEVEL_FATAL);
    options.SetIntraOpNumThreads(threads);
    // ONNX Runtime 1.21 gives the nodes it makes here one name, since ours have none, and then refuses the model.
    options.AddConfigEntry("optimization.disable_specified_optimizers", "GatherSliceToSplitFusion");
    Graph graph;
    try {
        graph.session = Ort::Session(environment_, data.data(), data.size(), options);
    } catch (const Ort::Exception &error) {
        throw Failure(NGPT_BAD_NETWORK, path + ": ONNX Runtime cannot load it: " + error.what());
    }
    Ort::AllocatorWithDefaultOptions allocator;
    const auto add = [&](Ort::AllocatedStringPtr name, const Ort::TypeInfo &type) {
        graph.names.push_back(name.get());
        graph.shapes.push_back(type.GetTensorTypeAndShapeInfo().GetShape());
    };
    graph.must = graph.session.GetInputCount();
    for (size_t i = 0; i < graph.must; i++)
        add(graph.session.GetInputNameAllocated(i, allocator), graph.session.GetInputTypeInfo(i));
    for (size_t i = 0; i < graph.session.GetOverridableInitializerCount(); i++)
        add(graph.session.GetOverridableInitializerNameAllocated(i, allocator),
            graph.session.GetOverridableInitializerTypeInfo(i));
    for (size_t i = 0; i < graph.session.GetOutputCount(); i++)
        graph.outputs.push_back(graph.session.GetOutputNameAllocated(i, allocator).get());
    return graph;
}

// Its lack is an error only where it is needed.
void Network::load_statistics(int threads) {
    const std::string stem = ends_with(path, ".onnx") ? path.substr(0, path.size() - 5) : path;
    try {
        statistics_ = load(stem + ".statistics.onnx", threads);
        for (const std::string &name : statistics_.names)
            if (!input(name))
                throw Failure(NGPT_BAD_NETWORK, stem + ".statistics.onnx: belongs to another network, it reads " + name);
        for (const std::string &name : statistics_.outputs)
            if (name != "statistics") prepared.push_back(name);
    } catch (const std::exception &error) {
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
    throw Failure(NGPT_BAD_NETWORK, path + ": its " + key + " is '" + value(key) + "'; it must be " +
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
        if (i == image_.names.size() || image_.shapes[i].size() != 4 || image_.shapes[i][1] < 1 || image_.shapes[i][1] > 16)
            throw Failure(NGPT_BAD_NETWORK, path + ": its metadata list a layer " + name + ", its graph reads none");
        const bool variance = ends_with(name, "_var"), has_value = i >= image_.must;
        inputs.push_back({name, int(image_.shapes[i][1]), !has_value && !variance && !holds(optional, name), has_value,
                          variance ? -1.0f : 0.0f});
    }
    if (!holds(names, "primal") || !holds(image_.names, "statistics") || inputs.size() + 1 != image_.names.size())
        throw Failure(NGPT_BAD_NETWORK, path + ": its graph reads layers that its metadata do not list; export it anew");
}

const Input *Network::input(const std::string &name) const {
    for (const Input &one : inputs)
        if (one.name == name) return &one;
    return nullptr;
}

bool Network::prepares_with(const std::string &name) const { return holds(statistics_.names, name); }

std::vector<Tile> Network::plan(int64_t width, int64_t height, int64_t memory, bool with_base) const {
    const int64_t overlap = with_base ? overlap_with_base_ : overlap_, most = (memory << 20) / bytes_per_pixel_;
    const std::vector<Cut> down = cuts(height, alignment_, overlap), across = cuts(width, alignment_, overlap);
    const Cut *rows = nullptr, *columns = nullptr;
    int64_t least = 0;
    for (const Cut &tall : down)
        for (const Cut &wide : across)
            if (tall.size * wide.size <= most) {
                const int64_t work = tall.count * wide.count * tall.size * wide.size;
                if (!rows || work < least) rows = &tall, columns = &wide, least = work;
                break;
            }
    if (!rows) {
        const int64_t needed = (down.back().size * across.back().size * bytes_per_pixel_ >> 20) + 1;
        throw Failure(NGPT_OUT_OF_MEMORY, path + ": its smallest tile takes " + std::to_string(needed) + " MiB, and " +
                                              std::to_string(memory) + " MiB are allowed; allow more");
    }
    std::vector<Tile> tiles;
    for (int64_t y = 0; y < height; y += rows->step)
        for (int64_t x = 0; x < width; x += columns->step) {
            const int64_t top = std::min(std::max<int64_t>(y - overlap, 0), height - rows->size);
            const int64_t left = std::min(std::max<int64_t>(x - overlap, 0), width - columns->size);
            tiles.push_back({{y, x, std::min(rows->step, height - y), std::min(columns->step, width - x)},
                             {top, left, rows->size, columns->size}});
        }
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
    const std::vector<Ort::Value> result = future.get();
    Images images;
    for (size_t i = 0; i < outputs.size(); i++) {
        const size_t length = result[i].GetTensorTypeAndShapeInfo().GetElementCount();
        if (length != (outputs[i] == "statistics" ? 5 : size_t(3 * window.area())))
            throw Failure(NGPT_BAD_NETWORK, path + ": its " + outputs[i] + " has another size than is due; export it anew");
        const float *data = result[i].GetTensorData<float>();
        images[outputs[i]].assign(data, data + length);
    }
    return images;
}

}  // namespace ngpt
