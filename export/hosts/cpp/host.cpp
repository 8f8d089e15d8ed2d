// Runs an ngpt model on the layers of one image by libngpt: a host in C++, to learn from and to copy.
//
//     ngpt-host MODEL.onnx FOLDER OUTPUT.pfm [MEMORY [RUNS]]
//
// FOLDER is as `ngpt unpack STACK.exr FOLDER` makes it. MEMORY is what tiles may take, in MiB; 0 for 2048.
// Models that read another denoiser's images run in oidn_host.cpp.

#include "caustic.hpp"

#include <chrono>
#include <cstdio>
#include <cstdlib>

int main(int count, char **arguments) try {
    bool understood = count >= 4 && count <= 6;
    for (int i = 4; i < count; i++)
        understood &= std::string(arguments[i]).find_first_not_of("0123456789") == std::string::npos;
    if (!understood) {
        std::fprintf(stderr, "usage: ngpt-host MODEL.onnx FOLDER OUTPUT.pfm [MEMORY [RUNS]]\n");
        return 2;
    }
    const int memory = count > 4 ? std::atoi(arguments[4]) : 0, runs = count > 5 ? std::max(1, std::atoi(arguments[5])) : 1;
    Network network(arguments[1]);
    for (const std::string &name : network.inputs)
        if (name.rfind("denoised", 0) == 0) throw std::runtime_error("the model reads OIDN's images: use ngpt-oidn-host");
    Layers layers = read_layers(arguments[2], network);
    const Layers light = take_out_caustic(arguments[2], network.inputs, layers);
    for (const auto &[name, layer] : layers) network.give(name, layer);
    const Layer &primal = layers.at("primal");
    Layer image(3, primal.height, primal.width);
    network.take("image", image);
    for (int i = 0; i < runs; i++) {
        const auto start = std::chrono::steady_clock::now();
        network.run(image.width, image.height, memory);
        std::printf("%.1f ms\n", std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - start).count());
    }
    if (!light.empty()) add(image, spread(light));
    write_pfm(arguments[3], image);
} catch (const std::exception &error) {
    std::fprintf(stderr, "ngpt-host: %s\n", error.what());
    return 1;
}
