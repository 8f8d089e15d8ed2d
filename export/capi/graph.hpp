// ONNX Runtime: found, its devices by name, and graphs loaded from files that may come from anyone.
#pragma once

#include "ngpt.h"

#define ORT_API_MANUAL_INIT
#include <onnxruntime_cxx_api.h>

#include <cstdint>
#include <stdexcept>
#include <string>
#include <vector>

namespace ngpt {

struct Failure : std::runtime_error {
    ngpt_status status;
    Failure(ngpt_status status, const std::string &message) : std::runtime_error(message), status(status) {}
};

// A graph whose inputs and outputs are tensors of float32, with its inputs' names, of which those from `must` on have
// values.
struct Graph {
    Ort::Session session{nullptr};
    std::vector<std::string> names, outputs;
    std::vector<std::vector<int64_t>> shapes;
    size_t must = 0;
};

// What all graphs need. The first one turns telemetry off.
Ort::Env environment();

// Loads a graph onto a device such as "cpu". Throws a Failure for a file that is damaged or has other types, and for
// a device that this build of ONNX Runtime cannot use: there is no other that is taken in silence.
Graph load(const Ort::Env &environment, const std::string &path, const std::string &device, int threads);

// Whether ONNX Runtime's message says so; it has no code of its own for this.
bool tells_of_memory(const char *message);

}  // namespace ngpt
