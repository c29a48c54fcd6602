/* What discrete.c needs of a kernel: a native step with its initialization and its outputs.
 * Each has a file of its own; its numbers are in the generated model.c, its changing state is
 * `memory`. */
#ifndef DISCRETE_H
#define DISCRETE_H

#include "model.h"

#if defined __GNUC__ && !defined _WIN32
#pragma GCC visibility push(hidden)
#endif

extern const int32_t kernel_memory;          /* doubles of `memory` */
extern const int32_t model_steps_per_sample; /* communication steps between two samples */
extern const double model_period;            /* between two samples [s]; 0: any step */
/* It samples its inputs too and holds them, as a digital controller does: all steps between two
 * samples are one. Else it takes every communication step. */
extern const int32_t model_is_zero_order_hold;

/* Initialize at t with inputs u; `last` takes outputs that are no function of `memory` and the
 * inputs. */
void kernel_initialize(double *memory, double t, const double *u, double *last);
/* Outputs at t, the time reached; `last` are those of the step before. */
void kernel_outputs(double *memory, double t, const double *u, const double *last, double *y);
const char *kernel_step(double *memory, double t0, double t1, double h, const double *u0,
                        const double *u1, double *y);
/* dy_row/du_input at the time reached; y: scratch of p doubles. */
double kernel_by_input(double *memory, double *y, double t, const double *u, int32_t row,
                       int32_t input, int in_initialization);

#if defined __GNUC__ && !defined _WIN32
#pragma GCC visibility pop
#endif

#endif
