// Runs an ngpt model on the layers of one image by libngpt: a host in C++, to learn from and to copy.
//
//     ngpt-host MODEL.onnx FOLDER OUTPUT.pfm [MEMORY [RUNS]]
//
// FOLDER is as `ngpt unpack STACK.exr FOLDER` makes it. MEMORY is what tiles may take, in MiB; 0 for 2048.
// Models that read another denoiser's images run in oidn_host.cpp.

#include "files.hpp"

#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <list>
#include <ngpt.h>

int main(int count, char **arguments) try {
    bool understood = count >= 4 && count <= 6;
    for (int i = 4; i < count; i++)
        understood &= std::string(arguments[i]).find_first_not_of("0123456789") == std::string::npos;
    if (!understood) throw std::invalid_argument("usage: ngpt-host MODEL.onnx FOLDER OUTPUT.pfm [MEMORY [RUNS]]");
    char message[512];
    ngpt_network *network = ngpt_open(arguments[1], 0, message, sizeof message);
    if (!network) throw std::runtime_error(message);
    ngpt_job *job = ngpt_job_new(network);
    const Folder folder(arguments[2]);
    const int width = folder.width, height = folder.height, memory = count > 4 ? std::atoi(arguments[4]) : 0;
    const ptrdiff_t plane = ptrdiff_t(4) * width * height;  // bytes of a channel
    std::list<std::vector<float>> layers;
    for (int i = 0; i < ngpt_layer_count(network); i++) {
        const char *name = ngpt_layer_name(network, i);
        const int channels = ngpt_layer_channels(network, i);
        if (!folder.has(name)) continue;
        layers.push_back(folder.layer(name, channels));
        ngpt_set_layer(job, name, layers.back().data(), NGPT_FLOAT, channels, plane, 4, 4 * width);
    }
    std::vector<float> image(size_t(3) * width * height);
    ngpt_set_output(job, "image", image.data(), NGPT_FLOAT, 3, 0, 0, 0);
    for (int runs = count > 5 ? std::max(1, std::atoi(arguments[5])) : 1; runs > 0; runs--) {
        const auto start = std::chrono::steady_clock::now();
        if (ngpt_run(job, width, height, memory, NULL, NULL) != NGPT_OK) throw std::runtime_error(ngpt_message(job));
        std::printf("%.1f ms\n", std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - start).count());
    }
    write_pfm(arguments[3], image, width, height);
    ngpt_job_free(job);
    ngpt_close(network);
} catch (const std::exception &error) {
    std::fprintf(stderr, "ngpt-host: %s\n", error.what());
    return dynamic_cast<const std::invalid_argument *>(&error) ? 2 : 1;
}
