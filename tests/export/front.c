/* Calls of the C library with arguments at random.
 *
 *     front SEED CALLS NETWORK...  prints how often each status came
 *
 * The library may be given anything but addresses that are not ours. So before each run it is worked out where the
 * pixels would be: a run that would leave its buffer must be one that the library refuses, or is not called.
 */
#include <assert.h>
#include <limits.h>
#include <ngpt.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { NETWORKS = 4, VIEWS = 6, BUFFER = 1 << 16, STATUSES = 7 };

typedef struct {
    char name[24];
    char *pixels;
    int format, channels;
    ptrdiff_t strides[3];
} view;

typedef struct {
    ngpt_network *network;
    ngpt_job *job;
    view views[VIEWS]; /* as the library has them */
    int count;
} place;

static ngpt_network *opened[NETWORKS];
static const char *paths[NETWORKS];
static char *buffers[2];
static long statuses[STATUSES], calls;
static uint64_t state;

static unsigned byte(void) {
    state ^= state << 13, state ^= state >> 7, state ^= state << 17;
    return (unsigned)(state >> 32) & 255;
}

static int chance(unsigned of) { return byte() % of == 0; }

static ptrdiff_t number(void) {
    static const ptrdiff_t rare[] = {0,       1,           -1,          65536,          65537, INT_MAX,
                                     INT_MIN, PTRDIFF_MAX, PTRDIFF_MIN, PTRDIFF_MAX / 65536};
    return chance(4) ? rare[byte() % (sizeof rare / sizeof *rare)] : (ptrdiff_t)(signed char)byte();
}

static int size(void) { return chance(12) ? (int)number() : 1 + (int)(byte() % 24); }

static const char *name(void) {
    static const char *const names[] = {"primal", "image", "statistics", "direct",
                                        "base",   "",      "p",          "\xc3\xa9\xff\x1b[2"};
    return chance(20) ? NULL : names[chance(2) ? byte() % 2 : byte() % 8];
}

static int counted(int status) {
    assert(status >= 0 && status < STATUSES);
    statuses[status]++;
    calls++;
    return status;
}

static void message_fits(const char *message, size_t most) {
    size_t i;
    assert(message && strlen(message) <= most);
    for (i = 0; message[i]; i++) assert((unsigned char)message[i] >= 32 && message[i] != 127);
}

/* Where the pixels of a view are: within its buffer (1), partly outside (0), at no address (-1). */
static int reach(const view *one, long long width, long long height, int channels) {
    const long long counts[3] = {channels, width, height};
    long double stride[3], low = 0, high = one->format ? 2 : 4;
    int i;
    stride[0] = one->strides[0] ? (long double)one->strides[0] : high;
    stride[1] = one->strides[1] ? (long double)one->strides[1] : high * one->channels;
    stride[2] = one->strides[2] ? (long double)one->strides[2] : stride[1] * (long double)width;
    for (i = 0; i < 3; i++) *(stride[i] < 0 ? &low : &high) += stride[i] * (long double)(counts[i] - 1);
    if (low >= -BUFFER / 2 && high <= BUFFER / 2) return 1;
    return high - low > (long double)PTRDIFF_MAX || -low > (long double)(uintptr_t)one->pixels ? -1 : 0;
}

static int ask(void *user, double fraction) {
    place *at = (place *)user;
    assert(fraction >= 0 && fraction <= 1);
    if (chance(3)) message_fits(ngpt_message(at->job), 511);
    return chance(6);
}

static void set(place *at) {
    const int output = chance(3);
    view one;
    const char *chosen = name();
    int i, status;
    memset(&one, 0, sizeof one);
    one.pixels = chance(12) ? NULL : buffers[output] + BUFFER / 2;
    one.format = chance(12) ? (int)number() : (int)(byte() % 2);
    one.channels = chance(6) ? (int)number() : 3;
    for (i = 0; i < 3; i++) one.strides[i] = chance(3) ? number() : 0;
    status = output ? ngpt_set_output(at->job, chosen, one.pixels, (ngpt_format)one.format, one.channels,
                                      one.strides[0], one.strides[1], one.strides[2])
                    : ngpt_set_layer(at->job, chosen, one.pixels, (ngpt_format)one.format, one.channels,
                                     one.strides[0], one.strides[1], one.strides[2]);
    counted(status);
    message_fits(ngpt_message(at->job), 511);
    assert(status == NGPT_BAD_ARGUMENT || status == NGPT_OK);
    if (status) return;
    assert(chosen);
    snprintf(one.name, sizeof one.name, "%s%s", output ? "out " : "", chosen);
    for (i = 0; i < at->count && strcmp(at->views[i].name, one.name); i++) continue;
    if (one.pixels)
        at->views[i] = one, at->count += i == at->count;
    else if (i < at->count)
        at->views[i] = at->views[--at->count];
    assert(at->count < VIEWS);
}

static void run(place *at) {
    const int width = size(), height = size();
    const int memory = chance(6) ? (int)number() : chance(2) ? 0 : 1 + (int)(byte() % 4);
    const ngpt_progress progress = chance(2) ? ask : NULL;
    int i, worst = 1, status;
    for (i = 0; i < at->count && width > 0 && height > 0 && width <= 65536 && height <= 65536; i++) {
        const int found = reach(&at->views[i], width, height, 3);
        worst = found < worst ? found : worst;
    }
    if (worst == 0) return;
    status = counted(chance(3) ? ngpt_prepare(at->job, width, height, progress, at)
                               : ngpt_run(at->job, width, height, memory, progress, at));
    message_fits(ngpt_message(at->job), 511);
    assert(worst >= 0 || status != NGPT_OK);
    assert((width > 0 && height > 0 && width <= 65536 && height <= 65536) || status == NGPT_BAD_ARGUMENT);
    assert(!*ngpt_message(at->job) == !status);
}

static void session(void) {
    place at;
    int turns, i, index = (int)(byte() % NETWORKS);
    char message[64];
    memset(&at, 0, sizeof at);
    if (chance(16)) {
        const size_t room = byte() % (sizeof message + 1);
        const char *device = chance(4) ? name() : "cpu", *path = chance(8) ? name() : paths[index];
        at.network = ngpt_open_on(device, path, size() % 3, message, room);
        counted(at.network ? NGPT_OK : NGPT_BAD_NETWORK);
        if (room) message_fits(message, room - 1);
    }
    at.job = ngpt_job_new(at.network ? at.network : opened[index]);
    assert(at.job);
    if (chance(2)) ngpt_close(at.network), at.network = NULL;
    for (turns = 0; turns < 64; turns++) {
        if (chance(3))
            run(&at);
        else
            set(&at);
        i = (int)number();
        message_fits(ngpt_layer_name(opened[index], i) ? ngpt_layer_name(opened[index], i) : "", 511);
        assert(ngpt_layer_channels(opened[index], i) >= 0 && ngpt_layer_required(opened[index], i) >= 0);
        ngpt_metadata(opened[index], name());
    }
    ngpt_close(at.network);
    ngpt_job_free(at.job);
}

static void prepare(void) {
    int i;
    for (i = 0; i < NETWORKS; i++) assert((opened[i] = ngpt_open(paths[i], 1, NULL, 0)));
    for (i = 0; i < 2; i++) assert((buffers[i] = (char *)calloc(1, BUFFER)));
}

int main(int count, char **arguments) {
    int i;
    assert(count == 3 + NETWORKS);
    state = 0x9e3779b97f4a7c15u ^ (uint64_t)atoll(arguments[1]);
    for (i = 0; i < NETWORKS; i++) paths[i] = arguments[3 + i];
    prepare();
    while (calls < atol(arguments[2])) session();
    for (i = 0; i < NETWORKS; i++) ngpt_close(opened[i]);
    for (i = 0; i < 2; i++) free(buffers[i]);
    for (i = 0; i < STATUSES; i++) printf("%ld%c", statuses[i], i + 1 < STATUSES ? ' ' : '\n');
    return 0;
}
