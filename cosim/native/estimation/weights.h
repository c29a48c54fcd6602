/* Weights of noise. */
#ifndef COSIM_WEIGHTS_H
#define COSIM_WEIGHTS_H

#include "cosim.h"

/* C = L L', row by row, into the lower triangle of L; returns whether there is one. */
int32_t cosim_factorize(int32_t n, const double *C, double *L);

/* W with W C W' = I for the covariance C of noise, (n, n); `deviations` are those of C. None is
 * taken for smaller than `least`, nor for as good as equal to others. C is changed, L is
 * scratch. */
void cosim_noise_weights(int32_t n, double *covariance, const double *least, double *deviations,
                         double *L, double *W);

#endif
