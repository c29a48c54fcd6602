/* Triangles by Householder's rotations, and what is solved with them. */
#ifndef COSIM_HOUSEHOLDER_H
#define COSIM_HOUSEHOLDER_H

#include "cosim.h"

/* Rotate `rows` rows of n numbers, which are overwritten, into the upper triangular R of shape
 * (n, n): afterwards R'R has grown by the products of the rows. `work` has n doubles. */
void cosim_householder(int32_t n, double *R, int32_t rows, double *block, double *work);
/* Solve R x = b for the upper triangular R (n, n), whose rows are `stride` doubles apart. */
void cosim_solve_upper(int32_t n, int32_t stride, const double *R, const double *b,
                       int32_t b_stride, double *x);
/* The inverse of R'R; `work` has n (n + 1) doubles. */
void cosim_covariance(int32_t n, int32_t stride, const double *R, double *covariance, double *work);

#endif
