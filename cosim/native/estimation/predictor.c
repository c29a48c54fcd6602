#include "predictor.h"
#include "linear.h"
#include "weights.h"

#include <string.h>

typedef struct {
    double *S, *error, *noise; /* (outputs, outputs) of those measured, and two factors */
    double *CP, *TP;           /* (outputs, states), (states, states) */
} parts;

static parts parts_of(const cosim_predictor *s, double *work)
{
    const int64_t n = s->states, outputs = s->outputs;
    parts p;
    int64_t next = 0;
    p.S = cosim_place(work, &next, outputs * outputs);
    p.error = cosim_place(work, &next, outputs * outputs);
    p.noise = cosim_place(work, &next, outputs * outputs);
    p.CP = cosim_place(work, &next, outputs * n);
    p.TP = cosim_place(work, &next, n * n);
    return p;
}

/* The covariances of noise and of error = C x + noise, of those measured, as their factors. */
static int32_t factorize(const cosim_predictor *s, const parts *p, int32_t m, const int32_t *there,
                         const double *P)
{
    const int32_t n = s->states;
    for (int32_t i = 0; i < m; ++i)
        for (int32_t a = 0; a < n; ++a) {
            double sum = 0.0;
            for (int32_t b = 0; b < n; ++b)
                sum += s->C[there[i] * n + b] * P[b * n + a];
            p->CP[i * n + a] = sum;
        }
    for (int32_t i = 0; i < m; ++i)
        for (int32_t j = 0; j < m; ++j)
            p->S[i * m + j] = s->R[there[i] * s->outputs + there[j]];
    if (!cosim_factorize(m, p->S, p->noise))
        return COSIM_NO_VALUE;
    for (int32_t i = 0; i < m; ++i)
        for (int32_t j = 0; j < m; ++j)
            for (int32_t a = 0; a < n; ++a)
                p->S[i * m + j] += p->CP[i * n + a] * s->C[there[j] * n + a];
    return cosim_factorize(m, p->S, p->error) ? COSIM_OK : COSIM_NO_VALUE;
}

/* x = F^-1 x for columns of x, (m, n), and the lower triangle F. */
static void solve_lower(int32_t m, int32_t n, const double *F, double *x)
{
    for (int32_t i = 0; i < m; ++i)
        for (int32_t a = 0; a < n; ++a) {
            for (int32_t k = 0; k < i; ++k)
                x[i * n + a] -= F[i * m + k] * x[k * n + a];
            x[i * n + a] /= F[i * m + i];
        }
}

/* L = (factor of the noise) (factor of the error)^-1; an output that is missing stands alone. */
static void set_weight(const cosim_predictor *s, const parts *p, int32_t m, const int32_t *there,
                       double *L)
{
    double *inverse = p->S;
    memset(L, 0, (size_t)(s->outputs * s->outputs) * sizeof *L);
    for (int32_t o = 0; o < s->outputs; ++o)
        L[o * s->outputs + o] = 1.0;
    memset(inverse, 0, (size_t)(m * m) * sizeof *inverse);
    for (int32_t i = 0; i < m; ++i)
        inverse[i * m + i] = 1.0;
    solve_lower(m, m, p->error, inverse);
    for (int32_t i = 0; i < m; ++i)
        for (int32_t j = 0; j <= i; ++j) {
            double sum = 0.0;
            for (int32_t k = j; k <= i; ++k)
                sum += p->noise[i * m + k] * inverse[k * m + j];
            L[there[i] * s->outputs + there[j]] = sum;
        }
}

/* P = T (P - P C' S^-1 C P) T', K = T P C' S^-1. */
static void go_on(const cosim_predictor *s, const parts *p, int32_t m, const int32_t *there,
                  const double *T, double *P, double *K)
{
    const int32_t n = s->states;
    double *half = p->CP; /* F^-1 C P, S = F F' */
    solve_lower(m, n, p->error, half);
    for (int32_t a = 0; a < n; ++a)
        for (int32_t b = 0; b < n; ++b)
            for (int32_t i = 0; i < m; ++i)
                P[a * n + b] -= half[i * n + a] * half[i * n + b];
    for (int32_t i = m - 1; i >= 0; --i) /* F'^-1 of it */
        for (int32_t a = 0; a < n; ++a) {
            for (int32_t k = i + 1; k < m; ++k)
                half[i * n + a] -= p->error[k * m + i] * half[k * n + a];
            half[i * n + a] /= p->error[i * m + i];
        }
    for (int32_t i = 0; i < m; ++i)
        for (int32_t a = 0; a < n; ++a)
            for (int32_t b = 0; b < n; ++b)
                K[a * s->outputs + there[i]] += T[a * n + b] * half[i * n + b];
    for (int32_t a = 0; a < n; ++a)
        for (int32_t b = 0; b < n; ++b) {
            p->TP[a * n + b] = 0.0;
            for (int32_t c = 0; c < n; ++c)
                p->TP[a * n + b] += T[a * n + c] * P[c * n + b];
        }
    for (int32_t a = 0; a < n; ++a)
        for (int32_t b = 0; b <= a; ++b) {
            double sum = 0.0;
            for (int32_t c = 0; c < n; ++c)
                sum += p->TP[a * n + c] * T[b * n + c];
            P[a * n + b] = P[b * n + a] = sum;
        }
}

int32_t cosim_predictor_gain(const cosim_predictor *s, const uint8_t *measured, const double *T,
                             double *P, double *K, double *L, int32_t *there, double *work)
{
    const parts p = parts_of(s, work);
    int32_t m = 0;
    for (int32_t o = 0; o < s->outputs; ++o)
        if (measured[o])
            there[m++] = o;
    memset(K, 0, (size_t)(s->states * s->outputs) * sizeof *K);
    if (factorize(s, &p, m, there, P))
        return COSIM_NO_VALUE;
    set_weight(s, &p, m, there, L);
    if (T)
        go_on(s, &p, m, there, T, P, K);
    return COSIM_OK;
}

int32_t cosim_predictor_gains(const cosim_predictor *s, int64_t count, const int32_t *interval,
                              const uint8_t *measured, double *P, double *K, double *L,
                              int32_t *there, double *work)
{
    const int32_t n = s->states, outputs = s->outputs;
    for (int64_t k = 0; k < count; ++k) {
        const double *T = k + 1 < count ? s->T + (int64_t)interval[k + 1] * n * n : NULL;
        if (cosim_predictor_gain(s, measured + k * outputs, T, P, K + k * n * outputs,
                                 L + k * outputs * outputs, there, work))
            return COSIM_NO_VALUE;
    }
    return COSIM_OK;
}
