/* Every function of the C library, once and again, in one process: with what is right, wrong, and cancelled. */
#include <assert.h>
#include <ngpt.h>
#include <stdlib.h>
#include <string.h>

static int cancel(void *user, double fraction) {
    (void)fraction;
    return ++*(int *)user > 1;
}

int main(int count, char **arguments) {
    char message[64];
    int turn, calls, i, width = 700, height = 20;
    assert(count == 3 && !ngpt_open("none.onnx", 0, message, sizeof message));
    for (turn = 0; turn < atoi(arguments[2]); turn++) {
        ngpt_network *network = ngpt_open(arguments[1], 1, message, sizeof message);
        ngpt_job *job = ngpt_job_new(network);
        float *pixels = (float *)malloc(sizeof(float) * 3 * width * height);
        assert(job && !strcmp(message, ""));
        for (i = 0; i < 3 * width * height; i++) pixels[i] = (float)i;
        for (i = 0; i < ngpt_layer_count(network); i++)
            if (strcmp(ngpt_layer_name(network, i), "base"))
                assert(!ngpt_set_layer(job, ngpt_layer_name(network, i), pixels, NGPT_FLOAT, 3, 0, 0, 0));
        assert(ngpt_run(job, width, height, 0, NULL, NULL) == NGPT_MISSING_LAYER);
        assert(!ngpt_set_output(job, "image", pixels, NGPT_FLOAT, 3, 0, 0, 0));
        assert(ngpt_set_output(job, "picture", pixels, NGPT_FLOAT, 3, 0, 0, 0) == NGPT_BAD_ARGUMENT);
        calls = 0;
        assert(ngpt_run(job, width, height, 25, cancel, &calls) == NGPT_CANCELLED);
        assert(ngpt_run(job, width, height, 25, NULL, NULL) == NGPT_OK);
        assert(ngpt_run(job, width, height, 0, NULL, NULL) == NGPT_OK);
        assert(ngpt_prepare(job, width, height, NULL, NULL) == NGPT_OK);
        ngpt_close(network);
        assert(ngpt_run(job, width, height, 0, NULL, NULL) == NGPT_OK);
        ngpt_job_free(job);
        free(pixels);
    }
    return 0;
}
