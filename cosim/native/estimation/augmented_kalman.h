#ifndef COSIM_AUGMENTED_KALMAN_H
#define COSIM_AUGMENTED_KALMAN_H

#include "identifier.h"

/* The Kalman filter of x, delta and its derivative, which is a random walk: inputs mu, which is not
 * used, the signals among the alphas, y and u, of which a step takes those at its beginning; output
 * theta. Whenever the samples are a tenth more, and at the last of the run, delta is smoothed over
 * all of them, and theta is what the projection makes of it; between, theta stays. */
typedef struct {
    int32_t terms, signals;                      /* of mu, among the alphas */
    int32_t states, inputs, outputs, parameters; /* states: x, delta, its derivative */
    int64_t capacity;                            /* samples */
    const double *Phi, *B0, *B1; /* (states, states), (states, inputs) for both ends of a step */
    const double *C, *D, *W;     /* (outputs, states), (outputs, inputs), made white by W */
    const double *noise;         /* (2, states) rows whose products are the covariance of a step */
    const double *first_spread;  /* (states) deviations at first */
    double deviation;            /* of the noise of the outputs, made white */
    /* on delta, with a memory of its own for its products; or NULL */
    const cosim_identifier *projection;
    double *memory;
} cosim_augmented_kalman;
int64_t cosim_augmented_kalman_memory(const cosim_augmented_kalman *self);
int64_t cosim_augmented_kalman_state(const cosim_augmented_kalman *self);
/* As of cosim_identifier. */
int64_t cosim_augmented_kalman_samples(const cosim_augmented_kalman *self, const double *state,
                                       int64_t *parts);
/* Smooth over all samples; delta of each. */
void cosim_augmented_kalman_smooth(const cosim_augmented_kalman *self, double *delta);
void cosim_augmented_kalman_start(cosim_augmented_kalman *self, double *y);
int32_t cosim_augmented_kalman_step(void *self, double t0, double t1, double h, const double *u0,
                                    const double *u1, double *y);

#endif
