/* y = u within two limits (cosim_limit). */
#include "discrete.h"

extern const double kernel_lower, kernel_upper;

void kernel_initialize(double *memory, double t, const double *u, double *last)
{
    kernel_outputs(memory, t, u, last, last);
}

void kernel_outputs(double *memory, double t, const double *u, const double *last, double *y)
{
    (void)memory, (void)t, (void)last;
    cosim_limit(model_p, kernel_lower, kernel_upper, u, y);
}

const char *kernel_step(double *memory, double t0, double t1, double h, const double *u0,
                        const double *u1, double *y)
{
    (void)t0, (void)h, (void)u0;
    kernel_outputs(memory, t1, u1, y, y);
    return NULL;
}

double kernel_by_input(double *memory, double *y, double t, const double *u, int32_t row,
                       int32_t input, int in_initialization)
{
    (void)memory, (void)y, (void)t, (void)in_initialization;
    return row == input && u[row] >= kernel_lower && u[row] <= kernel_upper ? 1.0 : 0.0;
}
