/* Two stages of their own, each a loop of lags with a sum, a delay and a component that is left to
 * the caller, run in two threads: prints the last row of each. Compiled with sanitizers by
 * test_sanitizers.py; there is no Python in it. */
#include "linear.h"
#include "stage.h"

#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>

enum { LAGS = 20, MEMBERS = LAGS + 2, STEPS = 500, WIDTH = 2 * MEMBERS };

typedef struct {
    double x[LAGS][3], ring[1 + 4];
    double rows[(STEPS + 1) * WIDTH], t[STEPS + 1];
    cosim_linear lags[LAGS];
    cosim_delay delay;
    cosim_member members[MEMBERS];
    cosim_operation operations[2 * MEMBERS + 2];
    cosim_segment segment;
    cosim_copy copies[MEMBERS];
    cosim_sum sum;
    cosim_term terms[2];
    uint8_t optional[2];
    int32_t overridden[2]; /* of all members: none */
    cosim_stage stage;
} system_of_lags;

static const double Ad = 0.998, B0 = 0.001, B1 = 0.001, C = 1.0, D = 0.0;

static void build(system_of_lags *s)
{
    for (int i = 0; i <= STEPS; ++i)
        s->t[i] = 1e-3 * i;
    for (int i = 0; i < MEMBERS; ++i) {
        cosim_member *m = s->members + i;
        *m = (cosim_member){.u = 2 * i, .n_u = 1, .y = 2 * i + 1, .n_y = 1,
                            .copies = s->copies + i, .n_copies = 1, .optional = s->optional,
                            .overridden = s->overridden};
        s->copies[i] = (cosim_copy){2 * i, i ? 2 * i - 1 : WIDTH - 1};
    }
    for (int i = 0; i < LAGS; ++i) {
        s->lags[i] = (cosim_linear){1, 1, 1, &Ad, &B0, &B1, &C, &D, s->x[i]};
        s->x[i][0] = s->rows[2 * i + 1] = 1.0 + i;
        s->members[i].advance = cosim_linear_step;
        s->members[i].outputs = cosim_linear_outputs;
        s->members[i].self = s->lags + i;
    }
    s->delay = (cosim_delay){4, 1, s->ring};
    s->members[LAGS].advance = cosim_delay_step;
    s->members[LAGS].self = &s->delay;
    /* the last one: u = 0.1 + 0.5 y_3 - 0.25 y_delay, advanced by the caller */
    s->members[LAGS + 1].n_copies = 0;
    s->members[LAGS + 1].sums = &s->sum;
    s->members[LAGS + 1].n_sums = 1;
    s->sum = (cosim_sum){.to = WIDTH - 2, .terms = s->terms, .n_terms = 2, .offset = 0.1};
    s->terms[0] = (cosim_term){7, 0.5};
    s->terms[1] = (cosim_term){2 * LAGS + 1, -0.25};
    int n = 0;
    for (int i = 0; i < MEMBERS; ++i)
        s->operations[n++] = (cosim_operation){s->members + i, COSIM_KEEP, 1};
    for (int i = 0; i < MEMBERS; ++i)
        s->operations[n++] = (cosim_operation){s->members + i, COSIM_ADVANCE, 1};
    s->operations[n++] = (cosim_operation){s->members, COSIM_REFRESH, 1};
    s->operations[n++] = (cosim_operation){s->members, COSIM_CHECK, MEMBERS};
    s->segment = (cosim_segment){.operations = s->operations, .count = n};
    s->stage = (cosim_stage){.segments = &s->segment, .n_segments = 1,
                             .width = WIDTH, .tile = 16, .t = s->t, .rows = s->rows,
                             .h = 1e-3};
}

static void *run(void *argument)
{
    system_of_lags *s = argument;
    int32_t answer = COSIM_HERE;
    while (cosim_stage_run(&s->stage, STEPS, answer)) {
        double *row = s->rows + (s->stage.step + 1) * WIDTH;
        row[WIDTH - 1] = 0.5 * row[WIDTH - 2];
        answer = COSIM_DONE;
    }
    return NULL;
}

int main(void)
{
    system_of_lags *systems = calloc(2, sizeof *systems);
    pthread_t threads[2];
    for (int i = 0; i < 2; ++i)
        build(systems + i);
    for (int i = 0; i < 2; ++i)
        pthread_create(threads + i, NULL, run, systems + i);
    for (int i = 0; i < 2; ++i)
        pthread_join(threads[i], NULL);
    for (int i = 0; i < 2; ++i)
        for (int j = 0; j < WIDTH; ++j)
            printf("%a\n", systems[i].rows[STEPS * WIDTH + j]);
    free(systems);
    return 0;
}
