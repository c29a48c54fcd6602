#ifndef COSIM_PREDICTOR_H
#define COSIM_PREDICTOR_H

#include "cosim.h"

/* The Kalman filter without process noise of x' = T x, y = C x + noise of covariance R, for
 * instants at any distances and with outputs that are missing at some. */
typedef struct {
    int32_t states, outputs;
    const double *T; /* (intervals, states, states) */
    const double *C; /* (outputs, states) */
    const double *R; /* (outputs, outputs) */
} cosim_predictor;
/* One sample: K and L as below, and P, that of x there, becomes that of x at the next one, to which
 * T leads; NULL: there is none, and K is 0. */
int32_t cosim_predictor_gain(const cosim_predictor *self, const uint8_t *measured, const double *T,
                             double *P, double *K, double *L, int32_t *there, double *work);
/* For each of `count` samples its gain K (states, outputs), by which y there corrects x at the next
 * one, and L (outputs, outputs) as in cosim_output_error. `interval` ends at the sample, P (states,
 * states) is the covariance of x at the first one; `there` has outputs numbers of scratch, `work`
 * outputs (3 outputs + states) + states^2. COSIM_NO_VALUE: a covariance that is none. */
int32_t cosim_predictor_gains(const cosim_predictor *self, int64_t count, const int32_t *interval,
                              const uint8_t *measured, double *P, double *K, double *L,
                              int32_t *there, double *work);

#endif
