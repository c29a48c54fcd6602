/* A delay line of whole communication steps (cosim_delay). */
#include "discrete.h"

extern const cosim_delay kernel_constants;
extern const int32_t
    kernel_follows; /* before the first sample arrives y is the initial u, else kernel_initial */
extern const double kernel_initial;

void kernel_initialize(double *memory, double t, const double *u, double *last)
{
    (void)t;
    const int32_t width = kernel_constants.width;
    memory[0] = 0.0;
    for (int32_t k = 0; k < kernel_constants.steps * width; ++k)
        memory[1 + k] = kernel_follows ? u[k % width] : kernel_initial;
    for (int32_t k = 0; k < width; ++k)
        last[k] = memory[1 + k];
}

void kernel_outputs(double *memory, double t, const double *u, const double *last, double *y)
{
    (void)t, (void)u, (void)last;
    const int32_t width = kernel_constants.width;
    for (int32_t k = 0; k < width; ++k)
        y[k] = memory[1 + (int32_t)memory[0] * width + k];
}

const char *kernel_step(double *memory, double t0, double t1, double h, const double *u0,
                        const double *u1, double *y)
{
    cosim_delay k = kernel_constants;
    k.memory = memory;
    cosim_delay_step(&k, t0, t1, h, u0, u1, y);
    return NULL;
}

double kernel_by_input(double *memory, double *y, double t, const double *u, int32_t row,
                       int32_t input, int in_initialization)
{
    (void)memory, (void)y, (void)t, (void)u;
    return in_initialization && kernel_follows && row == input ? 1.0 : 0.0;
}
