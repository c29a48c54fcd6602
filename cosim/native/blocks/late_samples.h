#ifndef COSIM_LATE_SAMPLES_H
#define COSIM_LATE_SAMPLES_H

#include "wrapping.h"

/* A component that takes its inputs at the beginning of a step, held back by so many steps until
 * their samples have come. COSIM_OUTSIDE where a sample has no place among the rows. */
typedef struct {
    cosim_inner inner;
    int32_t steps, n_u, n_y; /* inputs and outputs of the component */
    int32_t shown_samples, shown_times, samples, times; /* first columns, as shown and of it */
    int32_t values, most;  /* outputs that are sampled; places for a sample of each in its inputs */
    const int32_t *source; /* (n_u) column that is shown; -1: a place for a sample */
    /* rows that are held back, the oldest of them, time of the last one before, outputs (n_y), rows
     * (steps + 1, 1 + n_u), a ring */
    double *memory;
} cosim_late_samples;
int32_t cosim_late_samples_step(void *self, double t0, double t1, double h, const double *u0,
                                const double *u1, double *y);
int32_t cosim_late_samples_outputs(void *self, double t, const double *u, double *y);

#endif
