/* One of two inputs, by a third: u1, u2 (model_p elements each), control (cosim_switch). */
#include "discrete.h"

extern const double kernel_threshold;

/* The index of the input that the first element of y is. */
static int32_t chosen(const double *u)
{
    return u[2 * model_p] >= kernel_threshold ? 0 : model_p;
}

void kernel_initialize(double *memory, double t, const double *u, double *last)
{
    kernel_outputs(memory, t, u, last, last);
}

void kernel_outputs(double *memory, double t, const double *u, const double *last, double *y)
{
    (void)memory, (void)t, (void)last;
    cosim_switch(model_p, kernel_threshold, u, y);
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
    return input == chosen(u) + row ? 1.0 : 0.0;
}
