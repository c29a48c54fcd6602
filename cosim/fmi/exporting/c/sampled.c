/* A linear model discretized for its step (cosim_linear). memory: x, then scratch. */
#include "discrete.h"

extern const cosim_linear kernel_constants;
extern const double kernel_X0[], kernel_Xu[];

void kernel_initialize(double *memory, double t, const double *u, double *last)
{
    (void)t;
    const cosim_linear *k = &kernel_constants;
    cosim_multiply(k->n, k->m, kernel_Xu, u, memory);
    for (int32_t i = 0; i < k->n; ++i)
        memory[i] = kernel_X0[i] + memory[i];
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
    (void)memory, (void)y, (void)t, (void)u;
    const cosim_linear *k = &kernel_constants;
    double slope = k->D[row * k->m + input];
    if (in_initialization)
        for (int32_t i = 0; i < k->n; ++i)
            slope += k->C[row * k->n + i] * kernel_Xu[i * k->m + input];
    return slope;
}
