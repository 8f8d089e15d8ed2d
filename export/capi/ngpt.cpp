// The C functions: checks of what they are given, and exceptions as messages.
#include "memory.hpp"
#include "network.hpp"
#include "text.hpp"

#include <algorithm>
#include <cstring>
#include <exception>
#include <memory>
#include <new>
#include <utility>

using namespace ngpt;

struct ngpt_network {
    std::shared_ptr<Network> shared;
};

struct ngpt_job {
    std::shared_ptr<Network> network;
    Layers layers, outputs;
    std::vector<float> statistics;  // those of `ngpt_prepare`, for the next run of an image of that size
    int width = 0, height = 0;
    char message[512] = "";
};

namespace {

constexpr int DEFAULT_MEMORY = 2048, LARGEST = 65536;

constexpr int MOST_THREADS = 1024, MOST_CHANNELS = 65536;
// Of the image that is kept until all of it is made.
constexpr uint64_t BYTES_OF_PIXEL = 12;

// Copies what is wrong to the caller. A handler that threw would end the process, even for lack of memory.
ngpt_status tell(char *message, size_t size, ngpt_status status, const char *text) noexcept {
    try {
        copy_line(one_line(text).c_str(), message, size);
        return status;
    } catch (...) {
        copy_line("out of memory", message, size);
        return NGPT_OUT_OF_MEMORY;
    }
}

// What `action` throws, as a status and a message.
template <typename Action> ngpt_status guarded(char *message, size_t size, Action action) noexcept {
    if (message && size) *message = 0;
    try {
        action();
        return NGPT_OK;
    } catch (const Failure &error) {
        return tell(message, size, error.status, error.what());
    } catch (const std::bad_alloc &) {
        copy_line("out of memory; free some, or allow less", message, size);
        return NGPT_OUT_OF_MEMORY;
    } catch (const std::exception &error) {
        return tell(message, size, tells_of_memory(error.what()) ? NGPT_OUT_OF_MEMORY : NGPT_FAILED, error.what());
    } catch (...) {
        copy_line("an unknown exception", message, size);
        return NGPT_FAILED;
    }
}

template <typename Action> ngpt_status guarded(ngpt_job *job, Action action) {
    return job ? guarded(job->message, sizeof job->message, action) : NGPT_BAD_ARGUMENT;
}

[[noreturn]] void refuse(const std::string &message) { throw Failure(NGPT_BAD_ARGUMENT, message); }

std::string joined(const std::vector<std::string> &names) {
    std::string text;
    for (const std::string &name : names) text += (text.empty() ? "" : ", ") + name;
    return text;
}

// A format of any number, which C allows and C++ does not.
int number_of(const ngpt_format &format) {
    int number;
    static_assert(sizeof number == sizeof format, "");
    std::memcpy(&number, &format, sizeof number);
    return number;
}

// Notes a view under one of the names that are known, or forgets it where there are no pixels.
template <typename Channels>
void set(Layers &views, const char *name, const char *verb, const std::vector<std::string> &known, const View &view,
         Channels channels) {
    if (!name) refuse("the name is NULL; the network " + std::string(verb) + " " + joined(known));
    const std::string key = name;
    if (std::find(known.begin(), known.end(), key) == known.end())
        refuse("the network " + std::string(verb) + " no '" + one_line(key, 40) + "'; it " + verb + " " +
               joined(known));
    if (!view.pixels) {
        views.erase(key);
        return;
    }
    if (view.format != NGPT_FLOAT && view.format != NGPT_HALF)
        refuse(key + ": the format is " + std::to_string(view.format) + "; it must be NGPT_FLOAT or NGPT_HALF");
    if (view.channels < channels())
        refuse(key + ": has " + std::to_string(view.channels) + " channels; it must have " +
               std::to_string(channels()));
    if (view.channels > MOST_CHANNELS)
        refuse(key + ": has " + std::to_string(view.channels) + " channels; it must have " +
               std::to_string(MOST_CHANNELS) + " at most");
    views[key] = view;
}

std::string size_of(int width, int height) { return std::to_string(width) + "x" + std::to_string(height); }

void check_size(int width, int height) {
    if (width < 1 || height < 1 || width > LARGEST || height > LARGEST)
        refuse("the image has " + size_of(width, height) + " pixels; sides must be 1 to " + std::to_string(LARGEST));
}

void check_addresses(const std::string &name, const View &view, int width, int height, int channels) {
    if (!addressable(view, width, height, channels))
        refuse(name + ": its strides lead out of memory for " + size_of(width, height) + " pixels");
}

void check_addresses(const Network &network, const Layers &layers, const Layers &outputs, int width, int height) {
    for (const auto &[name, view] : layers) check_addresses(name, view, width, height, network.input(name)->channels);
    for (const auto &[name, view] : outputs) check_addresses(name, view, width, height, 3);
}

// Of the statistics of a whole image: ONNX Runtime's and our copies of the layers, measured and rounded up.
uint64_t bytes_of_statistics(const Network &network) { return network.prepared.empty() ? 300 : 700; }

// What is left of memory beside so many bytes for each pixel, in MiB. Asked before: where memory is promised that is
// not there, the system ends the process when it is written to.
int64_t left_beside(int width, int height, uint64_t bytes) {
    const uint64_t needed = uint64_t(width) * uint64_t(height) * bytes, left = memory_left();
    if (needed > left)
        throw Failure(NGPT_OUT_OF_MEMORY, size_of(width, height) + " pixels take " + std::to_string(needed >> 20) +
                                              " MiB beside their layers, and " + std::to_string(left >> 20) +
                                              " MiB are left; cut the image, or free some");
    return int64_t((left - needed) >> 20);
}

void check_layers(const Network &network, const Layers &layers, bool preparing) {
    std::vector<std::string> missing;
    for (const Input &one : network.inputs)
        if (one.required && !layers.count(one.name) && !(preparing && !network.prepares_with(one.name)))
            missing.push_back(one.name);
    if (!missing.empty())
        throw Failure(NGPT_MISSING_LAYER, "the network needs the layers " + joined(missing) + ", which are not set");
}

// The caller's function, asked with the part that is done.
class Progress {
public:
    Progress(ngpt_progress function, void *user) : function_(function), user_(user) {}
    Cancelled cancelled() const {
        return function_ ? Cancelled([this] { return function_(user_, done_) != 0; }) : nullptr;
    }
    void advance(double fraction) {
        done_ = fraction;
        if (function_ && function_(user_, done_)) throw Failure(NGPT_CANCELLED, "cancelled");
    }

private:
    ngpt_progress function_;
    void *user_;
    double done_ = 0;
};

const Input *input_at(const ngpt_network *network, int index) {
    return index >= 0 && index < ngpt_layer_count(network) ? &network->shared->inputs[index] : nullptr;
}

}  // namespace

const char *ngpt_version(void) { return NGPT_VERSION; }

int ngpt_abi(void) { return NGPT_ABI; }

ngpt_network *ngpt_open(const char *path, int threads, char *message, size_t size) {
    return ngpt_open_on("cpu", path, threads, message, size);
}

ngpt_network *ngpt_open_on(const char *device, const char *path, int threads, char *message, size_t size) {
    ngpt_network *network = nullptr;
    guarded(message, size, [&] {
        if (!path) refuse("the path of the network is NULL");
        if (threads < 0 || threads > MOST_THREADS)
            refuse("the number of threads is " + std::to_string(threads) + "; it must be 0 to " +
                   std::to_string(MOST_THREADS));
        auto shared = std::make_shared<Network>(path, device ? device : "cpu", threads);
        network = new ngpt_network{std::move(shared)};
    });
    return network;
}

void ngpt_close(ngpt_network *network) { delete network; }

int ngpt_layer_count(const ngpt_network *network) { return network ? int(network->shared->inputs.size()) : 0; }

const char *ngpt_layer_name(const ngpt_network *network, int index) {
    const Input *input = input_at(network, index);
    return input ? input->name.c_str() : nullptr;
}

int ngpt_layer_channels(const ngpt_network *network, int index) {
    const Input *input = input_at(network, index);
    return input ? input->channels : 0;
}

int ngpt_layer_required(const ngpt_network *network, int index) {
    const Input *input = input_at(network, index);
    return input && input->required;
}

const char *ngpt_metadata(const ngpt_network *network, const char *key) try {
    if (!network || !key) return nullptr;
    const auto found = network->shared->metadata.find(key);
    return found == network->shared->metadata.end() ? nullptr : found->second.c_str();
} catch (const std::bad_alloc &) {
    return nullptr;
}

ngpt_job *ngpt_job_new(const ngpt_network *network) try {
    if (!network) return nullptr;
    ngpt_job *job = new ngpt_job;
    job->network = network->shared;
    return job;
} catch (const std::bad_alloc &) {
    return nullptr;
}

void ngpt_job_free(ngpt_job *job) { delete job; }

const char *ngpt_message(const ngpt_job *job) { return job ? job->message : "the job is NULL"; }

ngpt_status ngpt_set_layer(ngpt_job *job, const char *name, const void *pixels, ngpt_format format, int channels,
                           ptrdiff_t channel_stride, ptrdiff_t pixel_stride, ptrdiff_t row_stride) {
    return guarded(job, [&] {
        std::vector<std::string> known;
        for (const Input &one : job->network->inputs) known.push_back(one.name);
        // `read` and `write` have one structure; this one is for `read`.
        void *at = const_cast<void *>(pixels);
        const View view{at, number_of(format), channels, channel_stride, pixel_stride, row_stride};
        set(job->layers, name, "reads", known, view, [&] { return job->network->input(name)->channels; });
    });
}

ngpt_status ngpt_set_output(ngpt_job *job, const char *name, void *pixels, ngpt_format format, int channels,
                            ptrdiff_t channel_stride, ptrdiff_t pixel_stride, ptrdiff_t row_stride) {
    return guarded(job, [&] {
        std::vector<std::string> known = job->network->prepared;
        known.insert(known.begin(), "image");
        const View view{pixels, number_of(format), channels, channel_stride, pixel_stride, row_stride};
        set(job->outputs, name, "makes", known, view, [] { return 3; });
    });
}

ngpt_status ngpt_prepare(ngpt_job *job, int width, int height, ngpt_progress progress, void *user) {
    return guarded(job, [&] {
        const Layers layers = job->layers, outputs = job->outputs;
        Network &network = *job->network;
        check_size(width, height);
        check_layers(network, layers, true);
        std::vector<std::string> names;
        for (const std::string &name : network.prepared)
            if (outputs.count(name)) names.push_back(name);
        check_addresses(network, layers, outputs, width, height);
        left_beside(width, height, bytes_of_statistics(network));
        Progress asked(progress, user);
        asked.advance(0);
        Images images = network.prepare(names, layers, width, height, asked.cancelled());
        asked.advance(1);
        for (const std::string &name : names) write(outputs.at(name), width, height, images[name].data());
        job->statistics = std::move(images["statistics"]);
        job->width = width, job->height = height;
    });
}

ngpt_status ngpt_run(ngpt_job *job, int width, int height, int memory, ngpt_progress progress, void *user) {
    return guarded(job, [&] {
        // Copies, in case that the progress function sets others.
        const Layers layers = job->layers, outputs = job->outputs;
        Network &network = *job->network;
        check_size(width, height);
        if (memory < 0) refuse("the memory is " + std::to_string(memory) + " MiB; it must be 0 or more");
        check_layers(network, layers, false);
        if (!outputs.count("image")) throw Failure(NGPT_MISSING_LAYER, "the output 'image' is not set");

        check_addresses(network, layers, outputs, width, height);

        if (job->width != width || job->height != height) job->statistics.clear();
        const int64_t left = left_beside(width, height, BYTES_OF_PIXEL);
        const int64_t most = std::min<int64_t>(memory ? memory : DEFAULT_MEMORY, left);
        const Tiles tiles = network.plan(width, height, most, layers.count("base"));
        const bool asks = tiles.count() > 1 && job->statistics.empty();
        if (asks) left_beside(width, height, BYTES_OF_PIXEL + bytes_of_statistics(network));
        Progress asked(progress, user);
        asked.advance(0);
        std::vector<float> image(size_t(3) * size_t(width) * size_t(height));
        std::vector<float> shared = std::exchange(job->statistics, {});
        if (asks) shared = network.prepare({}, layers, width, height, asked.cancelled()).at("statistics");
        for (int64_t i = 0; i < tiles.count(); i++) {
            const auto [inner, outer] = tiles.tile(i);
            const std::vector<float> part = network.run(layers, width, outer, shared, asked.cancelled());
            for (int64_t c = 0; c < 3; c++)
                for (int64_t y = inner.top; y < inner.top + inner.height; y++) {
                    const int64_t row = (c * outer.height + y - outer.top) * outer.width;
                    const float *from = &part[size_t(row + inner.left - outer.left)];
                    std::copy(from, from + inner.width, &image[(c * height + y) * width + inner.left]);
                }
            asked.advance(double(i + 1) / double(tiles.count()));
        }
        write(outputs.at("image"), width, height, image.data());
    });
}
