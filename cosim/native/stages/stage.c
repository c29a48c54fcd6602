#include "stage.h"

#include <stdbool.h>
#include <string.h>
#include <time.h>

static double convert(const cosim_sum *sum, double value)
{
    if (!sum->converts)
        return value;
    return (value * sum->factor1 + sum->offset1 - sum->offset2) / sum->factor2;
}

static void add_up(cosim_stage *s, const cosim_sum *sum, double *row)
{
    const cosim_term *terms = s->terms + sum->first;
    double value = sum->offset;
    if (sum->plain)
        value = row[terms->from];
    else
        for (int32_t j = 0; j < sum->terms; ++j)
            value += terms[j].gain * row[terms[j].from];
    value = convert(sum, value);
    s->suspicious |= value - value != 0.0;
    row[sum->to] = value;
}

static void gather(cosim_stage *s, const cosim_member *m, double *row)
{
    for (int32_t i = 0; i < m->copies; ++i) {
        const cosim_copy *copy = s->copies + m->first_copy + i;
        for (int32_t j = 0; j < copy->count; ++j)
            row[copy->to + j] = row[copy->from + j];
    }
    for (int32_t i = 0; i < m->sums; ++i)
        add_up(s, s->sums + m->first_sum + i, row);
    for (int32_t i = 0; i < *m->overridden; ++i)
        row[m->overridden[1 + i]] = m->overrides[i];
}

/* Whether a value is infinite, or NaN that does not mean "no value yet". */
static bool is_bad(double value, bool optional)
{
    const double difference = value - value; /* 0, but for what is not finite */
    if (difference == 0.0)
        return false;
    return !optional || value == value;
}

/* The first of some columns of a member that is bad, counted from its first input; else -1. */
static int32_t first_bad(const cosim_member *m, const double *row, int32_t begin, int32_t end)
{
    for (int32_t j = begin; j < end; ++j)
        if (is_bad(row[m->u + j], m->optional[j]))
            return j;
    return -1;
}

static void trace(cosim_stage *s, const cosim_member *m, const double *row)
{
    if (s->origin >= 0)
        return;
    const int32_t bad = first_bad(m, row, m->n_u, m->n_u + m->n_y);
    if (bad < 0)
        return;
    s->suspicious = 1;
    s->origin = m->u + bad;
    s->origin_value = row[s->origin];
}

static double seconds(void)
{
    struct timespec now;
    timespec_get(&now, TIME_UTC);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static int32_t call(const cosim_stage *s, const cosim_member *m, int32_t kind, double *before,
                    double *row)
{
    const double *t = s->t + s->step;
    if (kind == COSIM_REFRESH)
        return m->outputs ? m->outputs(m->self, t[1], row + m->u, row + m->y) : COSIM_NO_VALUE;
    if (!m->advance)
        return COSIM_NO_VALUE;
    return m->advance(m->self, t[0], t[1], s->h, before + m->u, row + m->u, row + m->y);
}

static int32_t timed_call(const cosim_stage *s, const cosim_member *m, int32_t kind, double *before,
                          double *row)
{
    if (!m->seconds)
        return call(s, m, kind, before, row);
    const double began = seconds();
    const int32_t status = call(s, m, kind, before, row);
    *m->seconds += seconds() - began;
    return status;
}

static int32_t perform(cosim_stage *s, int32_t kind, const cosim_member *m, double *before,
                       double *row)
{
    switch (kind) {
    case COSIM_KEEP:
        memcpy(row + m->y, before + m->y, (size_t)m->n_y * sizeof *row);
        return COSIM_OK;
    case COSIM_GATHER:
        gather(s, m, row);
        return COSIM_OK;
    case COSIM_TRACE:
        trace(s, m, row);
        return COSIM_OK;
    case COSIM_CHECK: /* inputs are sums, or copies of outputs with the same need of a value */
        if (!s->suspicious)
            return COSIM_OK;
        return first_bad(m, row, 0, m->n_u + m->n_y) < 0 ? COSIM_OK : COSIM_NO_VALUE;
    default:
        return timed_call(s, m, kind, before, row);
    }
}

/* Do the operations of a step of the segment; or return the number of the one that is left. */
static int64_t do_step(cosim_stage *s, const cosim_segment *segment)
{
    double *before = s->rows + s->step * s->width, *row = before + s->width;
    if (s->operation == 0) {
        s->suspicious = 0;
        s->origin = -1;
    }
    for (; s->operation < segment->count; ++s->operation) {
        const cosim_operation *operation = s->operations + segment->first + s->operation;
        const cosim_member *members = s->members + operation->first;
        for (int32_t i = 0; i < operation->count; ++i)
            if (perform(s, operation->kind, members + i, before, row) != COSIM_OK)
                return segment->first + s->operation + 1;
    }
    s->operation = 0;
    return 0;
}

static void next_segment(cosim_stage *s)
{
    ++s->segment;
    s->step = s->completed;
    s->operation = 0;
}

int64_t cosim_stage_run(cosim_stage *s, int64_t end, int32_t answer)
{
    if (answer == COSIM_DONE)
        ++s->operation;
    else if (answer == COSIM_OVER)
        next_segment(s);
    while (s->completed < end) {
        const int64_t last = s->completed + s->tile < end ? s->completed + s->tile : end;
        for (; s->segment < s->n_segments; next_segment(s))
            for (; s->step < last; ++s->step) {
                const int64_t left = do_step(s, s->segments + s->segment);
                if (left)
                    return left;
            }
        s->completed = s->step = last;
        s->segment = 0;
    }
    return 0;
}

void cosim_accumulate(int64_t n_rows, int64_t width, const double *rows, double *counts,
                      double *sums, double *squares)
{
    for (int64_t k = 0; k < n_rows; ++k) {
        const double *row = rows + k * width;
        for (int64_t j = 0; j < width; ++j) {
            const bool has_value = row[j] == row[j];
            const double value = has_value ? row[j] : 0.0;
            counts[j] += has_value;
            sums[j] += value;
            squares[j] += value * value;
        }
    }
}

int32_t cosim_held_step(void *self, double t0, double t1, double h, const double *u0,
                        const double *u1, double *y)
{
    const cosim_held *s = self;
    for (int32_t i = 0; i < s->n_u; ++i)
        s->u[i] = s->held[i] ? u0[i] : u1[i];
    const int32_t status = s->step(s->self, t0, t1, h, u0, s->u, y);
    return status == COSIM_OK ? s->outputs(s->self, t1, u1, y) : status;
}

int32_t cosim_held_outputs(void *self, double t, const double *u, double *y)
{
    const cosim_held *s = self;
    return s->outputs(s->self, t, u, y);
}
