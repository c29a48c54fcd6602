/* The regressor: products mu of the delayed input (cosim_regressor). */
#include "discrete.h"

extern const cosim_regressor kernel_constants;

static cosim_regressor kernel(double *memory)
{
    cosim_regressor k = kernel_constants;
    k.memory = memory;
    return k;
}

void kernel_initialize(double *memory, double t, const double *u, double *last)
{
    (void)t, (void)u;
    for (int32_t k = 0; k < kernel_memory; ++k)
        memory[k] = 0.0;
    for (int32_t k = 0; k < model_p; ++k)
        last[k] = 0.0;
}

void kernel_outputs(double *memory, double t, const double *u, const double *last, double *y)
{
    (void)last;
    const cosim_regressor k = kernel(memory);
    cosim_regressor_outputs(&k, t, u, y);
}

const char *kernel_step(double *memory, double t0, double t1, double h, const double *u0,
                        const double *u1, double *y)
{
    cosim_regressor k = kernel(memory);
    cosim_regressor_step(&k, t0, t1, h, u0, u1, y);
    return NULL;
}

/* Every product has one factor delta, delayed or not: where it is not, the derivative is the
 * product for delta = 1. The signals among the alphas are other inputs, which `affine` leaves
 * out. */
double kernel_by_input(double *memory, double *y, double t, const double *u, int32_t row,
                       int32_t input, int in_initialization)
{
    (void)u, (void)input, (void)in_initialization;
    const double one = 1.0;
    const cosim_regressor k = kernel(memory);
    if (k.steps[k.row[row]] != 0)
        return 0.0;
    cosim_regressor_outputs(&k, t, &one, y);
    return y[row] == y[row] ? y[row] : 0.0; /* NaN: there is no value yet */
}
