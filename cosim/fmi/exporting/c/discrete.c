/* A model that changes at communication points only, around one of the kernels.
 * memory: steps since the last sample, time, inputs (m) and outputs (p) at that sample, the
 * kernel's memory. */
#include "discrete.h"

typedef struct {
    double *steps, *sample_time, *sample_u, *sample_y, *kernel;
} parts;

static parts split(double *memory)
{
    double *sample_u = memory + 2, *sample_y = sample_u + model_m;
    return (parts){memory, memory + 1, sample_u, sample_y, sample_y + model_p};
}

void model_initialize(double *memory, const double *x0, double t, const double *u)
{
    (void)x0;
    const parts s = split(memory);
    *s.steps = 0.0;
    kernel_initialize(s.kernel, t, u, s.sample_y);
}

void model_outputs(double *memory, double t, const double *u, double *y)
{
    const parts s = split(memory);
    if (*s.steps == 0.0)
        kernel_outputs(s.kernel, t, u, s.sample_y, y);
    else
        for (int32_t k = 0; k < model_p; ++k)
            y[k] = s.sample_y[k];
}

void model_derivatives(const double *memory, double t, const double *u, double *dx)
{
    (void)memory, (void)t, (void)u, (void)dx; /* there are none */
}

/* The step of the kernel: with a zero-order hold one from the last sample to the next, else this
 * one. */
static const char *step(const parts *s, double t0, double t1, double h, const double *u0,
                        const double *u1, double *y)
{
    const double exact = model_step > 0.0 ? model_step : h; /* h is that up to rounding */
    if (!model_is_zero_order_hold)
        return kernel_step(s->kernel, t0, t1, exact, u0, u1, y);
    if (*s->steps + 1.0 < model_steps_per_sample)
        return NULL;
    return kernel_step(s->kernel, *s->sample_time, t1, model_period, s->sample_u, u1, y);
}

const char *model_advance(double *memory, double *work, double t0, double t1, double h,
                          const double *u0, const double *u1, double *y)
{
    (void)work;
    const parts s = split(memory);
    if (*s.steps == 0.0) {
        *s.sample_time = t0;
        for (int32_t j = 0; j < model_m; ++j)
            s.sample_u[j] = u0[j];
        kernel_outputs(s.kernel, t0, u0, s.sample_y, y);
        for (int32_t k = 0; k < model_p; ++k)
            s.sample_y[k] = y[k];
    }
    const char *error = step(&s, t0, t1, h, u0, u1, y);
    if (error)
        return error;
    *s.steps = *s.steps + 1.0 < model_steps_per_sample ? *s.steps + 1.0 : 0.0;
    if (*s.steps == 0.0)
        for (int32_t k = 0; k < model_p; ++k)
            s.sample_y[k] = y[k];
    return NULL;
}

double model_by_input(double *memory, double *work, double t, const double *u, model_unknown of,
                      int32_t row, int32_t input, int in_initialization)
{
    const parts s = split(memory);
    if (of != MODEL_OUTPUT || *s.steps != 0.0)
        return 0.0;
    return kernel_by_input(s.kernel, work, t, u, row, input, in_initialization);
}

double model_by_state(model_unknown of, int32_t row, int32_t state)
{
    (void)of, (void)row, (void)state; /* there are no continuous states */
    return 0.0;
}
