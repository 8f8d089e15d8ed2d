#include "graph.hpp"

#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <memory>
#include <mutex>

namespace ngpt {
namespace {

// What a message of the format may have at most: 2 GiB.
constexpr uintmax_t LARGEST_FILE = 0x7fffffff;

// The functions of the library that is loaded: constants, and the same for all handles.
void find_runtime() {
    static std::once_flag once;
    std::call_once(once, [] {
        // Official builds send telemetry by themselves, unless this is set before the first environment is made.
#ifdef _WIN32
        if (!std::getenv("ORT_DISABLE_TELEMETRY")) _putenv_s("ORT_DISABLE_TELEMETRY", "1");
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

void add_cuda(Ort::SessionOptions &options) {
    OrtCUDAProviderOptionsV2 *made = nullptr;
    Ort::ThrowOnError(Ort::GetApi().CreateCUDAProviderOptions(&made));
    const std::unique_ptr<OrtCUDAProviderOptionsV2, decltype(OrtApi::ReleaseCUDAProviderOptions)> held(
        made, Ort::GetApi().ReleaseCUDAProviderOptions);
    options.AppendExecutionProvider_CUDA_V2(*made);
}

void add_tensorrt(Ort::SessionOptions &options) {
    OrtTensorRTProviderOptionsV2 *made = nullptr;
    Ort::ThrowOnError(Ort::GetApi().CreateTensorRTProviderOptions(&made));
    const std::unique_ptr<OrtTensorRTProviderOptionsV2, decltype(OrtApi::ReleaseTensorRTProviderOptions)> held(
        made, Ort::GetApi().ReleaseTensorRTProviderOptions);
    options.AppendExecutionProvider_TensorRT_V2(*made);
}

// The names of ngpt/network/run_onnx.py.
const struct {
    const char *name, *provider;
    void (*add)(Ort::SessionOptions &);
} DEVICES[] = {
    {"cpu", "CPUExecutionProvider", [](Ort::SessionOptions &) {}},
    {"cuda", "CUDAExecutionProvider", add_cuda},
    {"tensorrt", "TensorrtExecutionProvider", add_tensorrt},
    {"openvino", "OpenVINOExecutionProvider", [](auto &options) { options.AppendExecutionProvider("OpenVINO"); }},
    {"directml", "DmlExecutionProvider", [](auto &options) { options.AppendExecutionProvider("DML"); }},
    {"coreml", "CoreMLExecutionProvider", [](auto &options) { options.AppendExecutionProvider("CoreML"); }},
};

void use(const std::string &name, Ort::SessionOptions &options) {
    const std::vector<std::string> available = Ort::GetAvailableProviders();
    std::string have;
    for (const auto &device : DEVICES) {
        if (std::find(available.begin(), available.end(), device.provider) == available.end()) continue;
        have += (have.empty() ? "" : ", ") + std::string(device.name);
        if (name != device.name) continue;
        try {
            return device.add(options);
        } catch (const Ort::Exception &error) {
            throw Failure(NGPT_FAILED,
                          "device '" + name + "': ONNX Runtime cannot use it here (drivers?): " + error.what());
        }
    }
    throw Failure(NGPT_BAD_ARGUMENT, "device '" + name + "': no, this ONNX Runtime has: " + have);
}

// Read here, since ONNX Runtime has another kind of paths on Windows.
std::string contents(const std::string &name) {
    const auto path = std::filesystem::u8path(name);
    std::error_code error;
    // Devices and pipes have no end.
    const uintmax_t size = std::filesystem::is_regular_file(path, error) ? std::filesystem::file_size(path, error) : 0;
    if (!error && size > LARGEST_FILE) throw Failure(NGPT_BAD_NETWORK, name + ": has more than 2 GiB, no network has");
    std::string data(error ? 0 : size_t(size), 0);
    std::ifstream file(path, std::ios::binary);
    if (data.empty() || !file.read(data.data(), std::streamsize(data.size())))
        throw Failure(NGPT_BAD_NETWORK, name + ": cannot be read, or is empty");
    return data;
}

// The shape of a tensor of float32; others would be read as such.
std::vector<int64_t> shape(const std::string &path, const std::string &name, const Ort::TypeInfo &type) {
    if (type.GetONNXType() == ONNX_TYPE_TENSOR) {
        const auto tensor = type.GetTensorTypeAndShapeInfo();
        if (tensor.GetElementType() == ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT) return tensor.GetShape();
    }
    throw Failure(NGPT_BAD_NETWORK, path + ": its " + name + " is no tensor of float32; export it anew");
}

}  // namespace

bool tells_of_memory(const char *message) {
    return std::strstr(message, "allocate memory") || std::strstr(message, "bad_alloc");
}

Ort::Env environment() {
    find_runtime();
    // What goes wrong comes as an exception; in the log it would stand a second time.
    Ort::Env made(ORT_LOGGING_LEVEL_FATAL, "ngpt");
    made.DisableTelemetryEvents();
    return made;
}

Graph load(const Ort::Env &environment, const std::string &path, const std::string &device, int threads) {
    Ort::SessionOptions options;
    options.SetLogSeverityLevel(ORT_LOGGING_LEVEL_FATAL);
    options.SetIntraOpNumThreads(threads);
    // Threads that wait for each other would keep their cores busy, which what works beside them then lacks.
    options.AddConfigEntry("session.intra_op.allow_spinning", "0");
    // ONNX Runtime 1.21 gives the nodes it makes here one name, since ours have none, and then refuses the model.
    options.AddConfigEntry("optimization.disable_specified_optimizers", "GatherSliceToSplitFusion");
    use(device, options);
    const std::string data = contents(path);
    Graph graph;
    try {
        graph.session = Ort::Session(environment, data.data(), data.size(), options);
    } catch (const Ort::Exception &error) {
        throw Failure(tells_of_memory(error.what()) ? NGPT_OUT_OF_MEMORY : NGPT_BAD_NETWORK,
                      path + ": ONNX Runtime cannot load it: " + error.what());
    }
    Ort::AllocatorWithDefaultOptions allocator;
    const auto add = [&](Ort::AllocatedStringPtr name, const Ort::TypeInfo &type) {
        graph.names.push_back(name.get());
        graph.shapes.push_back(shape(path, "input " + graph.names.back(), type));
    };
    graph.must = graph.session.GetInputCount();
    for (size_t i = 0; i < graph.must; i++)
        add(graph.session.GetInputNameAllocated(i, allocator), graph.session.GetInputTypeInfo(i));
    for (size_t i = 0; i < graph.session.GetOverridableInitializerCount(); i++)
        add(graph.session.GetOverridableInitializerNameAllocated(i, allocator),
            graph.session.GetOverridableInitializerTypeInfo(i));
    for (size_t i = 0; i < graph.session.GetOutputCount(); i++) {
        graph.outputs.push_back(graph.session.GetOutputNameAllocated(i, allocator).get());
        shape(path, "output " + graph.outputs.back(), graph.session.GetOutputTypeInfo(i));
    }
    return graph;
}

}  // namespace ngpt
