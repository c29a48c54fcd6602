#include "linear.h"

#include <float.h>
#include <math.h>

#define TAYLOR_TERMS 18 /* with a norm of at most 1/2: 0.5^19 / 19! < 2e-23 */

void cosim_multiply_add(int32_t rows, int32_t columns, const double *M, const double *v, double *y)
{
    for (int32_t i = 0; i < rows; ++i) {
        double sum = y[i];
        for (int32_t j = 0; j < columns; ++j)
            sum += M[i * columns + j] * v[j];
        y[i] = sum;
    }
}

double *cosim_place(double *memory, int64_t *next, int64_t count)
{
    double *place = memory ? memory + *next : 0;
    *next += count;
    return place;
}

int64_t cosim_note_part(int64_t begin, int64_t count, int64_t *parts, int64_t next)
{
    parts[2 * next] = begin;
    parts[2 * next + 1] = count;
    return next + 1;
}

void cosim_multiply(int32_t rows, int32_t columns, const double *M, const double *v, double *y)
{
    for (int32_t i = 0; i < rows; ++i)
        y[i] = 0.0;
    cosim_multiply_add(rows, columns, M, v, y);
}

int32_t cosim_invert(int32_t n, double *M, double *inverse)
{
    for (int32_t i = 0; i < n * n; ++i)
        inverse[i] = i % (n + 1) ? 0.0 : 1.0;
    for (int32_t k = 0; k < n; ++k) {
        int32_t pivot = k;
        for (int32_t i = k + 1; i < n; ++i)
            if (fabs(M[i * n + k]) > fabs(M[pivot * n + k]))
                pivot = i;
        if (M[pivot * n + k] == 0.0)
            return COSIM_SINGULAR;
        for (int32_t j = 0; j < n; ++j) {
            const double m = M[pivot * n + j], v = inverse[pivot * n + j];
            M[pivot * n + j] = M[k * n + j], inverse[pivot * n + j] = inverse[k * n + j];
            M[k * n + j] = m, inverse[k * n + j] = v;
        }
        const double divisor = M[k * n + k];
        for (int32_t j = 0; j < n; ++j)
            M[k * n + j] /= divisor, inverse[k * n + j] /= divisor;
        for (int32_t i = 0; i < n; ++i) {
            const double factor = M[i * n + k];
            if (i == k || factor == 0.0)
                continue;
            for (int32_t j = 0; j < n; ++j) {
                M[i * n + j] -= factor * M[k * n + j];
                inverse[i * n + j] -= factor * inverse[k * n + j];
            }
        }
    }
    return COSIM_OK;
}

static void product(int32_t n, const double *P, const double *Q, double *R)
{
    for (int32_t i = 0; i < n; ++i)
        for (int32_t j = 0; j < n; ++j) {
            double sum = 0.0;
            for (int32_t k = 0; k < n; ++k)
                sum += P[i * n + k] * Q[k * n + j];
            R[i * n + j] = sum;
        }
}

static double infinity_norm(int32_t n, const double *M)
{
    double norm = 0.0;
    for (int32_t i = 0; i < n; ++i) {
        double sum = 0.0;
        for (int32_t j = 0; j < n; ++j)
            sum += fabs(M[i * n + j]);
        norm = sum > norm ? sum : norm;
    }
    return norm;
}

typedef struct {
    double scale; /* 2^-squarings */
    int squarings;
} scaling;

/* That makes a norm less than a half. */
static scaling scaling_of(double norm)
{
    scaling by = {1.0, 0};
    while (norm <= DBL_MAX && norm * by.scale >= 0.5) {
        by.scale *= 0.5;
        ++by.squarings;
    }
    return by;
}

void cosim_exponential(int32_t n, const double *M, double *E, double *work)
{
    double *scaled = work, *term = work + n * n;
    const scaling by = scaling_of(infinity_norm(n, M));
    for (int32_t i = 0; i < n * n; ++i)
        scaled[i] = M[i] * by.scale;
    /* F = exp(S) - I, not exp(S): squaring doubles the relative error of I + F, so that a slow mode
     * beside one a million times faster would lose six digits; (I + F)^2 - I = 2 F + F F keeps
     * them. Horner: F = S/1 (I + S/2 (I + ...)) */
    for (int32_t i = 0; i < n * n; ++i)
        E[i] = 0.0;
    for (int32_t k = TAYLOR_TERMS; k >= 1; --k) {
        for (int32_t i = 0; i < n; ++i)
            E[i * (n + 1)] += 1.0;
        product(n, scaled, E, term);
        for (int32_t i = 0; i < n * n; ++i)
            E[i] = term[i] / k;
    }
    for (int s = 0; s < by.squarings; ++s) {
        product(n, E, E, term);
        for (int32_t i = 0; i < n * n; ++i)
            E[i] = 2.0 * E[i] + term[i];
    }
    for (int32_t i = 0; i < n; ++i)
        E[i * (n + 1)] += 1.0;
}

void cosim_response(int32_t n, const double *G, const double *c, const double *beta, int64_t count,
                    const double *t, double *y, double *work)
{
    double *scaled = work, *E = work + n * n;
    for (int64_t k = 0; k < count; ++k) {
        for (int32_t i = 0; i < n * n; ++i)
            scaled[i] = t[k] * G[i];
        cosim_exponential(n, scaled, E, E + n * n);
        y[k] = 0.0;
        for (int32_t a = 0; a < n; ++a)
            for (int32_t b = 0; b < n; ++b)
                y[k] += c[a] * (E[a * n + b] * beta[b]);
    }
}

/* P += Q F, all of shape (n, n). */
static void add_product(int32_t n, const double *Q, const double *F, double *P)
{
    for (int32_t i = 0; i < n; ++i)
        for (int32_t c = 0; c < n; ++c) {
            double sum = P[i * n + c];
            for (int32_t k = 0; k < n; ++k)
                sum += Q[i * n + k] * F[k * n + c];
            P[i * n + c] = sum;
        }
}

static double norm_with_slope(int32_t n, const double *M, const double *S)
{
    double norm = 0.0;
    for (int32_t i = 0; i < n; ++i) {
        double sum = 0.0;
        for (int32_t j = 0; j < n; ++j)
            sum += fabs(M[i * n + j]);
        for (int32_t j = 0; j < n; ++j)
            sum += fabs(S[i * n + j]);
        norm = sum > norm ? sum : norm;
    }
    return norm;
}

/* Without the lower half of the products, which is 0 or the same: the bits of the whole. */
void cosim_exponential_slope(int32_t n, const double *M, const double *S, double *E, double *F,
                             double *work)
{
    const int32_t size = n * n;
    double *scaled = work, *slope = work + size, *term = work + 2 * size, *change = work + 3 * size;
    const scaling by = scaling_of(norm_with_slope(n, M, S));
    for (int32_t i = 0; i < size; ++i) {
        scaled[i] = M[i] * by.scale, slope[i] = S[i] * by.scale;
        E[i] = F[i] = 0.0;
    }
    for (int32_t k = TAYLOR_TERMS; k >= 1; --k) {
        for (int32_t i = 0; i < n; ++i)
            E[i * (n + 1)] += 1.0;
        product(n, scaled, E, term);
        product(n, scaled, F, change);
        add_product(n, slope, E, change);
        for (int32_t i = 0; i < size; ++i)
            E[i] = term[i] / k, F[i] = change[i] / k;
    }
    for (int s = 0; s < by.squarings; ++s) {
        product(n, E, E, term);
        product(n, E, F, change);
        add_product(n, F, E, change);
        for (int32_t i = 0; i < size; ++i)
            E[i] = 2.0 * E[i] + term[i], F[i] = 2.0 * F[i] + change[i];
    }
    for (int32_t i = 0; i < n; ++i)
        E[i * (n + 1)] += 1.0;
}

void cosim_exponential_numbers(const double *M, const double *S, double *E, double *F)
{
    scaling by[COSIM_NUMBERS];
    double scaled[COSIM_NUMBERS], slope[COSIM_NUMBERS];
    int most = 0;
    for (int i = 0; i < COSIM_NUMBERS; ++i) {
        by[i] = scaling_of(fabs(M[i]) + fabs(S[i]));
        most = by[i].squarings > most ? by[i].squarings : most;
        scaled[i] = M[i] * by[i].scale, slope[i] = S[i] * by[i].scale;
        E[i] = F[i] = 0.0;
    }
    for (int32_t k = TAYLOR_TERMS; k >= 1; --k)
        for (int i = 0; i < COSIM_NUMBERS; ++i) {
            const double e = E[i] + 1.0;
            F[i] = (0.0 + scaled[i] * F[i] + slope[i] * e) / k; /* 0.0 +: as in a sum, never -0 */
            E[i] = (0.0 + scaled[i] * e) / k;
        }
    for (int s = 0; s < most; ++s)
        for (int i = 0; i < COSIM_NUMBERS; ++i) {
            if (s >= by[i].squarings)
                continue;
            F[i] = 2.0 * F[i] + (0.0 + E[i] * F[i] + F[i] * E[i]);
            E[i] = 2.0 * E[i] + (0.0 + E[i] * E[i]);
        }
    for (int i = 0; i < COSIM_NUMBERS; ++i)
        E[i] += 1.0;
}

void cosim_system_matrix(int32_t n, int32_t count, const double *G0, const double *G1,
                         const double *theta, double *G)
{
    for (int32_t k = 0; k < n * n; ++k) {
        double sum = G0[k];
        for (int32_t j = 0; j < count; ++j)
            sum += theta[j] * G1[j * n * n + k];
        G[k] = sum;
    }
}

/* The infinity norm of [[h A, h B, 0], [0, 0, I], [0, 0, 0]]. */
static double norm_with_inputs(int32_t n, int32_t m, const double *A, const double *B, double h)
{
    double norm = m > 0 ? 1.0 : 0.0;
    for (int32_t i = 0; i < n; ++i) {
        double sum = 0.0;
        for (int32_t j = 0; j < n; ++j)
            sum += fabs(h * A[i * n + j]);
        for (int32_t j = 0; j < m; ++j)
            sum += fabs(h * B[i * m + j]);
        norm = sum > norm ? sum : norm;
    }
    return norm;
}

/* P = Q F for the first n rows P and F of matrices of n + 2 m columns, of which Q has the first n,
 * in rows of `stride` doubles. */
static void product_of_states(int32_t n, int32_t m, const double *Q, int32_t stride,
                              const double *F, double *P)
{
    const int32_t N = n + 2 * m;
    for (int32_t i = 0; i < n; ++i)
        for (int32_t c = 0; c < N; ++c) {
            double sum = 0.0;
            for (int32_t k = 0; k < n; ++k)
                sum += Q[i * stride + k] * F[k * N + c];
            P[i * N + c] = sum;
        }
}

/* With v = du/ds constant over the unit interval s = (t - t0)/h, the state (x, u, v) has
 * the generator [[h A, h B, 0], [0, 0, I], [0, 0, 0]]; the first block row of its exponential is
 * (Ad, G1, G2), and x(t+h) = Ad x + G1 u0 + G2 (u1 - u0).
 *
 * That is cosim_exponential of this generator, bit by bit, without the products by what is 0 or 1:
 * of F = exp - I only the first n rows are computed; of the others F[u, v] = `ramp` I alone is not
 * 0. A record of 40 000 intervals that differ rests on it. */
void cosim_first_order_hold(int32_t n, int32_t m, const double *A, const double *B, double h,
                            const uint8_t *held, double *Ad, double *B0, double *B1, double *work)
{
    const int32_t N = n + 2 * m, inputs = n + m;
    double *scaled = work, *F = work + n * N, *term = work + 2 * n * N;
    const scaling by = scaling_of(norm_with_inputs(n, m, A, B, h));
    for (int32_t i = 0; i < n; ++i) {
        for (int32_t j = 0; j < n; ++j)
            scaled[i * inputs + j] = h * A[i * n + j] * by.scale;
        for (int32_t j = 0; j < m; ++j)
            scaled[i * inputs + n + j] = h * B[i * m + j] * by.scale;
    }
    for (int32_t i = 0; i < n * N; ++i)
        F[i] = 0.0;
    double ramp = 0.0;
    for (int32_t k = TAYLOR_TERMS; k >= 1; --k) {
        for (int32_t i = 0; i < n; ++i)
            F[i * (N + 1)] += 1.0;
        product_of_states(n, m, scaled, inputs, F, term);
        for (int32_t i = 0; i < n; ++i)
            for (int32_t j = 0; j < m; ++j) {
                term[i * N + n + j] += scaled[i * inputs + n + j];
                term[i * N + n + m + j] += scaled[i * inputs + n + j] * ramp;
            }
        for (int32_t i = 0; i < n * N; ++i)
            F[i] = term[i] / k;
        ramp = by.scale / k;
    }
    for (int s = 0; s < by.squarings; ++s) {
        product_of_states(n, m, F, N, F, term);
        for (int32_t i = 0; i < n; ++i)
            for (int32_t j = 0; j < m; ++j)
                term[i * N + n + m + j] += F[i * N + n + j] * ramp;
        for (int32_t i = 0; i < n * N; ++i)
            F[i] = 2.0 * F[i] + term[i];
        ramp *= 2.0;
    }
    for (int32_t i = 0; i < n; ++i) {
        F[i * (N + 1)] += 1.0;
        for (int32_t j = 0; j < n; ++j)
            Ad[i * n + j] = F[i * N + j];
        for (int32_t j = 0; j < m; ++j) {
            const double constant = F[i * N + n + j], slope = F[i * N + n + m + j];
            B0[i * m + j] = held[j] ? constant : constant - slope;
            B1[i * m + j] = held[j] ? 0.0 : slope;
        }
    }
}

void cosim_first_order_holds(int64_t count, int32_t n, int32_t m, const double *A, const double *B,
                             const double *h, const uint8_t *held, double *Ad, double *B0,
                             double *B1, double *work)
{
    for (int64_t i = 0; i < count; ++i)
        cosim_first_order_hold(n, m, A, B, h[i], held, Ad + i * n * n, B0 + i * n * m,
                               B1 + i * n * m, work);
}

/* That of steps of a length that was not known before. */
__attribute__((noinline)) static cosim_linear_substep discretize(const cosim_linear *s, double h)
{
    cosim_linear_dynamics *d = s->dynamics;
    if (d->h != h)
        cosim_first_order_hold(s->n, s->m, d->A, d->B, h, d->held, d->Ad, d->B0, d->B1, d->work);
    d->h = h;
    return (cosim_linear_substep){h, d->Ad, d->B0, d->B1};
}

/* That of steps of length h. */
static inline cosim_linear_substep discretization(const cosim_linear *s, double h)
{
    for (int32_t i = 0; i < s->n_substeps; ++i)
        if (s->substeps[i].h == h)
            return s->substeps[i];
    if (s->dynamics && s->dynamics->step != h)
        return discretize(s, h);
    return (cosim_linear_substep){h, s->Ad, s->B0, s->B1};
}

int32_t cosim_linear_step(void *self, double t0, double t1, double h, const double *u0,
                          const double *u1, double *y)
{
    (void)t0, (void)t1;
    const cosim_linear *s = self;
    double *x = s->memory, *next = s->memory + s->n;
    const cosim_linear_substep by = discretization(s, h);
    cosim_multiply(s->n, s->n, by.Ad, x, next);
    cosim_multiply_add(s->n, s->m, by.B0, u0, next);
    cosim_multiply_add(s->n, s->m, by.B1, u1, next);
    for (int32_t i = 0; i < s->n; ++i)
        x[i] = next[i];
    return cosim_linear_outputs(self, t1, u1, y);
}

int32_t cosim_linear_outputs(void *self, double t, const double *u, double *y)
{
    (void)t;
    const cosim_linear *s = self;
    cosim_multiply(s->p, s->n, s->C, s->memory, y);
    cosim_multiply_add(s->p, s->m, s->D, u, y);
    return COSIM_OK;
}

int32_t cosim_delay_step(void *self, double t0, double t1, double h, const double *u0,
                         const double *u1, double *y)
{
    (void)t0, (void)t1, (void)h, (void)u1;
    const cosim_delay *s = self;
    const int32_t newest = (int32_t)s->memory[0], oldest = (newest + 1) % s->steps;
    double *ring = s->memory + 1;
    for (int32_t i = 0; i < s->width; ++i)
        ring[newest * s->width + i] = u0[i];
    for (int32_t i = 0; i < s->width; ++i)
        y[i] = ring[oldest * s->width + i];
    s->memory[0] = (double)oldest;
    return COSIM_OK;
}
