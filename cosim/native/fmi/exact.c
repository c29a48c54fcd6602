#include "exact.h"

#include <stdbool.h>

/* Whether an input that changes in events only differs from what the model has. */
static bool jumps(int32_t count, const int32_t *events, const double *inputs, const double *u)
{
    for (int32_t i = 0; i < count; ++i)
        if (u[events[i]] != inputs[events[i]])
            return true;
    return false;
}

int32_t cosim_exact_step(void *self, double t0, double t1, double h, const double *u0,
                         const double *u1, double *y)
{
    cosim_exact *s = self;
    if (!s->allowed || jumps(s->n_events, s->events, s->inputs, u0))
        return COSIM_NO_VALUE;
    const int32_t status = cosim_linear_step(&s->linear, t0, t1, h, u0, u1, y);
    for (int32_t j = 0; j < s->linear.m; ++j)
        s->inputs[j] = u1[j];
    for (int32_t i = 0; i < s->n_events; ++i)
        s->inputs[s->events[i]] = u0[s->events[i]];
    s->t = t1;
    s->moved = 1;
    return status;
}

int32_t cosim_exact_outputs(void *self, double t, const double *u, double *y)
{
    cosim_exact *s = self;
    if (!s->allowed || jumps(s->n_events, s->events, s->inputs, u))
        return COSIM_NO_VALUE;
    return cosim_linear_outputs(&s->linear, t, u, y);
}
