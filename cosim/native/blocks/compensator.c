#include "compensator.h"
#include "linear.h"

#include <math.h>
#include <string.h>

static double limited(double value, double lower, double upper)
{
    const double above = value > lower || isnan(value) ? value : lower;
    return above < upper || isnan(above) ? above : upper;
}

/* Whether there is an estimate that was not checked yet. */
static int is_new(const cosim_compensator *s, const double *row)
{
    const size_t width = (size_t)s->parameters * sizeof *row;
    if (!s->follows)
        return 0;
    if (s->parameters == 0)
        return s->memory[s->n_u + s->n_w] == 0.0;
    return memcmp(s->checked, row + s->theta, width) != 0 ||
           memcmp(s->checked + s->parameters, row + s->standard_error, width) != 0;
}

int32_t cosim_compensator_step(void *self, double t0, double t1, double h, const double *u0,
                               const double *u1, double *y)
{
    (void)t0, (void)h;
    const cosim_compensator *s = self;
    double *u = s->memory, *w = u + s->n_u, *active = w + s->n_w;
    double *known = s->work, *internal = known + s->known, *v = internal + s->n_w;
    double *driven = v + s->n_u;
    if (is_new(s, u0))
        return COSIM_NO_VALUE;
    for (int32_t i = 0; i < s->known; ++i)
        known[i] = u0[s->known_columns[i]];
    cosim_multiply(s->n_u, s->known, s->before, known, v);
    if (*active != 0.0) {
        cosim_multiply(s->n_w, s->known, s->X, known, internal);
        for (int32_t i = 0; i < s->n_w; ++i)
            internal[i] = w[i] - internal[i];
        cosim_multiply_add(s->n_u, s->n_w, s->minus_K_w, internal, v);
    }
    for (int32_t i = 0; i < s->n_u; ++i)
        u[i] = limited(v[i], s->lower[i], s->upper[i]);
    if (*active != 0.0) {
        double *error = driven + s->n_w, *rest = error + s->regulated;
        memcpy(driven, w, (size_t)s->n_w * sizeof *w);
        for (int32_t i = 0; i < s->regulated; ++i)
            error[i] = u0[s->regulated_columns[i]] - u0[s->reference + i];
        for (int32_t i = 0; i < s->n_u; ++i)
            rest[i] = u[i] - v[i];
        cosim_multiply(s->n_w, s->n_w + s->regulated + s->n_u, s->generator, driven, w);
    }
    return cosim_compensator_outputs(self, t1, u1, y);
}

int32_t cosim_compensator_outputs(void *self, double t, const double *u, double *y)
{
    (void)t, (void)u;
    const cosim_compensator *s = self;
    memcpy(y, s->memory, (size_t)(s->n_u + s->n_w + 1 + s->parameters) * sizeof *y);
    return COSIM_OK;
}
