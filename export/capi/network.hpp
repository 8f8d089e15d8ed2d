// A network's file, loaded: what it reads, how to cut images for it, and runs of one tile.
#pragma once

#include "graph.hpp"
#include "tiles.hpp"

#include <functional>
#include <map>
#include <string>
#include <vector>

namespace ngpt {

// A layer that a network reads.
struct Input {
    std::string name;
    int channels;
    bool required, has_value;  // must it be given; does the graph know what to take where it is not?
    float missing;             // what we give in its place
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

    Network(const std::string &path, const std::string &device, int threads);

    const Input *input(const std::string &name) const;  // nullptr if it reads no such layer

    // Whether `prepare` reads that layer.
    bool prepares_with(const std::string &name) const;

    // The least work within `memory` MiB.
    Tiles plan(int64_t width, int64_t height, int64_t memory, bool with_base) const;

    // "statistics", the five numbers that the tiles of an image share, and those of `prepared` that are named.
    Images prepare(std::vector<std::string> names, const Layers &layers, int64_t width, int64_t height,
                   const Cancelled &cancelled);

    // The image of a window. Without statistics those of the window are taken.
    std::vector<float> run(const Layers &layers, int64_t width, const Window &window,
                           const std::vector<float> &statistics, const Cancelled &cancelled);

private:
    Ort::Env environment_{nullptr};
    Graph image_, statistics_;
    std::string no_statistics_;  // why there is no statistics model
    int64_t alignment_, overlap_, overlap_with_base_, bytes_per_pixel_;

    void load_statistics(int threads);
    const std::string &value(const std::string &key) const;
    int64_t number(const std::string &key, int64_t least, int64_t most) const;
    void list_inputs();
    std::vector<float> taken(const Ort::Value &value, const std::string &name, const Window &window) const;
    Images run(Graph &graph, const std::vector<std::string> &outputs, const Layers &layers, int64_t width,
               const Window &window, const std::vector<float> &statistics, const Cancelled &cancelled);
};

}  // namespace ngpt
