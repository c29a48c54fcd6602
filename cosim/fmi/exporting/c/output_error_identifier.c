/* The identifier by output error (cosim_identifier). */
#include "discrete.h"

extern const cosim_identifier kernel_constants;

static cosim_identifier kernel(double *memory)
{
    cosim_identifier k = kernel_constants;
    k.memory = memory;
    return k;
}

void kernel_initialize(double *memory, double t, const double *u, double *last)
{
    (void)t, (void)u;
    cosim_identifier k = kernel(memory);
    cosim_identifier_start(&k, last);
}

void kernel_outputs(double *memory, double t, const double *u, const double *last, double *y)
{
    (void)memory, (void)t, (void)u;
    for (int32_t k = 0; k < model_p; ++k)
        y[k] = last[k];
}

static const char *problem_of(int32_t status)
{
    switch (status) {
    case COSIM_OK:
        return NULL;
    case COSIM_FULL:
        return "there are more communication steps than the run has that this was exported from, "
               "so that there is no room for samples; export it again for a longer one";
    case COSIM_OUTSIDE:
        return "a sample is said to be of an instant that is not since the communication point "
               "before; set those of the step";
    default:
        return "the identifier cannot go on";
    }
}

const char *kernel_step(double *memory, double t0, double t1, double h, const double *u0,
                        const double *u1, double *y)
{
    cosim_identifier k = kernel(memory);
    return problem_of(cosim_identifier_step(&k, t0, t1, h, u0, u1, y));
}

double kernel_by_input(double *memory, double *y, double t, const double *u, int32_t row,
                       int32_t input, int in_initialization)
{
    (void)memory, (void)y, (void)t, (void)u, (void)row, (void)input, (void)in_initialization;
    return 0.0;
}
