#include "augmented_kalman.h"
#include "kalman.h"
#include "linear.h"

#include <math.h>
#include <string.h>

#define LATER 1.1 /* theta is estimated again when there are so many times more samples */

/* The state of the filter, and behind it what the smoother needs of every sample. */
typedef struct {
    double *count, *next_estimate;
    double *x, *R;   /* (n), (n, n) */
    double *u;       /* of the sample before */
    double *outputs; /* theta */
    int64_t state;
    double *time, *predicted, *spread, *innovation; /* (1), (n), (n, n), (outputs) a sample */
    double *signals;                                /* (signals) a sample */
    double *delta;                                  /* smoothed */
    double *scratch;
    int64_t size;
} storage;

static int64_t longer(int64_t a, int64_t b) { return a > b ? a : b; }

static storage storage_of(const cosim_augmented_kalman *s)
{
    const int64_t n = s->states, o = s->outputs, capacity = s->capacity;
    const int64_t width = s->projection ? s->projection->width : 0;
    const int64_t input = s->terms + s->signals + 1; /* of the projection */
    storage m;
    double *next = s->memory;
    m.count = next++;
    m.next_estimate = next++;
    m.x = next, next += n;
    m.R = next, next += n * n;
    m.u = next, next += s->inputs;
    m.outputs = next, next += s->parameters;
    m.state = next - s->memory;
    m.time = next, next += capacity;
    m.predicted = next, next += capacity * n;
    m.spread = next, next += capacity * n * n;
    m.innovation = next, next += capacity * o;
    m.signals = next, next += capacity * s->signals;
    m.delta = next, next += capacity;
    m.scratch = next;
    next += longer(longer(n * (n + 2) + 3 * n, 4 * n + 2 * o * o + 3 * o),
                   width + input + 2 * (1 + s->signals));
    m.size = next - s->memory;
    return m;
}

int64_t cosim_augmented_kalman_memory(const cosim_augmented_kalman *s)
{
    return storage_of(s).size;
}
int64_t cosim_augmented_kalman_state(const cosim_augmented_kalman *s)
{
    return storage_of(s).state;
}

int64_t cosim_augmented_kalman_samples(const cosim_augmented_kalman *s, const double *state,
                                       int64_t *parts)
{
    const storage m = storage_of(s);
    const int64_t n = s->states, count = (int64_t)state[m.count - s->memory];
    int64_t next = 0;
    next = cosim_note_part(m.time - s->memory, count, parts, next);
    next = cosim_note_part(m.predicted - s->memory, count * n, parts, next);
    next = cosim_note_part(m.spread - s->memory, count * n * n, parts, next);
    next = cosim_note_part(m.innovation - s->memory, count * s->outputs, parts, next);
    return cosim_note_part(m.signals - s->memory, count * s->signals, parts, next);
}

void cosim_augmented_kalman_start(cosim_augmented_kalman *s, double *y)
{
    const storage m = storage_of(s);
    memset(s->memory, 0, (size_t)m.state * sizeof *s->memory);
    for (int32_t a = 0; a < s->states; ++a)
        m.R[a * s->states + a] = s->first_spread[a];
    for (int32_t j = 0; j < s->parameters; ++j)
        y[j] = m.outputs[j] = cosim_no_value();
}

/* --- the filter --- */

static void take_sample(const cosim_augmented_kalman *s, const storage *m, double t,
                        const double *y, const double *u)
{
    const int32_t n = s->states, o = s->outputs, inputs = s->inputs;
    const int64_t k = (int64_t)*m->count;
    if (k > 0) {
        cosim_multiply(n, n, s->Phi, m->x, m->scratch);
        cosim_multiply_add(n, inputs, s->B0, m->u, m->scratch);
        cosim_multiply_add(n, inputs, s->B1, u, m->scratch);
        memcpy(m->x, m->scratch, (size_t)n * sizeof *m->x);
        cosim_kalman_predict(n, s->Phi, 2, s->noise, m->R, m->scratch);
    }
    m->time[k] = t;
    memcpy(m->predicted + k * n, m->x, (size_t)n * sizeof *m->x);
    memcpy(m->spread + k * n * n, m->R, (size_t)(n * n) * sizeof *m->R);
    double *innovation = m->innovation + k * o, *output = m->scratch;
    cosim_multiply(o, inputs, s->D, u, output);
    for (int32_t w = 0; w < o; ++w)
        output[w] = -output[w];
    cosim_multiply_add(o, o, s->W, y, output);
    cosim_multiply(o, n, s->C, m->x, innovation);
    for (int32_t w = 0; w < o; ++w)
        innovation[w] = output[w] - innovation[w];
    for (int32_t w = 0; w < o; ++w) {
        const double *row = s->C + w * n;
        double fitted = m->innovation[k * o + w];
        for (int32_t a = 0; a < n; ++a) /* what the outputs before it have moved */
            fitted -= row[a] * (m->x[a] - m->predicted[k * n + a]);
        cosim_kalman_correct(n, row, s->deviation * s->deviation, fitted, m->x, m->R, m->scratch);
    }
    memcpy(m->u, u, (size_t)inputs * sizeof *u);
    *m->count += 1.0;
}

/* --- the smoother --- */

/* y = P v with P = R'R. */
static void multiply_covariance(int32_t n, const double *R, const double *v, double *product,
                                double *y)
{
    cosim_multiply(n, n, R, v, product);
    for (int32_t a = 0; a < n; ++a) {
        double sum = 0.0;
        for (int32_t b = 0; b < n; ++b)
            sum += R[b * n + a] * product[b];
        y[a] = sum;
    }
}

/* Back over all samples. With S = C P C' + r I, e the innovation and P the predicted covariance,
 *     m = l - C' S^-1 (e + C P l),   x_smoothed = x_predicted - P m,
 * and l of the sample before is Phi' m
 * (A. Bryson and M. Frazier, 1963): the smoother of Rauch, Tung and Striebel without an inverse
 * covariance. */
static void smooth(const cosim_augmented_kalman *s, const storage *m)
{
    const int32_t n = s->states, o = s->outputs;
    double *adjoint = m->scratch, *spread = adjoint + n, *product = spread + n, *row = product + n;
    double *S = row + n, *inverse = S + o * o, *error = inverse + o * o, *weight = error + o;
    memset(adjoint, 0, (size_t)n * sizeof *adjoint);
    for (int64_t k = (int64_t)*m->count - 1; k >= 0; --k) {
        const double *R = m->spread + k * n * n;
        for (int32_t w = 0; w < o; ++w) {
            multiply_covariance(n, R, s->C + w * n, product, row);
            for (int32_t v = 0; v < o; ++v) {
                double sum = w == v ? s->deviation * s->deviation : 0.0;
                for (int32_t a = 0; a < n; ++a)
                    sum += s->C[v * n + a] * row[a];
                S[v * o + w] = sum;
            }
        }
        multiply_covariance(n, R, adjoint, product, spread);
        cosim_multiply(o, n, s->C, spread, error);
        for (int32_t w = 0; w < o; ++w)
            error[w] += m->innovation[k * o + w];
        cosim_invert(o, S, inverse);
        cosim_multiply(o, o, inverse, error, weight);
        for (int32_t w = 0; w < o; ++w)
            for (int32_t a = 0; a < n; ++a)
                adjoint[a] -= s->C[w * n + a] * weight[w];
        multiply_covariance(n, R, adjoint, product, spread);
        m->delta[k] = m->predicted[k * n + n - 2] - spread[n - 2];
        for (int32_t a = 0; a < n; ++a) {
            double sum = 0.0;
            for (int32_t b = 0; b < n; ++b)
                sum += s->Phi[b * n + a] * adjoint[b];
            row[a] = sum;
        }
        memcpy(adjoint, row, (size_t)n * sizeof *adjoint);
    }
}

void cosim_augmented_kalman_smooth(const cosim_augmented_kalman *s, double *delta)
{
    const storage m = storage_of(s);
    smooth(s, &m);
    memcpy(delta, m.delta, (size_t)*m.count * sizeof *delta);
}

/* delta, and the signals among the alphas: what the regressor takes. */
static void sample(const cosim_augmented_kalman *s, const storage *m, int64_t k, double *u)
{
    u[0] = m->delta[k];
    memcpy(u + 1, m->signals + k * s->signals, (size_t)s->signals * sizeof *u);
}

/* Projection on the smoothed delta: all samples of it at once. */
static void estimate(const cosim_augmented_kalman *s, const storage *m, double h)
{
    const int64_t count = (int64_t)*m->count;
    const int32_t terms = s->terms, signals = s->signals;
    cosim_identifier projection = *s->projection;
    const cosim_regressor *products = projection.products;
    double *outputs = m->scratch, *input = outputs + projection.width;
    double *u0 = input + terms + signals + 1, *u1 = u0 + 1 + signals;
    smooth(s, m);
    projection.period = (int32_t)count;
    cosim_identifier_start(&projection, outputs);
    products->memory[0] = 0.0; /* samples before now */
    sample(s, m, 0, u1);
    cosim_regressor_outputs(products, m->time[0], u1, input);
    for (int64_t k = 0; k < count; ++k) {
        memcpy(u0, u1, (size_t)(1 + signals) * sizeof *u0);
        memcpy(input + terms, u0 + 1, (size_t)signals * sizeof *input);
        input[terms + signals] = u0[0];
        cosim_identifier_step(&projection, m->time[k], m->time[k] + h, h, input, input, outputs);
        if (k + 1 == count)
            break;
        sample(s, m, k + 1, u1);
        cosim_regressor_step((void *)products, m->time[k], m->time[k + 1], h, u0, u1, input);
    }
    memcpy(m->outputs, outputs, (size_t)s->parameters * sizeof *outputs);
}

int32_t cosim_augmented_kalman_step(void *self, double t0, double t1, double h, const double *u0,
                                    const double *u1, double *y)
{
    (void)t1, (void)u1;
    const cosim_augmented_kalman *s = self;
    const storage m = storage_of(s);
    const double *signals = u0 + s->terms, *measured = signals + s->signals;
    if ((int64_t)*m.count == s->capacity)
        return COSIM_FULL;
    memcpy(m.signals + (int64_t)*m.count * s->signals, signals,
           (size_t)s->signals * sizeof *signals);
    take_sample(s, &m, t0, measured, measured + s->outputs);
    const int is_last = (int64_t)*m.count == s->capacity;
    if (s->projection && (*m.count >= *m.next_estimate || is_last)) {
        estimate(s, &m, h);
        *m.next_estimate = ceil(LATER * *m.count);
    }
    memcpy(y, m.outputs, (size_t)s->parameters * sizeof *y);
    return COSIM_OK;
}
