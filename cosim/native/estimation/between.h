#ifndef COSIM_BETWEEN_H
#define COSIM_BETWEEN_H

#include "output_error.h"

/* A plant whose outputs are sampled between communication points, where its inputs are straight
 * lines: x' = A x + B v, y = C x + D v, with v = (u, disturbances). */
typedef struct {
    int32_t most; /* samples in one step */
    int32_t states, outputs, inputs, components;
    int64_t capacity;      /* samples */
    const double *A, *B;   /* (states, states), (states, inputs + components) */
    const double *C, *D;   /* (outputs, states), (outputs, inputs + components) */
    const uint8_t *held;   /* (inputs + components) zero-order hold over the step */
} cosim_between;
int64_t cosim_between_memory(const cosim_between *self);
/* The number of doubles in a row of its record. */
int64_t cosim_between_width(const cosim_between *self);
/* The record that stands in its memory. */
cosim_between_record cosim_between_in(const cosim_between *self, double *memory, int64_t count);
/* Append the samples of the step from t0 to t1, which the sample `place` of the grid ends; x: the
 * state at t0 without disturbances. `samples` are (outputs, most) values, then `most` instants, NaN
 * where there is none. One at t1, or without an instant, is that of the grid: y becomes it, or
 * NaN. */
int32_t cosim_between_take(const cosim_between *self, int64_t place, double t0, double t1,
                           const double *x, const double *u0, const double *u1,
                           const double *samples, cosim_between_record *record, double *y);

#endif
