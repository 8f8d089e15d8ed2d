// A network's file, loaded: what it reads, how to cut images for it, and runs of one tile.
#pragma once

#include "layers.hpp"

#define ORT_API_MANUAL_INIT
#include <onnxruntime_cxx_api.h>

#include <functional>
#include <map>
#include <stdexcept>
#include <string>
#include <vector>

namespace ngpt {

struct Failure : std::runtime_error {
    ngpt_status status;
    Failure(ngpt_status status, const std::string &message) : std::runtime_error(message), status(status) {}
};

// A layer that a network reads.
struct Input {
    std::string name;
    int channels;
    bool required, has_value;  // must it be given; does the graph know what to take where it is not?
    float missing;             // what we give in its place
};

// What a tile is for, and what it sees.
struct Tile {
    Window inner, outer;
};

using Layers = std::map<std::string, View>;
using Images = std::map<std::string, std::vector<float>>;  // three channels, one after the other; row by row
// Asked now and then during a run; true ends it. May be empty.
using Cancelled = std::function<bool()>;

class Network {
public:
    const std::string path;
    std::vector<Input> inputs;
    std::vector<std::string> prepared;  // the images that `prepare` can make
    std::map<std::string, std::string> metadata;

    Network(const std::string &path, int threads);

    const Input *input(const std::string &name) const;  // nullptr if it reads no such layer

    // Whether `prepare` reads that layer.
    bool prepares_with(const std::string &name) const;

    // The least work within `memory` MiB; the same tiles as in ngpt/network/run_onnx.py.
    std::vector<Tile> plan(int64_t width, int64_t height, int64_t memory, bool with_base) const;

    // "statistics", the five numbers that the tiles of an image share, and those of `prepared` that are named.
    Images prepare(std::vector<std::string> names, const Layers &layers, int64_t width, int64_t height,
                   const Cancelled &cancelled);

    // The image of a window. Without statistics those of the window are taken.
    std::vector<float> run(const Layers &layers, int64_t width, const Window &window,
                           const std::vector<float> &statistics, const Cancelled &cancelled);

private:
    // A graph with the names of its inputs, of which those from `must` on have values.
    struct Graph {
        Ort::Session session{nullptr};
        std::vector<std::string> names, outputs;
        std::vector<std::vector<int64_t>> shapes;
        size_t must = 0;
    };

    Ort::Env environment_{nullptr};
    Graph image_, statistics_;
    std::string no_statistics_;  // why there is no statistics model
    int64_t alignment_, overlap_, overlap_with_base_, bytes_per_pixel_;

    Graph load(const std::string &path, int threads);
    void load_statistics(int threads);
    const std::string &value(const std::string &key) const;
    int64_t number(const std::string &key, int64_t least, int64_t most) const;
    void list_inputs();
    Images run(Graph &graph, const std::vector<std::string> &outputs, const Layers &layers, int64_t width,
               const Window &window, const std::vector<float> &statistics, const Cancelled &cancelled);
};

// On one line, of 400 characters at most.
std::string one_line(const std::string &text);

}  // namespace ngpt
