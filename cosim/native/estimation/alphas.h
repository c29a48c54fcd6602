#ifndef COSIM_ALPHAS_H
#define COSIM_ALPHAS_H

#include "expression.h"

/* Known factors alpha of a disturbance (4): expressions in t, or signals. */
typedef struct {
    int32_t count, signals;        /* alphas; elements of the input that the signals are */
    const int32_t *element;        /* (count) of that input; -1: an expression */
    const cosim_program *programs; /* (count) */
} cosim_alphas;
void cosim_alphas_at(const cosim_alphas *self, double t, const double *signals, double *values);

/* The same at instants before now; those of signals by linear interpolation between samples. */
typedef struct {
    cosim_alphas alphas;
    int32_t rows;         /* instants */
    int32_t depth;        /* samples that are kept */
    const double *age;    /* (rows) how long before now expressions are read [s] */
    const int32_t *steps; /* (count, rows) how many communication steps signals are */
    const double *part;   /* (count, rows) and what part of one, less than 1 */
} cosim_past_alphas;
/* The number of doubles of `ring`, the samples before now. */
int64_t cosim_past_alphas_memory(const cosim_past_alphas *self);
/* values (count, rows) at t, which `now` samples were before, where the signals are `signals`; no
 * value (NaN) where the past is not long enough. */
void cosim_past_alphas_at(const cosim_past_alphas *self, const double *ring, int64_t now, double t,
                          const double *signals, double *values);
void cosim_past_alphas_keep(const cosim_past_alphas *self, double *ring, int64_t now,
                            const double *signals);

#endif
