/* A discretized linear system, and weighted sums over a window of its steps (cosim_window). */
#include "discrete.h"

extern const cosim_window kernel_constants;
extern const double kernel_X0[], kernel_Xu[];

static cosim_window kernel(double *memory)
{
    cosim_window k = kernel_constants;
    k.memory = memory;
    k.linear.memory = memory;
    return k;
}

void kernel_initialize(double *memory, double t, const double *u, double *last)
{
    const cosim_linear *linear = &kernel_constants.linear;
    for (int32_t k = 0; k < kernel_memory; ++k)
        memory[k] = 0.0;
    cosim_multiply(linear->n, linear->m, kernel_Xu, u, memory);
    for (int32_t k = 0; k < linear->n; ++k)
        memory[k] = kernel_X0[k] + memory[k];
    kernel_outputs(memory, t, u, last, last);
}

void kernel_outputs(double *memory, double t, const double *u, const double *last, double *y)
{
    (void)t, (void)last;
    const cosim_window k = kernel(memory);
    cosim_window_outputs(&k, u, y);
}

const char *kernel_step(double *memory, double t0, double t1, double h, const double *u0,
                        const double *u1, double *y)
{
    cosim_window k = kernel(memory);
    cosim_window_step(&k, t0, t1, h, u0, u1, y);
    return NULL;
}

double kernel_by_input(double *memory, double *y, double t, const double *u, int32_t row,
                       int32_t input, int in_initialization)
{
    (void)t;
    const cosim_window k = kernel(memory);
    const cosim_linear *linear = &k.linear;
    if (row < linear->p) {
        double slope = linear->D[row * linear->m + input];
        if (in_initialization)
            for (int32_t i = 0; i < linear->n; ++i)
                slope += linear->C[row * linear->n + i] * kernel_Xu[i * linear->m + input];
        return slope;
    }
    cosim_window_outputs(&k, u, y);
    if (y[row] != y[row]) /* NaN: there is no value yet */
        return 0.0;
    return k.weights[k.taps - 1] * k.J1[(row - linear->p) * linear->m + input];
}
