#include "late_samples.h"

#include <math.h>
#include <string.h>

typedef struct {
    double *count, *oldest, *passed, *y, *rows;
} storage;

static storage storage_of(const cosim_late_samples *s)
{
    double *m = s->memory;
    return (storage){m, m + 1, m + 2, m + 3, m + 3 + s->n_y};
}

/* A row that is held back, from the oldest on: its time, then the inputs of the component. */
static double *row_at(const cosim_late_samples *s, const storage *m, int64_t number)
{
    const int64_t place = ((int64_t)*m->oldest + number) % (s->steps + 1);
    return m->rows + place * (1 + s->n_u);
}

/* Where the sample of the newest row belongs; NULL: nowhere. */
static double *place_of(const cosim_late_samples *s, const storage *m, double instant)
{
    const int64_t newest = (int64_t)*m->count;
    if (!(*m->passed < instant && instant <= row_at(s, m, newest)[0]))
        return NULL;
    int64_t number = 0;
    while (row_at(s, m, number)[0] < instant)
        ++number;
    double *times = row_at(s, m, number) + 1 + s->times;
    for (int32_t k = 0; k < s->most; ++k)
        if (isnan(times[k]))
            return times + k;
    return NULL;
}

/* Write a sample, or NaN, to its place among the times, and the values before these. */
static void write(const cosim_late_samples *s, double *place, double instant, const double *values)
{
    double *samples = place - s->times + s->samples;
    *place = instant;
    for (int32_t i = 0; i < s->values; ++i)
        samples[i * s->most] = values ? values[i] : cosim_no_value();
}

int32_t cosim_late_samples_step(void *self, double t0, double t1, double h, const double *u0,
                                const double *u1, double *y)
{
    (void)t1, (void)u1;
    const cosim_late_samples *s = self;
    const storage m = storage_of(s);
    const double instant = u0[s->shown_times];
    double *row = row_at(s, &m, (int64_t)*m.count), *place = NULL;
    row[0] = t0;
    for (int32_t i = 0; i < s->n_u; ++i)
        row[1 + i] = s->source[i] < 0 ? cosim_no_value() : u0[s->source[i]];
    if (isfinite(instant)) {
        place = place_of(s, &m, instant);
        if (!place)
            return COSIM_OUTSIDE;
        write(s, place, instant, u0 + s->shown_samples);
    }
    if (*m.count < s->steps) {
        *m.count += 1.0;
        memcpy(y, m.y, (size_t)s->n_y * sizeof *y);
        return COSIM_OK;
    }
    const double *first = row_at(s, &m, 0), *second = row_at(s, &m, 1);
    const int32_t status =
        s->inner.step(s->inner.self, first[0], second[0], h, first + 1, second + 1, y);
    if (status != COSIM_OK) {
        if (place) /* whoever takes this step places it again */
            write(s, place, cosim_no_value(), NULL);
        return status;
    }
    memcpy(m.y, y, (size_t)s->n_y * sizeof *y);
    *m.passed = first[0];
    *m.oldest = (double)(((int64_t)*m.oldest + 1) % (s->steps + 1));
    return COSIM_OK;
}

int32_t cosim_late_samples_outputs(void *self, double t, const double *u, double *y)
{
    (void)t, (void)u;
    const cosim_late_samples *s = self;
    memcpy(y, storage_of(s).y, (size_t)s->n_y * sizeof *y);
    return COSIM_OK;
}
