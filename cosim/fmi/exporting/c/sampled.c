/* A linear model discretized for its own step, with a zero-order hold of its inputs (cosim_linear).
 * memory: x, then scratch. */
#include "discrete.h"

extern const cosim_linear kernel_constants;
extern const double kernel_X0[];

void kernel_initialize(double *memory, double t, const double *u, double *last)
{
    (void)t;
    for (int32_t k = 0; k < kernel_constants.n; ++k)
        memory[k] = kernel_X0[k];
    kernel_outputs(memory, t, u, last, last);
}

void kernel_outputs(double *memory, double t, const double *u, const double *last, double *y)
{
    (void)t, (void)last;
    const cosim_linear *k = &kernel_constants;
    cosim_multiply(k->p, k->n, k->C, memory, y);
    cosim_multiply_add(k->p, k->m, k->D, u, y);
}

const char *kernel_step(double *memory, double t0, double t1, double h, const double *u0,
                        const double *u1, double *y)
{
    cosim_linear k = kernel_constants;
    k.memory = memory;
    cosim_linear_step(&k, t0, t1, h, u0, u1, y);
    return NULL;
}

double kernel_by_input(double *memory, double *y, double t, const double *u, int32_t row,
                       int32_t input, int in_initialization)
{
    (void)memory, (void)y, (void)t, (void)u, (void)in_initialization;
    return kernel_constants.D[row * kernel_constants.m + input];
}
