#include "field_data.h"
#include "functions.h"

#include <math.h>

/* The value on the straight lines between samples; the last one stays, with `hold` every one. */
static double value_at(const cosim_line *line, double t, int64_t before, int32_t hold)
{
    const int is_last = hold || before + 1 == line->count;
    const int64_t after = is_last ? before : before + 1;
    const double distance = is_last ? 1.0 : line->t[after] - line->t[before];
    const double part = (t - line->t[before]) / distance;
    const double first = line->values[before];
    return first + part * (line->values[after] - first);
}

/* The lines at t, and the samples from `first` to before `after`, as many as there are places. */
static int32_t write_row(const cosim_field_data *s, double t, int64_t first, int64_t after,
                         double *y)
{
    if (after - first > s->most)
        return COSIM_OUTSIDE;
    for (int32_t i = 0; i < s->elements; ++i) {
        cosim_line *line = s->lines + i;
        const int64_t before = cosim_last_not_after(line->t, line->count, t, &line->near);
        if (before < 0)
            return COSIM_OUTSIDE;
        *y++ = value_at(line, t, before, s->hold);
    }
    for (int32_t i = 0; i <= s->elements; ++i) {
        const double *column = s->columns + i * s->count;
        for (int64_t k = first; k < first + s->most; ++k)
            *y++ = k < after && isfinite(column[k]) ? column[k] : cosim_no_value();
    }
    return COSIM_OK;
}

/* The number of samples up to t. */
static int64_t samples_until(cosim_field_data *s, double t)
{
    return cosim_last_not_after(s->columns + s->elements * s->count, s->count, t, &s->near) + 1;
}

int32_t cosim_field_data_step(void *self, double t0, double t1, double h, const double *u0,
                              const double *u1, double *y)
{
    (void)h, (void)u0, (void)u1;
    cosim_field_data *s = self;
    if (t1 > s->end)
        return COSIM_OUTSIDE;
    const int64_t first = samples_until(s, t0);
    const int32_t status = write_row(s, t1, first, samples_until(s, t1), y);
    if (status == COSIM_OK)
        *s->before = t0;
    return status;
}
