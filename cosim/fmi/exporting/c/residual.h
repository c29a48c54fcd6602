/* What residual.c gives to the generated model.c, and takes from it. */
#ifndef RESIDUAL_H
#define RESIDUAL_H

#include "model.h"

#if defined __GNUC__ && !defined _WIN32
#pragma GCC visibility push(hidden)
#endif

extern const double residual_by_x[], residual_by_z[],
    residual_by_u[]; /* rows of x', y and the residual; row-major */

void residual_outputs(const double *x, const double *z, const double *u, double *dx, double *y);
void residual_values(const double *x, const double *z, const double *u, double *r);
double residual_partial(model_unknown of, int32_t row, model_known by, int32_t column);

#if defined __GNUC__ && !defined _WIN32
#pragma GCC visibility pop
#endif

#endif
