#include "between.h"
#include "linear.h"

#include <math.h>

static int32_t n_driving(const cosim_between *s) { return s->inputs + s->components; }

/* Doubles of the rows of one sample. */
int64_t cosim_between_width(const cosim_between *s)
{
    return (int64_t)s->outputs * (s->states + 2 * s->components);
}

int64_t cosim_between_memory(const cosim_between *s)
{
    const int64_t n = s->states, m = n_driving(s), N = n + 2 * m;
    return s->capacity * (1 + cosim_between_width(s) + s->outputs) + n * n + 2 * n * m + 4 * N * N;
}

cosim_between_record cosim_between_in(const cosim_between *s, double *memory, int64_t count)
{
    cosim_between_record record;
    record.count = count;
    record.place = memory;
    record.rows = record.place + s->capacity;
    record.residual = record.rows + s->capacity * cosim_between_width(s);
    return record;
}

/* The inputs at the instant are those on the straight line, (1 - part) u0 + part u1, unless
 * held. */
static void append(const cosim_between *s, const cosim_between_record *record, double elapsed,
                   double part, const double *x, const double *u0, const double *u1,
                   const double *y, int32_t stride)
{
    const int32_t n = s->states, m = n_driving(s), components = s->components;
    double *Ad = record->residual + s->capacity * s->outputs, *B0 = Ad + n * n, *B1 = B0 + n * m;
    double *row = record->rows + record->count * cosim_between_width(s);
    cosim_first_order_hold(n, m, s->A, s->B, elapsed, s->held, Ad, B0, B1, B1 + n * m);
    for (int32_t o = 0; o < s->outputs; ++o) {
        const double *C = s->C + o * n;
        double known = 0.0;
        for (int32_t a = 0; a < n; ++a) {
            double sum = 0.0;
            for (int32_t b = 0; b < n; ++b)
                sum += C[b] * Ad[b * n + a];
            row[a] = sum;
            known += sum * x[a];
        }
        for (int32_t i = 0; i < m; ++i) {
            double start = 0.0, end = s->D[o * m + i];
            for (int32_t b = 0; b < n; ++b) {
                start += C[b] * B0[b * m + i];
                end += C[b] * B1[b * m + i];
            }
            const double weight = s->held[i] ? 0.0 : part;
            start += (1.0 - weight) * end;
            end *= weight;
            if (i < s->inputs) {
                known += start * u0[i] + end * u1[i];
            } else {
                row[n + i - s->inputs] = start;
                row[n + components + i - s->inputs] = end;
            }
        }
        record->residual[record->count * s->outputs + o] = y[o * stride] - known;
        row += n + 2 * components;
    }
}

int32_t cosim_between_take(const cosim_between *s, int64_t place, double t0, double t1,
                           const double *x, const double *u0, const double *u1,
                           const double *samples, cosim_between_record *record, double *y)
{
    const double *instants = samples + s->outputs * s->most;
    for (int32_t o = 0; o < s->outputs; ++o)
        y[o] = NAN;
    for (int32_t i = 0; i < s->most; ++i) {
        const double t = instants[i];
        if (isnan(t) || t == t1) {
            for (int32_t o = 0; o < s->outputs; ++o)
                if (!isnan(samples[o * s->most + i]))
                    y[o] = samples[o * s->most + i];
            continue;
        }
        if (!(t0 < t && t < t1))
            return COSIM_OUTSIDE;
        if (record->count == s->capacity)
            return COSIM_FULL;
        record->place[record->count] = (double)place;
        append(s, record, t - t0, (t - t0) / (t1 - t0), x, u0, u1, samples + i, s->most);
        record->count += 1;
    }
    return COSIM_OK;
}
