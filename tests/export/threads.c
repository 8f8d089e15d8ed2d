/* Threads that share a network, and open and close others meanwhile: threads NETWORK THREADS TURNS
 *
 * The network gives `primal` back, so that each result is known to the bit. */
#include <assert.h>
#include <ngpt.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>

enum { WIDTH = 40, HEIGHT = 36, PIXELS = 3 * WIDTH * HEIGHT };

static ngpt_network *shared;
static const char *path;
static int turns;

/* Cancels every third run, after a call that depends on the run. */
static int ask(void *user, double fraction) {
    return *(int *)user % 3 == 0 && fraction > 0;
}

static void *work(void *user) {
    float *pixels = (float *)malloc(PIXELS * sizeof(float)), *image = (float *)malloc(PIXELS * sizeof(float));
    int seed = *(int *)user, turn, i, status;
    for (turn = 0; turn < turns; turn++) {
        ngpt_network *own = turn % 4 == 1 ? ngpt_open(path, 1, NULL, 0) : NULL;
        ngpt_job *job = ngpt_job_new(own ? own : shared);
        assert(job && !ngpt_open("none.onnx", 1, NULL, 0));
        if (turn % 8 == 1) ngpt_close(own), own = NULL;
        for (i = 0; i < PIXELS; i++) pixels[i] = (float)(i * (seed + 1) + turn), image[i] = -1;
        assert(!ngpt_set_layer(job, "primal", pixels, NGPT_FLOAT, 3, 0, 0, 0));
        assert(!ngpt_set_output(job, "image", image, NGPT_FLOAT, 3, 0, 0, 0));
        if (turn % 5 == 0) assert(!ngpt_prepare(job, WIDTH, HEIGHT, NULL, NULL));
        status = ngpt_run(job, WIDTH, HEIGHT, turn % 2 ? 5 : 0, turn % 7 ? ask : NULL, &turn);
        assert(status == (turn % 7 && turn % 3 == 0 ? NGPT_CANCELLED : NGPT_OK));
        for (i = 0; i < PIXELS; i++) assert(image[i] == (status ? -1 : pixels[i]));
        ngpt_job_free(job);
        ngpt_close(own);
    }
    free(pixels);
    free(image);
    return NULL;
}

int main(int count, char **arguments) {
    pthread_t threads[64];
    int seeds[64], i;
    assert(count == 4 && atoi(arguments[2]) <= 64);
    path = arguments[1], turns = atoi(arguments[3]);
    assert((shared = ngpt_open(path, 1, NULL, 0)));
    for (i = 0; i < atoi(arguments[2]); i++) {
        seeds[i] = i;
        assert(!pthread_create(&threads[i], NULL, work, &seeds[i]));
    }
    for (i = 0; i < atoi(arguments[2]); i++) pthread_join(threads[i], NULL);
    ngpt_close(shared);
    return 0;
}
