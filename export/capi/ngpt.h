/* ngpt in C: runs a network of ngpt (a file NETWORK.onnx) on the layers of one image.
 *
 *     network = ngpt_open("ngpt-fast.onnx", 0, message, sizeof message);     once
 *     job = ngpt_job_new(network);                                           one for each thread
 *     ngpt_set_layer(job, "primal", pixels, NGPT_FLOAT, 3, 0, 0, 0);         for each layer it reads
 *     ngpt_set_output(job, "image", image, NGPT_FLOAT, 3, 0, 0, 0);
 *     if (ngpt_run(job, width, height, 0, NULL, NULL) != NGPT_OK) puts(ngpt_message(job));
 *
 * What the layers mean, their signs and units: export/CONTRACT.md. A worked example: docs/embed/c-library.md.
 *
 * Threads: any number may use one network at once. A job belongs to one thread at a time.
 * Handles: NULL is allowed for all of them; what a function then returns says that it could do nothing.
 * Text: paths are UTF-8. Texts that are returned live as long as their handle, messages until the job's next call.
 * Nothing here throws, ends the process, prints, or keeps state outside its handles.
 */
#ifndef NGPT_H
#define NGPT_H

#include <stddef.h>

/* Grows when programs must be compiled anew; `ngpt_abi` tells that of the library. */
#define NGPT_ABI 1

#if defined(_WIN32) && defined(NGPT_BUILD)
#define NGPT_API __declspec(dllexport)
#elif defined(_WIN32)
#define NGPT_API __declspec(dllimport)
#elif defined(__GNUC__)
#define NGPT_API __attribute__((visibility("default")))
#else
#define NGPT_API
#endif

#ifdef __cplusplus
extern "C" {
#endif

typedef struct ngpt_network ngpt_network;
typedef struct ngpt_job ngpt_job;

typedef enum ngpt_status {
    NGPT_OK = 0,
    NGPT_BAD_ARGUMENT = 1,  /* NULL, a name that the network does not know, a size or number out of range */
    NGPT_MISSING_LAYER = 2, /* a layer that the network needs, or the output, is not set */
    NGPT_BAD_NETWORK = 3,   /* a file that is damaged, lacks, or belongs to another network */
    NGPT_OUT_OF_MEMORY = 4, /* what is allowed, or what the machine has left, is too little */
    NGPT_CANCELLED = 5,     /* by the progress function */
    NGPT_FAILED = 6         /* ONNX Runtime, or the system */
} ngpt_status;

typedef enum ngpt_format { NGPT_FLOAT = 0, NGPT_HALF = 1 } ngpt_format; /* float32 and IEEE float16, of the machine */

/* The version of ngpt, such as "0.1.0", and NGPT_ABI of the library. */
NGPT_API const char *ngpt_version(void);
NGPT_API int ngpt_abi(void);

/* --- Networks ----------------------------------------------------------------------------------------------------- */

/* Loads a network, and NETWORK.statistics.onnx beside it, which is needed for tiles only.
 *
 * threads  of the processor for each run, 0 for as many as it has cores; at most 1024
 * message  says in one line of UTF-8 what is wrong; `size` bytes, or NULL
 *
 * Returns NULL if it cannot. */
NGPT_API ngpt_network *ngpt_open(const char *path, int threads, char *message, size_t size);

/* The same on a device: NULL or "cpu" (as `ngpt_open`), "cuda", "tensorrt", "openvino", "directml" or "coreml". Returns
 * NULL where this build of ONNX Runtime has no such device, and the message says which it has. What a device cannot do
 * runs on the processor. Layers and images stay in the memory of the processor. */
NGPT_API ngpt_network *ngpt_open_on(const char *device, const char *path, int threads, char *message, size_t size);

/* Jobs of the network stay usable. */
NGPT_API void ngpt_close(ngpt_network *network);

/* The layers that the network reads: how many, and for `index` 0, 1, ... the name, the channels (3, or 1), and whether
 * it must be set. Out of range: NULL, 0, 0. Layers that are not set count as zeros, variances as not known, and `base`
 * is made by the network. */
NGPT_API int ngpt_layer_count(const ngpt_network *network);
NGPT_API const char *ngpt_layer_name(const ngpt_network *network, int index);
NGPT_API int ngpt_layer_channels(const ngpt_network *network, int index);
NGPT_API int ngpt_layer_required(const ngpt_network *network, int index);

/* What the file says of itself under a key such as "ngpt.method", see export/CONTRACT.md; NULL if it says nothing. */
NGPT_API const char *ngpt_metadata(const ngpt_network *network, const char *key);

/* --- Jobs --------------------------------------------------------------------------------------------------------- */

/* A set of layers, and the image to be made of them. Returns NULL without memory. */
NGPT_API ngpt_job *ngpt_job_new(const ngpt_network *network);
NGPT_API void ngpt_job_free(ngpt_job *job);

/* What went wrong in the last call with this job, in one line; "" if nothing did. */
NGPT_API const char *ngpt_message(const ngpt_job *job);

/* Says where the pixels of a layer are. They are read by `ngpt_run` and never written, and must live until then; a job
 * may run again and again with other pixels at the same place.
 *
 * name      of a layer of the network
 * pixels    the first channel of the pixel at the top left; NULL: the layer is not there after all
 * channels  that the image has, as many as the network reads or more, 65536 at most; those beyond are ignored, such as
 *           alpha
 * ..stride  bytes from a channel, pixel or row to the next; 0 for interleaved pixels without gaps, that is for
 *           sizeof(format), channels * sizeof(format), and width times the bytes of a pixel. Rows that begin at the
 *           bottom have a negative stride. */
NGPT_API ngpt_status ngpt_set_layer(ngpt_job *job, const char *name, const void *pixels, ngpt_format format,
                                    int channels, ptrdiff_t channel_stride, ptrdiff_t pixel_stride,
                                    ptrdiff_t row_stride);

/* Says where an image goes that the network makes: "image", or one of those of `ngpt_prepare`. It has three channels or
 * more, of which the first three are written. It is written at the end of a run that succeeds, and only then; so it may
 * lie where a layer is. */
NGPT_API ngpt_status ngpt_set_output(ngpt_job *job, const char *name, void *pixels, ngpt_format format, int channels,
                                     ptrdiff_t channel_stride, ptrdiff_t pixel_stride, ptrdiff_t row_stride);

/* Called by the thread in `ngpt_run` when the run begins, and with each tile, with the part that is done, 0 to 1; and,
 * so that it may cancel, about twenty times a second with the same part again. A small image is one tile. Anything but
 * 0 cancels the run. It must not throw, and not free the job. */
typedef int (*ngpt_progress)(void *user, double fraction);

/* Makes "image", in tiles if need be, which share the statistics of the whole image.
 *
 * width, height  1 to 65536
 * memory         MiB that a tile may take, 0 for 2048; less where the machine has less left. Smaller tiles take
 *                longer, and give the same image to 1e-5. The whole image takes 12 bytes a pixel beside, and, if it is
 *                cut into tiles, 300 for their statistics (700 where the network corrects another denoiser). What the
 *                machine has no room for is refused before anything is made.
 * progress       may be NULL; `user` is passed to it */
NGPT_API ngpt_status ngpt_run(ngpt_job *job, int width, int height, int memory, ngpt_progress progress, void *user);

/* Only for networks that correct another denoiser, which read "denoised": makes what that is to be given, those of
 * "oidn_primal", "oidn_albedo", "oidn_normal", "oidn_base" and "oidn_caustic" that are set as outputs. Call it, then
 * the denoiser, then set "denoised" (and "denoised_base", "denoised_caustic", and oidn_base as "base"), and call
 * `ngpt_run`, which takes over the statistics. It works on the whole image at once, and takes up to 700 bytes a
 * pixel. */
NGPT_API ngpt_status ngpt_prepare(ngpt_job *job, int width, int height, ngpt_progress progress, void *user);

#ifdef __cplusplus
}
#endif

#endif
