#ifndef COSIM_STATIC_H
#define COSIM_STATIC_H

#include "cosim.h"

/* Functions of the inputs at the same instant, element by element of y, of `width` elements.
 *
 * y = u within two limits. */
void cosim_limit(int32_t width, double lower, double upper, const double *u, double *y);
/* `count` inputs multiplied; y is divided by those that `divides` names. It is not defined where
 * one of these is 0: there it refuses. */
void cosim_product(int32_t count, int32_t width, const int32_t *divides, const double *u,
                   double *y);
int32_t cosim_product_refuses(int32_t count, int32_t width, const int32_t *divides,
                              const double *u);
/* u1 or u2: the inputs are both and control, u1 counts where control >= threshold. */
void cosim_switch(int32_t width, double threshold, const double *u, double *y);

#endif
