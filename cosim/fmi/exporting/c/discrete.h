/* What discrete.c asks of a kernel: a step of cosim.h with its start and its outputs. Each has a file of its own; its numbers are
 * in the generated model.c, its changing state is `own`. */
#ifndef DISCRETE_H
#define DISCRETE_H

#include "model.h"

#if defined __GNUC__ && !defined _WIN32
#pragma GCC visibility push(hidden)
#endif

extern const int32_t kernel_memory; /* doubles of `own` */
extern const int32_t model_every; /* communication steps between two answers */
extern const int32_t model_holds; /* it samples its inputs at an answer and takes all those steps as one, as a digital controller does;
                                     else it takes every step */

/* Start at t with inputs u; `last` takes outputs that are no function of `own` and the inputs. */
void kernel_start(double *own, double t, const double *u, double *last);
/* Outputs at t, the time reached; `last` are those of the step before. */
void kernel_outputs(double *own, double t, const double *u, const double *last, double *y);
const char *kernel_step(double *own, double t0, double t1, double h, const double *u0, const double *u1, double *y);
/* dy_row/du_input at the time reached; y: scratch of p doubles. */
double kernel_by_input(double *own, double *y, double t, const double *u, int32_t row, int32_t input, int at_start);

#if defined __GNUC__ && !defined _WIN32
#pragma GCC visibility pop
#endif

#endif
