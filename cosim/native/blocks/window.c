#include "window.h"

/* The parts of the memory. */
static double *steps_taken(const cosim_window *s) { return s->memory + 2 * s->linear.n; }
static double *newest(const cosim_window *s) { return steps_taken(s) + 1; }
static double *ring(const cosim_window *s) { return newest(s) + s->width; }

/* All weights but the newest, from the oldest increment on: the ring in two pieces. */
static double weighted_sum(const cosim_window *s, int64_t taken, int32_t i)
{
    const int32_t oldest = (int32_t)(taken % s->taps), last = s->taps - 1;
    double sum = 0.0;
    for (int32_t j = 0; j < last; ++j) {
        const int32_t row = oldest + j < s->taps ? oldest + j : oldest + j - s->taps;
        sum += s->weights[j] * ring(s)[row * s->width + i];
    }
    return sum;
}

void cosim_window_outputs(const cosim_window *s, const double *u, double *y)
{
    const cosim_linear *k = &s->linear;
    const int64_t taken = (int64_t)*steps_taken(s);
    double *sums = y + k->p;
    cosim_multiply(k->p, k->n, k->C, k->memory, y);
    cosim_multiply_add(k->p, k->m, k->D, u, y);
    if (taken < s->taps) {
        for (int32_t i = 0; i < s->width; ++i)
            sums[i] = cosim_no_value();
        return;
    }
    for (int32_t i = 0; i < s->width; ++i) {
        double last = newest(s)[i];
        for (int32_t j = 0; j < k->m; ++j)
            last += s->J1[i * k->m + j] * u[j];
        sums[i] = weighted_sum(s, taken, i) + s->weights[s->taps - 1] * last;
    }
}

/* The part of the newest increment that the inputs at the end of its step make is added when they
 * are final, at the start of the next one: an input that is extrapolated first and corrected later
 * does no harm. */
int32_t cosim_window_step(void *self, double t0, double t1, double h, const double *u0,
                          const double *u1, double *y)
{
    cosim_window *s = self;
    const cosim_linear *k = &s->linear;
    const int64_t taken = (int64_t)*steps_taken(s);
    if (taken > 0) {
        double *last = ring(s) + (taken - 1) % s->taps * s->width;
        for (int32_t i = 0; i < s->width; ++i)
            last[i] = newest(s)[i];
        for (int32_t i = 0; i < s->width; ++i)
            for (int32_t j = 0; j < k->m; ++j)
                last[i] += s->J1[i * k->m + j] * u0[j];
    }
    cosim_multiply(s->width, k->n, s->Jx, k->memory, newest(s));
    cosim_multiply_add(s->width, k->m, s->J0, u0, newest(s));
    *steps_taken(s) = (double)(taken + 1);
    cosim_linear_step(&s->linear, t0, t1, h, u0, u1, y);
    cosim_window_outputs(s, u1, y);
    return COSIM_OK;
}
