#include "extended_kalman.h"
#include "kalman.h"
#include "linear.h"

#include <math.h>
#include <string.h>

#define INFORMED 0.5 /* standard error over that at first, below which theta is an estimate */

typedef struct {
    int32_t n;          /* of all states */
    int32_t x, beta;    /* of these */
    int32_t parameters;
    int32_t E, F;       /* doubles of all E and F */
    int32_t largest;    /* V_i */
} layout;

static layout layout_of(const cosim_output_error *model)
{
    layout l = {.x = model->states};
    for (int32_t i = 0; i < model->components; ++i) {
        const int32_t V = model->size[i];
        l.beta += V;
        l.parameters += model->count[i];
        l.E += V * V;
        l.F += model->count[i] * V * V;
        l.largest = V > l.largest ? V : l.largest;
    }
    l.n = l.x + l.beta + l.parameters;
    return l;
}

typedef struct {
    double *count;
    double *state, *R;  /* (n), (n, n) */
    double *u, *alpha;  /* of the sample before */
    double *now;        /* (components) alpha of this one */
    double *present;    /* (components) 1: no noise */
    double *next, *Phi; /* (n), (n, n) */
    double *E, *F, *row, *scratch;
    int64_t size;
} parts;

static parts parts_of(const cosim_extended_kalman *s, layout l)
{
    const int64_t n = l.n, V = l.largest;
    const int64_t exponential = 16 * V * V, prediction = n * n + n;
    parts p;
    double *next = s->memory;
    p.count = next++;
    p.state = next, next += n;
    p.R = next, next += n * n;
    p.u = next, next += s->known->inputs;
    p.alpha = next, next += s->model->components;
    p.now = next, next += s->model->components;
    p.present = next, next += s->model->components;
    p.next = next, next += n;
    p.Phi = next, next += n * n;
    p.E = next, next += l.E;
    p.F = next, next += l.F;
    p.row = next, next += n;
    p.scratch = next, next += 2 * n + (exponential > prediction ? exponential : prediction);
    p.size = next - s->memory;
    return p;
}

int64_t cosim_extended_kalman_memory(const cosim_extended_kalman *s)
{
    return parts_of(s, layout_of(s->model)).size;
}

void cosim_extended_kalman_start(cosim_extended_kalman *s, double *y)
{
    const layout l = layout_of(s->model);
    const parts p = parts_of(s, l);
    memset(s->memory, 0, (size_t)p.size * sizeof *s->memory);
    for (int32_t a = 0; a < l.n; ++a) {
        const int32_t j = a - l.x - l.beta;
        p.state[a] = j < 0 ? 0.0 : s->theta[j];
        p.R[a * l.n + a] = j < 0 ? s->size : s->spread[j];
    }
    for (int32_t i = 0; i < 2 * l.parameters; ++i)
        y[i] = cosim_no_value();
}

/* c_i'v of a component. */
static double output_of(const double *c, int32_t V, const double *v)
{
    double sum = 0.0;
    for (int32_t a = 0; a < V; ++a)
        sum += c[a] * v[a];
    return sum;
}

/* beta, its transition, and what it and theta make of x. */
static void move_component(const cosim_extended_kalman *s, layout l, const parts *p, int32_t i,
                           int32_t column, int32_t parameter, const double *c, const double *E,
                           const double *F, double alpha1)
{
    const cosim_output_error *model = s->model;
    const int32_t V = model->size[i], n = l.n, theta = l.x + l.beta + parameter;
    const double *beta = p->state + l.x + column;
    const double *B0 = model->B0 + i * l.x, *B1 = model->B1 + i * l.x;
    double *moved = p->next + l.x + column, *slope = p->scratch;
    cosim_multiply(V, V, E, beta, moved);
    for (int32_t a = 0; a < V; ++a)
        for (int32_t b = 0; b < V; ++b)
            p->Phi[(l.x + column + a) * n + l.x + column + b] = E[a * V + b];
    const double input0 = p->alpha[i] * output_of(c, V, beta);
    const double input1 = alpha1 * output_of(c, V, moved);
    for (int32_t a = 0; a < l.x; ++a) {
        p->next[a] += B0[a] * input0 + B1[a] * input1;
        for (int32_t b = 0; b < V; ++b) {
            double by_E = 0.0;
            for (int32_t k = 0; k < V; ++k)
                by_E += c[k] * E[k * V + b];
            p->Phi[a * n + l.x + column + b] = B0[a] * p->alpha[i] * c[b] + B1[a] * alpha1 * by_E;
        }
    }
    for (int32_t j = 0; j < model->count[i]; ++j) {
        cosim_multiply(V, V, F + j * V * V, beta, slope);
        for (int32_t a = 0; a < V; ++a)
            p->Phi[(l.x + column + a) * n + theta + j] = slope[a];
        const double by_theta = alpha1 * output_of(c, V, slope);
        for (int32_t a = 0; a < l.x; ++a)
            p->Phi[a * n + theta + j] = B1[a] * by_theta;
    }
}

/* From the sample before to this one. */
static void predict(const cosim_extended_kalman *s, layout l, const parts *p, const double *u,
                    const double *alpha)
{
    const cosim_output_error *model = s->model;
    const int32_t n = l.n, first = l.x + l.beta, inputs = s->known->inputs;
    cosim_output_error_basis(model, p->state + first, model->step[0], p->E, p->F, p->scratch);
    memset(p->Phi, 0, (size_t)(n * n) * sizeof *p->Phi);
    for (int32_t a = 0; a < l.x; ++a)
        memcpy(p->Phi + a * n, model->Ad + a * l.x, (size_t)l.x * sizeof *p->Phi);
    for (int32_t j = first; j < n; ++j) {
        p->Phi[j * n + j] = 1.0;
        p->next[j] = p->state[j];
    }
    cosim_multiply(l.x, l.x, model->Ad, p->state, p->next);
    cosim_multiply_add(l.x, inputs, s->known->B0, p->u, p->next);
    cosim_multiply_add(l.x, inputs, s->known->B1, u, p->next);
    const double *c = model->c, *E = p->E, *F = p->F;
    int32_t column = 0, parameter = 0;
    for (int32_t i = 0; i < model->components; ++i) {
        const int32_t V = model->size[i];
        move_component(s, l, p, i, column, parameter, c, E, F, alpha[i]);
        column += V, parameter += model->count[i];
        c += V, E += V * V, F += model->count[i] * V * V;
    }
    memcpy(p->state, p->next, (size_t)n * sizeof *p->state);
    cosim_kalman_predict(n, p->Phi, 0, p->Phi, p->R, p->scratch);
}

/* Take the outputs, made white by W, one after the other. */
static void correct(const cosim_extended_kalman *s, layout l, const parts *p, const double *y,
                    const double *u, const double *alpha)
{
    const cosim_output_error *model = s->model;
    const int32_t outputs = model->outputs;
    for (int32_t w = 0; w < outputs; ++w) {
        double innovation = 0.0;
        memset(p->row, 0, (size_t)l.n * sizeof *p->row);
        for (int32_t o = 0; o < outputs; ++o) {
            const double weight = model->W[w * outputs + o];
            const double *c = model->c;
            double measured = y[o];
            int32_t column = l.x;
            for (int32_t k = 0; k < s->known->inputs; ++k)
                measured -= s->known->D[o * s->known->inputs + k] * u[k];
            innovation += weight * measured;
            for (int32_t a = 0; a < l.x; ++a)
                p->row[a] += weight * model->C[o * l.x + a];
            for (int32_t i = 0; i < model->components; ++i) {
                const double gain = weight * model->D[i * outputs + o] * alpha[i];
                for (int32_t b = 0; b < model->size[i]; ++b)
                    p->row[column + b] += gain * c[b];
                column += model->size[i], c += model->size[i];
            }
        }
        for (int32_t a = 0; a < l.n; ++a)
            innovation -= p->row[a] * p->state[a];
        cosim_kalman_correct(l.n, p->row, s->deviation * s->deviation, innovation, p->state, p->R,
                             p->scratch);
    }
}

/* A component is there from when on beta' C^-1 beta was more than noise makes of it. */
static void find_present(const cosim_extended_kalman *s, layout l, const parts *p)
{
    double *C = p->scratch, *inverse = C + l.largest * l.largest;
    int32_t first = l.x;
    for (int32_t i = 0; i < s->model->components; ++i) {
        const int32_t V = s->model->size[i];
        const double *beta = p->state + first;
        double statistic = 0.0;
        for (int32_t a = 0; a < V; ++a)
            for (int32_t b = 0; b < V; ++b) {
                C[a * V + b] = 0.0;
                for (int32_t k = 0; k < l.n; ++k)
                    C[a * V + b] += p->R[k * l.n + first + a] * p->R[k * l.n + first + b];
            }
        if (cosim_invert(V, C, inverse) == COSIM_OK)
            for (int32_t a = 0; a < V; ++a)
                for (int32_t b = 0; b < V; ++b)
                    statistic += beta[a] * inverse[a * V + b] * beta[b];
        if (statistic > s->threshold[i])
            p->present[i] = 1.0;
        first += V;
    }
}

static void write_outputs(const cosim_extended_kalman *s, layout l, const parts *p, double *y)
{
    int32_t j = 0;
    for (int32_t i = 0; i < s->model->components; ++i)
        for (int32_t k = 0; k < s->model->count[i]; ++k, ++j) {
            const int32_t state = l.x + l.beta + j;
            const double error = sqrt(cosim_kalman_variance(l.n, p->R, state));
            const int known = p->present[i] != 0.0 && error < INFORMED * s->spread[j] &&
                              isfinite(p->state[state]);
            y[j] = known ? p->state[state] : cosim_no_value();
            y[l.parameters + j] = known ? error : cosim_no_value();
        }
}

int32_t cosim_extended_kalman_step(void *self, double t0, double t1, double h, const double *u0,
                                   const double *u1, double *y)
{
    (void)t1, (void)h, (void)u1;
    const cosim_extended_kalman *s = self;
    const layout l = layout_of(s->model);
    const parts p = parts_of(s, l);
    const double *signals = u0 + s->terms, *measured = signals + s->alphas->signals;
    const double *u = measured + s->model->outputs;
    double *alpha = p.now;
    cosim_alphas_at(s->alphas, t0, signals, alpha);
    if (*p.count > 0.0)
        predict(s, l, &p, u, alpha);
    correct(s, l, &p, measured, u, alpha);
    find_present(s, l, &p);
    memcpy(p.u, u, (size_t)s->known->inputs * sizeof *u);
    memcpy(p.alpha, alpha, (size_t)s->model->components * sizeof *alpha);
    *p.count += 1.0;
    write_outputs(s, l, &p, y);
    return COSIM_OK;
}
