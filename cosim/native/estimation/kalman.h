#ifndef COSIM_KALMAN_H
#define COSIM_KALMAN_H

#include "cosim.h"

/* The covariance R'R of n states, R not necessarily triangular, over a step and a measurement. */
/* R'R becomes Phi R'R Phi' + sum q q' over the rows q of `noise`, R triangular. `work` has
 * (n + rows) n + n doubles. */
void cosim_kalman_predict(int32_t n, const double *Phi, int32_t rows, const double *noise,
                          double *R, double *work);
/* Take y = row'x + noise of this variance, where `innovation` is y less row'x, after J. Potter
 * (G. Bierman, Factorization Methods, 1977). `work` has 2 n doubles. */
void cosim_kalman_correct(int32_t n, const double *row, double variance, double innovation,
                          double *x, double *R, double *work);
double cosim_kalman_variance(int32_t n, const double *R, int32_t state);

#endif
