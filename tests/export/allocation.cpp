// Lets the n-th `new` fail, for every n, in everything that the C library does, alone or with all that follow: the
// answer must be NGPT_OUT_OF_MEMORY.
//
//     allocation NETWORK        prints for each call how many failed, and how many of those it survived
//
// To be linked with the sources, with a standard library of its own, and with `new` hidden from ONNX Runtime, so that
// only what libngpt asks for fails.
#include <ngpt.h>

#include <cassert>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <new>
#include <vector>

static thread_local long until = -1;  // allocations of this thread that still succeed
static bool for_good;
static long failed;

void *operator new(size_t size) {
    if (until == 0) {
        failed++;
        until = for_good ? 0 : -1;
        throw std::bad_alloc();
    }
    if (until > 0) until--;
    if (void *made = std::malloc(size)) return made;
    throw std::bad_alloc();
}
void *operator new[](size_t size) { return operator new(size); }
void operator delete(void *made) noexcept { std::free(made); }
void operator delete(void *made, size_t) noexcept { std::free(made); }
void operator delete[](void *made) noexcept { std::free(made); }
void operator delete[](void *made, size_t) noexcept { std::free(made); }

// `call` says whether it ended as if nothing had failed.
template <typename Call> static void each(const char *what, Call call) {
    long tried = 0, survived = 0;
    for (const bool mode : {false, true})
        for (long n = 0, before = -1; before != failed; n++) {
            before = failed, for_good = mode, until = n;
            const bool done = call();
            until = -1;
            if (before != failed) tried++, survived += done;
        }
    assert(call());
    std::printf("%s: %ld, survived %ld\n", what, tried, survived);
}

int main(int count, char **arguments) {
    assert(count == 2);
    constexpr int width = 24, height = 20;
    std::vector<float> pixels(3 * width * height), image(pixels);
    char message[64];
    each("open", [&] {
        ngpt_network *network = ngpt_open(arguments[1], 1, message, sizeof message);
        // std::bad_alloc by itself, or with the words around it
        assert(network ? !*message : std::strstr(message, "memory") || std::strstr(message, "alloc"));
        ngpt_close(network);
        return network != nullptr;
    });
    ngpt_network *network = ngpt_open(arguments[1], 1, message, sizeof message);
    each("job", [&] {
        ngpt_job *job = ngpt_job_new(network);
        ngpt_job_free(job);
        return job != nullptr;
    });
    each("metadata", [&] {
        assert(!ngpt_metadata(network, "a key that is so long that a text of it is allocated"));
        return true;
    });
    ngpt_job *job = ngpt_job_new(network);
    const auto told = [&](ngpt_status status) {
        assert(status == NGPT_OK || status == NGPT_OUT_OF_MEMORY);
        assert(!status == !*ngpt_message(job));
        return status == NGPT_OK;
    };
    each("layer", [&] { return told(ngpt_set_layer(job, "primal", pixels.data(), NGPT_FLOAT, 3, 0, 0, 0)); });
    each("output", [&] { return told(ngpt_set_output(job, "image", image.data(), NGPT_FLOAT, 3, 0, 0, 0)); });
    each("a wrong name", [&] {
        const ngpt_status status = ngpt_set_layer(job, "a name that no network has, so long that it is allocated",
                                                  pixels.data(), NGPT_FLOAT, 3, 0, 0, 0);
        assert(status == NGPT_BAD_ARGUMENT || status == NGPT_OUT_OF_MEMORY);
        return status == NGPT_BAD_ARGUMENT;
    });
    const auto whole = [&] { return told(ngpt_run(job, width, height, 0, nullptr, nullptr)); };
    each("run", whole);
    each("tiles", [&] { return told(ngpt_run(job, width, height, 5, nullptr, nullptr)); });
    each("progress", [&] {
        return told(ngpt_run(job, width, height, 5, [](void *, double) { return 0; }, nullptr));
    });
    each("prepare", [&] { return told(ngpt_prepare(job, width, height, nullptr, nullptr)); });
    assert(whole());
    ngpt_job_free(job);
    ngpt_close(network);
}
