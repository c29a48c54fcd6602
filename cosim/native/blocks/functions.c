#include "functions.h"
#include "linear.h"
#include "static.h"

#include <string.h>

int32_t cosim_instant_step(void *self, double t0, double t1, double h, const double *u0,
                           const double *u1, double *y)
{
    (void)t0, (void)h, (void)u0;
    const cosim_instant *s = self;
    return s->at(s->self, t1, u1, y);
}

int32_t cosim_instant_outputs(void *self, double t, const double *u, double *y)
{
    const cosim_instant *s = self;
    return s->at(s->self, t, u, y);
}

/* --- functions of the inputs --- */

int32_t cosim_sum_at(void *self, double t, const double *u, double *y)
{
    (void)t;
    const cosim_signed_sum *s = self;
    for (int32_t k = 0; k < s->width; ++k) {
        double sum = 0.0;
        for (int32_t i = 0; i < s->count; ++i)
            sum += s->signs[i] * u[i * s->width + k];
        y[k] = sum;
    }
    return COSIM_OK;
}

int32_t cosim_gain_at(void *self, double t, const double *u, double *y)
{
    (void)t;
    const cosim_gain *s = self;
    cosim_multiply(s->rows, s->columns, s->K, u, y);
    return COSIM_OK;
}

int32_t cosim_limit_at(void *self, double t, const double *u, double *y)
{
    (void)t;
    const cosim_limits *s = self;
    cosim_limit(s->width, s->lower, s->upper, u, y);
    return COSIM_OK;
}

int32_t cosim_product_at(void *self, double t, const double *u, double *y)
{
    (void)t;
    const cosim_products *s = self;
    if (cosim_product_refuses(s->count, s->width, s->divides, u))
        return COSIM_OUTSIDE;
    cosim_product(s->count, s->width, s->divides, u, y);
    return COSIM_OK;
}

int32_t cosim_switch_at(void *self, double t, const double *u, double *y)
{
    (void)t;
    const cosim_threshold *s = self;
    cosim_switch(s->width, s->threshold, u, y);
    return COSIM_OK;
}

/* --- tables --- */

int64_t cosim_last_not_after(const double *points, int64_t count, double value, int64_t *near)
{
    int64_t low = 0, high = count;
    for (int64_t i = *near; i >= 0 && i < count && i <= *near + 1; ++i)
        if (points[i] <= value && (i + 1 == count || value < points[i + 1])) {
            *near = i;
            return i;
        }
    while (low < high) {
        const int64_t middle = low + (high - low) / 2;
        if (points[middle] <= value)
            low = middle + 1;
        else
            high = middle;
    }
    *near = low - 1;
    return *near;
}

static double limited(double value, double lower, double upper)
{
    if (value < lower)
        return lower;
    return value > upper ? upper : value;
}

/* The cell of a value, and where in it the value is, from 0 to 1. */
typedef struct {
    int64_t first;
    double weight;
} place;

static place place_of(const cosim_look_up *s, cosim_axis *axis, double u)
{
    const double *points = axis->points;
    const int64_t last = axis->count - 2;
    if (s->outside == COSIM_HOLD)
        u = limited(u, points[0], points[axis->count - 1]);
    int64_t cell = cosim_last_not_after(points, axis->count, u, &axis->near);
    cell = cell < 0 ? 0 : cell > last ? last : cell;
    return (place){cell, (u - points[cell]) / (points[cell + 1] - points[cell])};
}

static double between(double weight, double below, double above)
{
    return (1.0 - weight) * below + weight * above;
}

int32_t cosim_look_up_at(void *self, double t, const double *u, double *y)
{
    (void)t;
    cosim_look_up *s = self;
    if (s->outside == COSIM_REFUSE)
        for (int32_t i = 0; i < s->inputs; ++i) {
            const cosim_axis *axis = s->axes + i;
            if (u[i] < axis->points[0] || u[i] > axis->points[axis->count - 1])
                return COSIM_OUTSIDE;
        }
    const place first = place_of(s, s->axes, u[0]);
    if (s->inputs == 1) {
        const double *cell = s->values + first.first;
        y[0] = between(first.weight, cell[0], cell[1]);
        return COSIM_OK;
    }
    const place second = place_of(s, s->axes + 1, u[1]);
    const int64_t columns = s->axes[1].count;
    const double *below = s->values + first.first * columns + second.first;
    const double *above = below + columns;
    y[0] = between(first.weight, between(second.weight, below[0], below[1]),
                   between(second.weight, above[0], above[1]));
    return COSIM_OK;
}

int32_t cosim_table_at(void *self, double t, const double *u, double *y)
{
    (void)u;
    cosim_table *s = self;
    const double begin = s->t[0], end = s->t[s->count - 1];
    if (!s->extrapolates && !(begin <= t && t <= end))
        return COSIM_OUTSIDE;
    int64_t row = cosim_last_not_after(s->t, s->count, t, &s->near);
    row = row < 0 ? 0 : row;
    const double *values = s->y + row * s->width, *slopes = s->slopes + row * s->width;
    const double elapsed = limited(t, begin, end) - s->t[row];
    for (int32_t k = 0; k < s->width; ++k)
        y[k] = s->holds ? values[k] : values[k] + slopes[k] * elapsed;
    return COSIM_OK;
}

int32_t cosim_recorded_at(void *self, double t, const double *u, double *y)
{
    (void)u;
    cosim_recorded *s = self;
    if (t > s->t[s->count - 1])
        return COSIM_OUTSIDE;
    const int64_t row = cosim_last_not_after(s->t, s->count, t, &s->near);
    if (row < 0)
        return COSIM_OUTSIDE;
    memcpy(y, s->rows + row * s->stride, (size_t)s->width * sizeof *y);
    return COSIM_OK;
}

/* --- other functions of t --- */

int32_t cosim_linear_source_at(void *self, double t, const double *u, double *y)
{
    (void)u;
    const cosim_linear_source *s = self;
    for (int32_t i = 0; i < s->count; ++i)
        y[i] = cosim_evaluate(&s->programs[i], t);
    for (int32_t k = 0; k < s->responses; ++k) {
        const cosim_linear_response *term = s->terms + k;
        double value;
        cosim_response(term->states, term->G, term->c, term->beta, 1, &t, &value, s->work);
        y[term->element] += cosim_evaluate(term->factor, t) * value;
    }
    return COSIM_OK;
}

int32_t cosim_modulated_at(void *self, double t, const double *u, double *y)
{
    const cosim_modulated *s = self;
    const int32_t status = cosim_inner_outputs(&s->inner, t, u, s->values);
    if (status != COSIM_OK)
        return status;
    memcpy(y, s->values, (size_t)s->width * sizeof *y);
    for (int32_t k = 0; k < s->products; ++k)
        y[s->element[k]] += s->values[s->width + k] * u[s->alpha[k]];
    return COSIM_OK;
}

/* --- rows that were drawn ahead --- */

int32_t cosim_drawn_step(void *self, double t0, double t1, double h, const double *u0,
                         const double *u1, double *y)
{
    (void)t0, (void)h, (void)u0;
    const cosim_drawn *s = self;
    if ((int64_t)*s->next == s->count)
        return COSIM_NO_VALUE;
    *s->next += 1.0;
    return cosim_drawn_outputs(self, t1, u1, y);
}

int32_t cosim_drawn_outputs(void *self, double t, const double *u, double *y)
{
    (void)t, (void)u;
    const cosim_drawn *s = self;
    const double *last = s->rows + ((int64_t)*s->next - 1) * s->width;
    memcpy(y, last, (size_t)s->width * sizeof *y);
    return COSIM_OK;
}
