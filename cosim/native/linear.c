#include "cosim.h"

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

void cosim_exponential(int32_t n, const double *M, double *E, double *work)
{
    double *scaled = work, *term = work + n * n;
    const double norm = infinity_norm(n, M);
    double scale = 1.0;
    int squarings = 0;
    while (norm <= DBL_MAX && norm * scale >= 0.5) {
        scale *= 0.5;
        ++squarings;
    }
    for (int32_t i = 0; i < n * n; ++i)
        scaled[i] = M[i] * scale;
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
    for (int s = 0; s < squarings; ++s) {
        product(n, E, E, term);
        for (int32_t i = 0; i < n * n; ++i)
            E[i] = 2.0 * E[i] + term[i];
    }
    for (int32_t i = 0; i < n; ++i)
        E[i * (n + 1)] += 1.0;
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

/* With v = du/ds constant over the unit interval s = (t - t0)/h, the state (x, u, v) has
 * the generator [[h A, h B, 0], [0, 0, I], [0, 0, 0]]; the first block row of its exponential is
 * (Ad, G1, G2), and x(t+h) = Ad x + G1 u0 + G2 (u1 - u0). */
void cosim_first_order_hold(int32_t n, int32_t m, const double *A, const double *B, double h,
                            const uint8_t *held, double *Ad, double *B0, double *B1, double *work)
{
    const int32_t N = n + 2 * m;
    double *M = work, *E = work + N * N;
    for (int32_t i = 0; i < N * N; ++i)
        M[i] = 0.0;
    for (int32_t i = 0; i < n; ++i) {
        for (int32_t j = 0; j < n; ++j)
            M[i * N + j] = h * A[i * n + j];
        for (int32_t j = 0; j < m; ++j)
            M[i * N + n + j] = h * B[i * m + j];
    }
    for (int32_t j = 0; j < m; ++j)
        M[(n + j) * N + n + m + j] = 1.0;
    cosim_exponential(N, M, E, work + 2 * N * N);
    for (int32_t i = 0; i < n; ++i) {
        for (int32_t j = 0; j < n; ++j)
            Ad[i * n + j] = E[i * N + j];
        for (int32_t j = 0; j < m; ++j) {
            const double constant = E[i * N + n + j], slope = E[i * N + n + m + j];
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

int32_t cosim_linear_step(void *self, double t0, double t1, double h, const double *u0,
                          const double *u1, double *y)
{
    (void)t0, (void)t1, (void)h;
    const cosim_linear *s = self;
    double *x = s->memory, *next = s->memory + s->n;
    cosim_multiply(s->n, s->n, s->Ad, x, next);
    cosim_multiply_add(s->n, s->m, s->B0, u0, next);
    cosim_multiply_add(s->n, s->m, s->B1, u1, next);
    for (int32_t i = 0; i < s->n; ++i)
        x[i] = next[i];
    cosim_multiply(s->p, s->n, s->C, x, y);
    cosim_multiply_add(s->p, s->m, s->D, u1, y);
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
