#include "adaptive.h"
#include "elementary.h"

#include <math.h>
#include <string.h>

/* pivot over the largest one: below it the extended regressor is singular to rounding */
#define SINGULAR 0x1p-48

static int has_values(const cosim_adaptive *s, const double *mu)
{
    for (int32_t c = 0; c <= s->unknowns; ++c)
        if (isnan(mu[c]))
            return 0;
    return 1;
}

/* theta and eta, where there is information for them. */
static void write_estimate(const cosim_adaptive *s, int known, const double *eta, double *y)
{
    const int32_t width = s->parameters + s->unknowns;
    if (known) {
        for (int32_t b = 0; b < s->groups; ++b)
            cosim_recover(&s->recovery[b], eta, y);
        memcpy(y + s->parameters, eta, (size_t)s->unknowns * sizeof *y);
    }
    for (int32_t i = 0; i < width; ++i)
        if (!known || isnan(y[i]))
            y[i] = cosim_no_value();
}

/* --- gradient --- */

int64_t cosim_gradient_memory(const cosim_adaptive *s) { return s->unknowns + 1; }

/* eta' = gain m (p - m'eta) / m'm, exactly for a row that stays for `duration`. */
static void descend(const cosim_adaptive *s, double duration, const double *mu)
{
    double *eta = s->memory, *rows = s->memory + s->unknowns;
    const double *m = mu + 1;
    double squares = 0.0, error = -mu[0];
    for (int32_t c = 0; c < s->unknowns; ++c) {
        squares += m[c] * m[c];
        error -= m[c] * eta[c];
    }
    if (!(squares > 0.0))
        return;
    const double step = (1.0 - cosim_exp(-s->gain * duration)) * error / squares;
    for (int32_t c = 0; c < s->unknowns; ++c)
        eta[c] += step * m[c];
    *rows += 1.0;
}

int32_t cosim_gradient_step(void *self, double t0, double t1, double h, const double *u0,
                            const double *u1, double *y)
{
    (void)t1;
    const cosim_adaptive *s = self;
    const double *eta = s->memory, *rows = s->memory + s->unknowns;
    if (t0 >= s->start) {
        if (!has_values(s, u0) || (!s->held && !has_values(s, u1)))
            return COSIM_NO_VALUE;
        descend(s, s->held ? h : 0.5 * h, u0);
        if (!s->held)
            descend(s, 0.5 * h, u1);
    }
    write_estimate(s, *rows >= s->unknowns, eta, y);
    return COSIM_OK;
}

/* --- dynamic regressor extension and mixing --- */

typedef struct {
    double *eta, *peak, *Omega, *Y, *work;
    int64_t size;
} extension;

static extension extension_of(const cosim_adaptive *s)
{
    const int64_t q = s->unknowns;
    extension x;
    double *next = s->memory;
    x.eta = next, next += q;
    x.peak = next++;
    x.Omega = next, next += q * q;
    x.Y = next, next += q;
    x.work = next, next += q * (q + 1);
    x.size = next - s->memory;
    return x;
}

int64_t cosim_drem_memory(const cosim_adaptive *s) { return extension_of(s).size; }

/* Omega' = -Omega / forgetting + m m', Y' = -Y / forgetting + m p (G. Kreisselmeier, 1977). */
static void extend(const cosim_adaptive *s, const extension *x, double weight, const double *mu)
{
    const int32_t q = s->unknowns;
    const double *m = mu + 1;
    for (int32_t a = 0; a < q; ++a) {
        for (int32_t b = 0; b < q; ++b)
            x->Omega[a * q + b] += weight * m[a] * m[b];
        x->Y[a] -= weight * m[a] * mu[0];
    }
}

static void forget(const cosim_adaptive *s, const extension *x, double decay)
{
    for (int32_t i = 0; i < s->unknowns * s->unknowns; ++i)
        x->Omega[i] *= decay;
    for (int32_t i = 0; i < s->unknowns; ++i)
        x->Y[i] *= decay;
}

/* Delta = det Omega in units of (trace / q)^q, at most 1, and adj(Omega) Y / Delta = Omega^-1 Y,
 * which replaces the last column of `work`; 0: Omega is singular, so that Delta adj(Omega) Y counts
 * for nothing. Omega is positive definite: no pivoting is needed. */
static double mix(const cosim_adaptive *s, const extension *x)
{
    const int32_t q = s->unknowns, n = q + 1;
    double trace = 0.0, determinant = 1.0, largest = 0.0;
    for (int32_t a = 0; a < q; ++a)
        trace += x->Omega[a * q + a];
    const double scale = trace / q;
    if (!(scale > 0.0))
        return 0.0;
    for (int32_t a = 0; a < q; ++a) {
        for (int32_t b = 0; b < q; ++b)
            x->work[a * n + b] = x->Omega[a * q + b] / scale;
        x->work[a * n + q] = x->Y[a] / scale;
        largest = x->work[a * n + a] > largest ? x->work[a * n + a] : largest;
    }
    for (int32_t k = 0; k < q; ++k) {
        const double pivot = x->work[k * n + k];
        if (!(pivot > SINGULAR * largest))
            return 0.0;
        determinant *= pivot;
        for (int32_t a = k + 1; a < q; ++a) {
            const double factor = x->work[a * n + k] / pivot;
            for (int32_t b = k; b <= q; ++b)
                x->work[a * n + b] -= factor * x->work[k * n + b];
        }
    }
    for (int32_t a = q - 1; a >= 0; --a) {
        double sum = x->work[a * n + q];
        for (int32_t b = a + 1; b < q; ++b)
            sum -= x->work[a * n + b] * x->work[b * n + q];
        x->work[a * n + q] = sum / x->work[a * n + a];
    }
    return determinant;
}

/* eta_i' = gain Delta (adj(Omega) Y - Delta eta)_i / max Delta^2, exactly for an extended regressor
 * that stays over the step. */
static void follow(const cosim_adaptive *s, const extension *x, double h)
{
    const int32_t q = s->unknowns;
    const double determinant = mix(s, x);
    const double squared = determinant * determinant;
    if (!(squared > 0.0))
        return;
    if (squared > *x->peak)
        *x->peak = squared;
    const double step = 1.0 - cosim_exp(-s->gain * h * (squared / *x->peak));
    for (int32_t i = 0; i < q; ++i)
        x->eta[i] += step * (x->work[i * (q + 1) + q] - x->eta[i]);
}

int32_t cosim_drem_step(void *self, double t0, double t1, double h, const double *u0,
                        const double *u1, double *y)
{
    (void)t1;
    const cosim_adaptive *s = self;
    const extension x = extension_of(s);
    if (t0 >= s->start) {
        if (!has_values(s, u0) || (!s->held && !has_values(s, u1)))
            return COSIM_NO_VALUE;
        extend(s, &x, s->held ? h : 0.5 * h, u0);
        forget(s, &x, cosim_exp(-h / s->forgetting));
        if (!s->held)
            extend(s, &x, 0.5 * h, u1);
        follow(s, &x, h);
    }
    write_estimate(s, *x.peak > 0.0, x.eta, y);
    return COSIM_OK;
}
