// libngpt (export/capi, docs/embed/c-library.md) with the manners of C++: what fails is thrown, what is opened is closed.
#pragma once

#include <ngpt.h>

#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

struct Layer {
    int channels = 0, height = 0, width = 0;
    std::vector<float> pixels;  // channel by channel, row by row

    Layer() = default;
    Layer(int channels, int height, int width)
        : channels(channels), height(height), width(width), pixels(size_t(channels) * height * width) {}
    ptrdiff_t plane() const { return ptrdiff_t(height) * width; }  // pixels of a channel
};

class Network {
public:
    explicit Network(const std::string &path) {
        char message[512];
        network_.reset(ngpt_open(path.c_str(), 0, message, sizeof message));
        if (!network_) throw std::runtime_error(message);
        job_.reset(ngpt_job_new(network_.get()));
        if (!job_) throw std::bad_alloc();
        for (int i = 0; i < ngpt_layer_count(network_.get()); i++) {
            inputs.push_back(ngpt_layer_name(network_.get(), i));
            if (ngpt_layer_required(network_.get(), i)) required.push_back(inputs.back());
        }
    }

    std::vector<std::string> inputs, required;  // the layers it reads; those that it cannot do without

    // The pixels must stay where they are until the next run.
    void give(const std::string &name, const Layer &layer) {
        check(ngpt_set_layer(job_.get(), name.c_str(), layer.pixels.data(), NGPT_FLOAT, layer.channels,
                             4 * layer.plane(), 4, 4 * layer.width));
    }
    void take(const std::string &name, Layer &image) {
        check(ngpt_set_output(job_.get(), name.c_str(), image.pixels.data(), NGPT_FLOAT, image.channels,
                              4 * image.plane(), 4, 4 * image.width));
    }
    void prepare(int width, int height) { check(ngpt_prepare(job_.get(), width, height, nullptr, nullptr)); }
    void run(int width, int height, int memory) { check(ngpt_run(job_.get(), width, height, memory, nullptr, nullptr)); }

private:
    struct Close {
        void operator()(ngpt_network *network) const { ngpt_close(network); }
        void operator()(ngpt_job *job) const { ngpt_job_free(job); }
    };
    std::unique_ptr<ngpt_network, Close> network_;
    std::unique_ptr<ngpt_job, Close> job_;

    void check(ngpt_status status) {
        if (status != NGPT_OK) throw std::runtime_error(ngpt_message(job_.get()));
    }
};
