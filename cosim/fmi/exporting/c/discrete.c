/* A model that lives at the communication points, around one of the kernels.
 * memory: steps since the last answer, time and inputs (m) then, the answer (p), the kernel's own. */
#include "discrete.h"

typedef struct {
    double *count, *begin, *kept, *last, *own;
} parts;

static parts split(double *memory)
{
    double *kept = memory + 2, *last = kept + model_m;
    return (parts){memory, memory + 1, kept, last, last + model_p};
}

void model_start(double *memory, const double *x0, double t, const double *u)
{
    (void)x0;
    const parts s = split(memory);
    *s.count = 0.0;
    kernel_start(s.own, t, u, s.last);
}

void model_outputs(double *memory, double t, const double *u, double *y, double *dx)
{
    (void)dx;
    const parts s = split(memory);
    if (*s.count == 0.0)
        kernel_outputs(s.own, t, u, s.last, y);
    else
        for (int32_t k = 0; k < model_p; ++k)
            y[k] = s.last[k];
}

/* The step of the kernel: from the last answer where it holds, else this one. */
static const char *step(const parts *s, double t0, double t1, double h, const double *u0, const double *u1, double *y)
{
    const double exact = model_step_ns > 0 ? (double)model_step_ns / 1e9 : h; /* what the importer says is that up to rounding */
    if (!model_holds)
        return kernel_step(s->own, t0, t1, exact, u0, u1, y);
    if (*s->count + 1.0 < model_every)
        return NULL;
    return kernel_step(s->own, *s->begin, t1, (double)(model_step_ns * model_every) / 1e9, s->kept, u1, y);
}

const char *model_advance(double *memory, double *work, double t0, double t1, double h, const double *u0, const double *u1, double *y)
{
    (void)work;
    const parts s = split(memory);
    if (*s.count == 0.0) {
        *s.begin = t0;
        for (int32_t j = 0; j < model_m; ++j)
            s.kept[j] = u0[j];
        kernel_outputs(s.own, t0, u0, s.last, y);
        for (int32_t k = 0; k < model_p; ++k)
            s.last[k] = y[k];
    }
    const char *wrong = step(&s, t0, t1, h, u0, u1, y);
    if (wrong)
        return wrong;
    *s.count = *s.count + 1.0 < model_every ? *s.count + 1.0 : 0.0;
    if (*s.count == 0.0)
        for (int32_t k = 0; k < model_p; ++k)
            s.last[k] = y[k];
    return NULL;
}

double model_by_input(double *memory, double *work, double t, const double *u, model_unknown of, int32_t row, int32_t input, int at_start)
{
    const parts s = split(memory);
    if (of != MODEL_OUTPUT || *s.count != 0.0)
        return 0.0;
    return kernel_by_input(s.own, work, t, u, row, input, at_start);
}

double model_by_state(model_unknown of, int32_t row, int32_t state)
{
    (void)of, (void)row, (void)state; /* there are no continuous states */
    return 0.0;
}
