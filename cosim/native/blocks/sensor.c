#include "sensor.h"
#include "linear.h"

#include <math.h>
#include <string.h>

#define NANOSECONDS 1e9
#define WHOLE_NUMBERS 0x1p53 /* from here on every double is a whole number */

typedef struct {
    double *since, *next, *oldest, *y, *valid, *past;
} storage;

static storage storage_of(const cosim_sensor *s)
{
    storage m;
    int64_t next = 0;
    m.since = cosim_place(s->memory, &next, 1);
    m.next = cosim_place(s->memory, &next, 1);
    m.oldest = cosim_place(s->memory, &next, 1);
    m.y = cosim_place(s->memory, &next, s->size);
    m.valid = cosim_place(s->memory, &next, s->size);
    m.past = cosim_place(s->memory, &next, (int64_t)s->depth * s->size);
    return m;
}

/* NaN stays; of two zeros the limit counts. */
static double limited(double value, double lower, double upper)
{
    const double above = value > lower || isnan(value) ? value : lower;
    return above < upper || isnan(above) ? above : upper;
}

static double nearest_level(const cosim_sensor *s, int32_t i, double value)
{
    const double number = rint((value - s->origin[i]) / s->resolution[i]);
    /* where doubles are farther apart than the levels, every value is a level */
    if (!(fabs(number) < WHOLE_NUMBERS))
        return value;
    double inside = number;
    if (number < s->first[i])
        inside = s->first[i];
    else if (number > s->last[i])
        inside = s->last[i];
    return s->origin[i] + inside * s->resolution[i];
}

/* The input `position` communication steps after the time reached: on the line of the last step
 * where that is after it. */
static double input_at(const cosim_sensor *s, const storage *m, const double *u, int32_t i,
                       double position)
{
    if (s->depth == 0)
        return u[i];
    const double whole = floor(position) < 0.0 ? floor(position) : 0.0;
    const int64_t before = s->depth + (int64_t)whole;
    const int64_t end = before + 1 < s->depth ? before + 1 : s->depth;
    double known[3]; /* at `before`, before the end of its step, at the end */
    const int64_t rows[] = {before, end - 1, end};
    for (int32_t k = 0; k < 3; ++k) {
        const int64_t row = ((int64_t)*m->oldest + rows[k]) % s->depth;
        known[k] = rows[k] == s->depth ? u[i] : m->past[row * s->size + i];
    }
    const double elapsed = s->held[i] ? 0.0 : position - whole;
    return known[0] + elapsed * (known[2] - known[1]);
}

/* What is measured at the time reached, where the sample has the number `number`. */
static double measured(const cosim_sensor *s, const storage *m, const double *u, int64_t number,
                       int32_t i)
{
    const int64_t place = number * s->size + i;
    const double value = input_at(s, m, u, i, s->position[place]);
    const double within = limited(value + s->bias[i] + s->noise[place], s->lower[i], s->upper[i]);
    if (!s->quantizes)
        return within;
    /* a level is rounded, as the product of its number and the resolution: not beyond a limit */
    return limited(nearest_level(s, i, within), s->lower[i], s->upper[i]);
}

static double sample_time(const cosim_sensor *s, double t, int64_t number)
{
    if (!s->stamps)
        return t;
    const double offset = s->position[number * s->size];
    return rint((t + offset * s->h) * NANOSECONDS) / NANOSECONDS;
}

/* y, valid, and the samples with their time, at the time reached. */
int32_t cosim_sensor_outputs(void *self, double t, const double *u, double *y)
{
    const cosim_sensor *s = self;
    const storage m = storage_of(s);
    const int is_due = (int32_t)*m.since == s->period;
    const int64_t number = (int64_t)*m.next;
    if (is_due && number >= s->drawn)
        return COSIM_NO_VALUE;
    double *valid = s->drops ? y + s->size : NULL;
    double *samples = y + (s->drops ? 2 : 1) * s->size;
    const double time = is_due ? sample_time(s, t, number) : 0.0;
    const int is_new = is_due && time >= s->begin;
    for (int32_t i = 0; i < s->size; ++i) {
        const int is_lost = is_due && s->lost[number * s->size + i] != 0.0;
        const double is_valid = is_due ? !is_lost : m.valid[i];
        y[i] = is_due && !is_lost ? measured(s, &m, u, number, i) : m.y[i];
        if (valid)
            valid[i] = is_valid;
        if (s->samples)
            samples[i] = is_new && !is_lost ? y[i] : cosim_no_value();
    }
    if (s->samples)
        samples[s->size] = is_new ? time : cosim_no_value();
    return COSIM_OK;
}

/* Leave the time reached, with the inputs there, which were extrapolated before. */
static void leave(const cosim_sensor *s, const storage *m, const double *u)
{
    const int64_t number = (int64_t)*m->next;
    if ((int32_t)*m->since == s->period) {
        for (int32_t i = 0; i < s->size; ++i) {
            const int is_lost = s->lost[number * s->size + i] != 0.0;
            if (!is_lost)
                m->y[i] = measured(s, m, u, number, i);
            m->valid[i] = !is_lost;
        }
        *m->next += 1.0;
        *m->since = 0.0;
    }
    *m->since += 1.0;
    if (s->depth == 0)
        return;
    memcpy(m->past + (int64_t)*m->oldest * s->size, u, (size_t)s->size * sizeof *u);
    *m->oldest = (double)(((int64_t)*m->oldest + 1) % s->depth);
}

int32_t cosim_sensor_step(void *self, double t0, double t1, double h, const double *u0,
                          const double *u1, double *y)
{
    (void)t0, (void)h;
    const cosim_sensor *s = self;
    const storage m = storage_of(s);
    /* one sample now and one at the end may be due */
    if ((int64_t)*m.next + 1 >= s->drawn)
        return COSIM_NO_VALUE;
    leave(s, &m, u0);
    return cosim_sensor_outputs(self, t1, u1, y);
}
