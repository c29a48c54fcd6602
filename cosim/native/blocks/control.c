#include "control.h"
#include "linear.h"

#include <stddef.h>

static double limited(double value, double lower, double upper)
{
    if (value < lower)
        return lower;
    return value > upper ? upper : value;
}

/* --- integrator --- */

/* While the input keeps its sign the integral moves in one direction, so that it stops at its limit
 * if the limit is on its way: the limit of its end. An input that is a straight line changes its
 * sign once at most. */
int32_t cosim_integrator_step(void *self, double t0, double t1, double h, const double *u0,
                              const double *u1, double *y)
{
    (void)t0, (void)t1;
    const cosim_integrator *s = self;
    for (int32_t i = 0; i < s->width; ++i) {
        const double begin = u0[i];
        const double end = s->held[i] ? begin : u1[i];
        double x = s->memory[i];
        if ((begin < 0.0 && end > 0.0) || (begin > 0.0 && end < 0.0)) {
            const double crossing = begin / (begin - end);
            x = limited(x + 0.5 * h * begin * crossing, s->lower, s->upper);
            x += 0.5 * h * end * (1.0 - crossing);
        } else {
            x += 0.5 * h * (begin + end);
        }
        s->memory[i] = limited(x, s->lower, s->upper);
        y[i] = s->memory[i];
    }
    return COSIM_OK;
}

/* --- PID controller --- */

#define BISECTIONS 30
#define CROSSINGS 8 /* in one step; what follows is computed as if there were no more */

static double derivative_input(const cosim_pid *s, const double *u)
{
    return s->derivative_gain * (s->derivative_weight * u[0] - u[1]);
}

static double proportional(const cosim_pid *s, const double *u)
{
    return s->gain * (s->setpoint_weight * u[0] - u[1]);
}

static double integrand(const cosim_pid *s, const double *u)
{
    return s->integral_gain * (u[0] - u[1]);
}

void cosim_pid_start(const cosim_pid *s, const double *u)
{
    s->memory[0] = s->initial_integral;
    s->memory[1] = derivative_input(s, u); /* as if the inputs had been constant before */
}

void cosim_pid_outputs(const cosim_pid *s, const double *u, double *y)
{
    const double derivative = derivative_input(s, u) - s->memory[1];
    const double unlimited = proportional(s, u) + derivative + s->memory[0];
    y[0] = limited(unlimited, s->lower, s->upper);
    y[1] = s->memory[0];
}

/* x' = rate (a - x) over a time, where a is a straight line from a0 to a1. */
static double lag(double rate, double time, double x, double a0, double a1)
{
    const double A = -rate;
    const uint8_t not_held = 0;
    double Ad, B0, B1, work[36];
    cosim_first_order_hold(1, 1, &A, &rate, time, &not_held, &Ad, &B0, &B1, work);
    return Ad * x + B0 * a0 + B1 * a1;
}

/* Straight lines over a step, by the fraction of it that has passed. */
typedef struct {
    double begin, end;
} line;

static double at(line l, double fraction) { return (1.0 - fraction) * l.begin + fraction * l.end; }

/* The integral part from one fraction of a step to a later one, while the output stays at a limit
 * (`side` -1: the lower, 1: the upper) or between them (0). */
static double integral(const cosim_pid *s, double h, line rest, line slope, int side, double x,
                       double from, double to)
{
    const double time = h * (to - from);
    const double slope0 = at(slope, from), slope1 = at(slope, to);
    if (side == 0)
        return x + 0.5 * time * (slope0 + slope1);
    const double limit = side > 0 ? s->upper : s->lower;
    const double a0 = limit - at(rest, from) + slope0 / s->tracking_rate;
    const double a1 = limit - at(rest, to) + slope1 / s->tracking_rate;
    return lag(s->tracking_rate, time, x, a0, a1);
}

static int side_of(const cosim_pid *s, double unlimited)
{
    if (unlimited > s->upper)
        return 1;
    return unlimited < s->lower ? -1 : 0;
}

/* I' = slope + tracking_rate (limited(rest + I) - rest - I): linear on each side of a limit, so
 * solved there in closed form; where the output reaches or leaves a limit is bisected. The right-
 * hand side is continuous there, so that an error of the instant counts squared. */
static double tracked(const cosim_pid *s, double h, line rest, line slope, double x)
{
    double from = 0.0;
    for (int crossings = 0;; ++crossings) {
        const int side = side_of(s, at(rest, from) + x);
        const double end = integral(s, h, rest, slope, side, x, from, 1.0);
        if (side_of(s, rest.end + end) == side || crossings == CROSSINGS)
            return end;
        double same = from, other = 1.0, x_other = end;
        for (int k = 0; k < BISECTIONS; ++k) {
            const double middle = 0.5 * (same + other);
            const double x_middle = integral(s, h, rest, slope, side, x, from, middle);
            if (side_of(s, at(rest, middle) + x_middle) == side) {
                same = middle;
            } else {
                other = middle;
                x_other = x_middle;
            }
        }
        from = other;
        x = x_other;
    }
}

int32_t cosim_pid_step(void *self, double t0, double t1, double h, const double *u0,
                       const double *u1, double *y)
{
    (void)t0, (void)t1;
    const cosim_pid *s = self;
    const double end[] = {s->held[0] ? u0[0] : u1[0], s->held[1] ? u0[1] : u1[1]};
    double *I = s->memory, *filter = s->memory + 1;
    const double d0 = derivative_input(s, u0), d1 = derivative_input(s, end), before = *filter;
    if (s->derivative_gain != 0.0)
        *filter = lag(s->filter_rate, h, before, d0, d1);
    const line rest = {proportional(s, u0) + (d0 - before),
                       proportional(s, end) + (d1 - *filter)};
    const line slope = {integrand(s, u0), integrand(s, end)};
    if (s->tracking_rate > 0.0)
        *I = tracked(s, h, rest, slope, *I);
    else
        *I += 0.5 * h * (slope.begin + slope.end);
    cosim_pid_outputs(s, u1, y);
    return COSIM_OK;
}

/* The filter is that of the backward difference: D = a D_before + derivative_gain (d - d_before)
 * is derivative_gain d - w with w = a w_before + (1 - a) derivative_gain d_before. */
int32_t cosim_sampled_pid_step(void *self, double t0, double t1, double h, const double *u0,
                               const double *u1, double *y)
{
    (void)t0, (void)t1;
    const cosim_pid *s = self;
    double *I = s->memory, *filter = s->memory + 1;
    const double unlimited = proportional(s, u0) + (derivative_input(s, u0) - *filter) + *I;
    const double excess = unlimited - limited(unlimited, s->lower, s->upper);
    const double remembered = 1.0 / (1.0 + s->filter_rate * h);
    *I += h * (integrand(s, u0) - s->tracking_rate * excess);
    *filter = remembered * *filter + (1.0 - remembered) * derivative_input(s, u0);
    cosim_pid_outputs(s, u1, y);
    return COSIM_OK;
}
