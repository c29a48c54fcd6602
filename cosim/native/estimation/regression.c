#include "regression.h"
#include "elementary.h"
#include "linear.h"

#include <float.h>
#include <math.h>

/* pivot over the largest one: below it R'R, the information, is singular to rounding */
#define RANK_TOLERANCE 0x1p-26

/* The sign of a NaN that arithmetic makes depends on the processor. */
static double one_nan(double x) { return isnan(x) ? cosim_no_value() : x; }

/* --- regressor (21)-(25) --- */

static int32_t longest_delay(const cosim_regressor *s)
{
    int32_t longest = 0;
    for (int32_t j = 0; j < s->rows; ++j)
        longest = s->steps[j] > longest ? s->steps[j] : longest;
    return longest;
}

/* Its memory: number of samples before now, ring of delta, scratch, ring of the alphas. */
typedef struct {
    double *now, *delta, *alpha, *alphas;
} regressor_memory;

static regressor_memory memory_of(const cosim_regressor *s)
{
    regressor_memory m;
    int64_t next = 0;
    m.now = cosim_place(s->memory, &next, 1);
    m.delta = cosim_place(s->memory, &next, longest_delay(s));
    m.alpha = cosim_place(s->memory, &next, s->alphas->alphas.count * s->rows);
    m.alphas = cosim_place(s->memory, &next, cosim_past_alphas_memory(s->alphas));
    return m;
}

void cosim_regressor_outputs(const cosim_regressor *s, double t, const double *u, double *y)
{
    const regressor_memory m = memory_of(s);
    const int32_t longest = longest_delay(s);
    const int64_t now = (int64_t)*m.now;

    if (now < longest) {
        for (int32_t c = 0; c < s->terms; ++c)
            y[c] = cosim_no_value();
        return;
    }
    cosim_past_alphas_at(s->alphas, m.alphas, now, t, u + 1, m.alpha);
    for (int32_t c = 0; c < s->terms; ++c) {
        const int32_t steps = s->steps[s->row[c]];
        double product = s->sign[c] * (steps == 0 ? u[0] : m.delta[(now - steps) % longest]);
        for (int32_t f = 0; f < s->factors; ++f)
            product *= m.alpha[s->factor[c * s->factors + f]];
        y[c] = one_nan(product);
    }
}

/* Only samples before t1 enter the rings, so that an input that is extrapolated first and corrected
 * later does no harm. */
int32_t cosim_regressor_step(void *self, double t0, double t1, double h, const double *u0,
                             const double *u1, double *y)
{
    (void)t0, (void)h;
    const cosim_regressor *s = self;
    const regressor_memory m = memory_of(s);
    const int32_t longest = longest_delay(s);
    const int64_t now = (int64_t)*m.now;
    if (longest > 0)
        m.delta[now % longest] = u0[0];
    cosim_past_alphas_keep(s->alphas, m.alphas, now, u0 + 1);
    *m.now = (double)(now + 1);
    cosim_regressor_outputs(s, t1, u1, y);
    return COSIM_OK;
}

/* --- least squares (33)-(35) --- */

/* Rotate `row` (destroyed) into the upper triangular R of shape (n, n). */
static void rotate_in(int32_t n, double *R, double *row)
{
    for (int32_t i = 0; i < n; ++i) {
        if (row[i] == 0.0)
            continue;
        double *r = R + i * n;
        const double norm = sqrt(r[i] * r[i] + row[i] * row[i]);
        if (norm == 0.0) /* both below 1e-162: no information, and 0/0 otherwise */
            continue;
        const double c = r[i] / norm, s = row[i] / norm;
        for (int32_t j = i; j < n; ++j) {
            const double above = r[j], below = row[j];
            r[j] = c * above + s * below;
            row[j] = c * below - s * above;
        }
    }
}

/* Rows (m', p) with p = -mu_0 and m = mu_1..mu_q, times the square root of the quadrature
 * weight. */
static void accumulate(const cosim_least_squares *s, double weight, const double *mu)
{
    const int32_t n = s->unknowns + 1;
    double *R = s->memory, *row = s->memory + n * n;
    const double root = sqrt(weight);
    for (int32_t c = 0; c < s->unknowns; ++c)
        row[c] = root * mu[c + 1];
    row[s->unknowns] = -root * mu[0];
    rotate_in(n, R, row);
}

static double larger(double a, double b) { return a > b ? a : b; }
static double smaller(double a, double b) { return a < b ? a : b; }

static int solve(const cosim_least_squares *s, double *eta)
{
    const int32_t n = s->unknowns + 1;
    const double *R = s->memory;
    double largest = 0.0;
    for (int32_t i = 0; i < s->unknowns; ++i)
        largest = larger(largest, fabs(R[i * n + i]));
    for (int32_t i = s->unknowns - 1; i >= 0; --i) {
        if (!(fabs(R[i * n + i]) > RANK_TOLERANCE * largest))
            return 0;
        double sum = R[i * n + s->unknowns];
        for (int32_t j = i + 1; j < s->unknowns; ++j)
            sum -= R[i * n + j] * eta[j];
        eta[i] = sum / R[i * n + i];
    }
    return 1;
}

/* exp(-s spacing) = w gives s = -ln(w)/spacing; there is none where w is not positive. */
static double exponent(double w, double spacing)
{
    return w > 0.0 && w <= DBL_MAX ? -cosim_ln(w) / spacing : cosim_no_value();
}

/* cos(w spacing) = cosine gives w; there is none beyond 1. */
static double rate(double cosine, double spacing)
{
    return cosine >= -1.0 && cosine <= 1.0 ? cosim_acos(cosine) / spacing : cosim_no_value();
}

void cosim_recover(const cosim_recovery *r, const double *eta, double *theta)
{
    double c[3] = {0.0, 0.0, 0.0};
    const int32_t count = r->kind == COSIM_EXPONENTIAL ? 2 : 3;
    for (int32_t k = 0; k < count; ++k)
        c[k] = r->sign[k] * (r->index[k] == 0 ? 1.0 : eta[r->index[k] - 1]);

    if (r->kind == COSIM_EXPONENTIAL) {
        theta[r->theta[0]] = exponent(-c[0] / c[1], r->spacing);
    } else if (r->kind == COSIM_EXPONENTIALS) {
        const double discriminant = c[1] * c[1] - 4.0 * c[0] * c[2];
        /* the root of the larger magnitude first, the other from the product of both: no
         * cancellation */
        const double big = -0.5 * (c[1] + copysign(sqrt(discriminant), c[1]));
        const double first = exponent(big / c[2], r->spacing);
        const double second = exponent(c[0] / big, r->spacing);
        const int known = discriminant >= 0.0 && !isnan(first) && !isnan(second);
        theta[r->theta[0]] = known ? larger(first, second) : cosim_no_value();
        theta[r->theta[1]] = known ? smaller(first, second) : cosim_no_value();
    } else if (r->kind == COSIM_SINE) {
        theta[r->theta[0]] = rate(-0.5 * c[1] / c[0], r->spacing);
    } else if (r->kind == COSIM_DAMPED_SINE) {
        const double squared = c[0] / c[2];
        const double decay = -exponent(squared, 2.0 * r->spacing);
        const double found = rate(-0.5 * c[1] / c[2] / sqrt(squared), r->spacing);
        const int known = !isnan(decay) && !isnan(found);
        theta[r->theta[0]] = known ? decay : cosim_no_value();
        theta[r->theta[1]] = known ? found : cosim_no_value();
    } else {
        theta[r->theta[0]] = exponent(-0.5 * c[1] / c[2], r->spacing);
    }
}

static void estimate(const cosim_least_squares *s, double *y)
{
    double *theta = y, *eta = y + s->parameters;
    if (!solve(s, eta)) {
        for (int32_t i = 0; i < s->parameters + s->unknowns; ++i)
            y[i] = cosim_no_value();
        return;
    }
    for (int32_t b = 0; b < s->groups; ++b)
        cosim_recover(&s->recovery[b], eta, theta);
    for (int32_t i = 0; i < s->parameters + s->unknowns; ++i)
        y[i] = one_nan(y[i]);
}

void cosim_least_squares_start(cosim_least_squares *self, double *y)
{
    const int32_t n = self->unknowns + 1;
    for (int32_t i = 0; i < n * n; ++i)
        self->memory[i] = 0.0;
    for (int32_t i = 0; i < self->unknowns; ++i)
        self->memory[i * n + i] = self->prior;
    for (int32_t i = 0; i < self->parameters + self->unknowns; ++i)
        y[i] = cosim_no_value();
}

int32_t cosim_least_squares_step(void *self, double t0, double t1, double h, const double *u0,
                                 const double *u1, double *y)
{
    const cosim_least_squares *s = self;
    if (t0 < s->start) {
        for (int32_t i = 0; i < s->parameters + s->unknowns; ++i)
            y[i] = cosim_no_value();
        return COSIM_OK;
    }
    (void)t1;
    for (int32_t c = 0; c <= s->unknowns; ++c)
        if (isnan(u0[c]) || (!s->held && isnan(u1[c])))
            return COSIM_NO_VALUE;
    if (s->held) {
        accumulate(s, h, u0);
    } else { /* trapezoid */
        accumulate(s, 0.5 * h, u0);
        accumulate(s, 0.5 * h, u1);
    }
    estimate(s, y);
    return COSIM_OK;
}
