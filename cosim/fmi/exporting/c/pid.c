/* A PID controller (cosim_pid): inputs setpoint and measurement, outputs y and integral. */
#include "discrete.h"

extern const cosim_pid kernel_constants;
extern const int32_t kernel_is_sampled;

static cosim_pid with(double *memory)
{
    cosim_pid k = kernel_constants;
    k.memory = memory;
    return k;
}

void kernel_initialize(double *memory, double t, const double *u, double *last)
{
    (void)t;
    const cosim_pid k = with(memory);
    cosim_pid_start(&k, u);
    cosim_pid_outputs(&k, u, last);
}

void kernel_outputs(double *memory, double t, const double *u, const double *last, double *y)
{
    (void)t, (void)last;
    const cosim_pid k = with(memory);
    cosim_pid_outputs(&k, u, y);
}

const char *kernel_step(double *memory, double t0, double t1, double h, const double *u0,
                        const double *u1, double *y)
{
    cosim_pid k = with(memory);
    if (kernel_is_sampled)
        cosim_sampled_pid_step(&k, t0, t1, h, u0, u1, y);
    else
        cosim_pid_step(&k, t0, t1, h, u0, u1, y);
    return NULL;
}

double kernel_by_input(double *memory, double *y, double t, const double *u, int32_t row,
                       int32_t input, int in_initialization)
{
    (void)t;
    const cosim_pid k = with(memory);
    cosim_pid_outputs(&k, u, y);
    if (row != 0 || y[0] <= k.lower || y[0] >= k.upper)
        return 0.0;
    /* initially the filter follows the inputs, so that there is no derivative part */
    const double derivative = in_initialization ? 0.0 : k.derivative_gain;
    if (input == 0)
        return k.gain * k.setpoint_weight + derivative * k.derivative_weight;
    return -k.gain - derivative;
}
