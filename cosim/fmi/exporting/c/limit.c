/* y = u within two limits. */
#include "discrete.h"

extern const double kernel_lower, kernel_upper;

void kernel_start(double *own, double t, const double *u, double *last) { kernel_outputs(own, t, u, last, last); }

void kernel_outputs(double *own, double t, const double *u, const double *last, double *y)
{
    (void)own, (void)t, (void)last;
    for (int32_t k = 0; k < model_p; ++k)
        y[k] = u[k] < kernel_lower ? kernel_lower : u[k] > kernel_upper ? kernel_upper : u[k];
}

const char *kernel_step(double *own, double t0, double t1, double h, const double *u0, const double *u1, double *y)
{
    (void)t0, (void)h, (void)u0;
    kernel_outputs(own, t1, u1, y, y);
    return NULL;
}

double kernel_by_input(double *own, double *y, double t, const double *u, int32_t row, int32_t input, int at_start)
{
    (void)own, (void)y, (void)t, (void)at_start;
    return row == input && u[row] >= kernel_lower && u[row] <= kernel_upper ? 1.0 : 0.0;
}
