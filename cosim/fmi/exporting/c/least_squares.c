/* The identifier: least squares on the rows of the regressor (cosim_least_squares). */
#include "discrete.h"

extern const cosim_least_squares kernel_constants;

static cosim_least_squares kernel(double *memory)
{
    cosim_least_squares k = kernel_constants;
    k.memory = memory;
    return k;
}

void kernel_initialize(double *memory, double t, const double *u, double *last)
{
    (void)t, (void)u;
    cosim_least_squares k = kernel(memory);
    cosim_least_squares_start(&k, last);
}

void kernel_outputs(double *memory, double t, const double *u, const double *last, double *y)
{
    (void)memory, (void)t, (void)u;
    for (int32_t k = 0; k < model_p; ++k)
        y[k] = last[k];
}

const char *kernel_step(double *memory, double t0, double t1, double h, const double *u0,
                        const double *u1, double *y)
{
    cosim_least_squares k = kernel(memory);
    return cosim_least_squares_step(&k, t0, t1, h, u0, u1, y) == COSIM_OK
               ? NULL
               : "the regressor has no value at the start time; connect one, and start after its "
                 "longest delay";
}

double kernel_by_input(double *memory, double *y, double t, const double *u, int32_t row,
                       int32_t input, int in_initialization)
{
    (void)memory, (void)y, (void)t, (void)u, (void)row, (void)input, (void)in_initialization;
    return 0.0;
}
