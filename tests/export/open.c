/* Opens each network that is named, runs it on 8x8 pixels, and prints status and message: open NETWORK... */
#include <assert.h>
#include <ngpt.h>
#include <stdio.h>
#include <stdlib.h>

enum { SIDE = 8, CHANNELS = 16 };

int main(int count, char **arguments) {
    int i, layer;
    for (i = 1; i < count; i++) {
        float *pixels = (float *)calloc(SIDE * SIDE * CHANNELS, sizeof(float));
        float *image = (float *)calloc(SIDE * SIDE * 3, sizeof(float));
        char message[100];
        ngpt_network *network = ngpt_open(arguments[i], 1, message, sizeof message);
        ngpt_job *job = ngpt_job_new(network);
        int status = NGPT_BAD_NETWORK;
        assert(!job == !network && !network == !!*message);
        for (layer = 0; layer < ngpt_layer_count(network); layer++)
            assert(!ngpt_set_layer(job, ngpt_layer_name(network, layer), pixels, NGPT_FLOAT, CHANNELS, 0, 0, 0));
        if (job) {
            assert(!ngpt_set_output(job, "image", image, NGPT_FLOAT, 3, 0, 0, 0));
            ngpt_prepare(job, SIDE, SIDE, NULL, NULL);
            status = ngpt_run(job, SIDE, SIDE, 0, NULL, NULL);
        }
        printf("%d %s\n", status, job ? ngpt_message(job) : message);
        ngpt_job_free(job);
        ngpt_close(network);
        free(pixels);
        free(image);
    }
    return 0;
}
