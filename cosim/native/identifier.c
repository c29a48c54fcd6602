#include "cosim.h"

#include <math.h>
#include <string.h>

#define LATER 1.1  /* a search that found nothing is repeated when there are so many times more samples */
#define ROWS_A_TERM 2 /* rows of the regression before the first search */
#define ROUNDING 0x1p-44 /* of a simulated output, relative to the largest one */
#define TOLERANCE 6.0 /* of a step since the last pass, in steps that are small enough */

/* The state, and behind it the samples, which are only ever appended. */
typedef struct {
    double *count, *taken, *has_theta, *next_search, *largest, *largest_delta, *rows, *summed;
    double *sums, *factors; /* of mu, and of the products of alphas in it */
    double *theta, *outputs;
    double *R, *N;
    double *x;
    double *amplitudes, *work;             /* of y */
    double *delta_amplitudes, *delta_work; /* of delta */
    int64_t state;
    double *before; /* y and u of the last two samples */
    double *time, *betweens; /* of the last sample; number of samples between those of the grid */
    double *residual, *alpha;
    double *delta, *delta_alpha;
    double *between;
    int64_t size;
} storage;

static int32_t n_outputs(const cosim_identifier *s) { return s->on_y ? s->on_y->outputs : 0; }

static int64_t columns_of(const cosim_output_error *model)
{
    return model ? cosim_output_error_columns(model) : 0;
}

static int64_t memory_of(const cosim_output_error *model)
{
    return model ? cosim_output_error_memory(model) : 0;
}

static storage storage_of(const cosim_identifier *s)
{
    const int64_t P = s->rayleigh->parameters, terms = s->rayleigh->terms;
    const int64_t components = s->rayleigh->components;
    const int64_t capacity = s->on_delta ? s->capacity : 0;
    const int64_t inputs = s->on_y ? s->known->inputs : 0;
    storage m;
    double *next = s->memory;
    m.count = next++;
    m.taken = next++;
    m.has_theta = next++;
    m.next_search = next++;
    m.largest = next++;
    m.largest_delta = next++;
    m.rows = next++;
    m.summed = next++;
    m.sums = next, next += terms;
    m.factors = next, next += terms;
    m.theta = next, next += P;
    m.outputs = next, next += s->width;
    m.R = next, next += terms * terms;
    m.N = next, next += terms * terms;
    m.x = next, next += s->on_y ? 2 * s->on_y->states : 0;
    m.amplitudes = next, next += columns_of(s->on_y);
    m.work = next, next += memory_of(s->on_y);
    m.delta_amplitudes = next, next += columns_of(s->on_delta);
    m.delta_work = next, next += memory_of(s->on_delta);
    m.before = next, next += 2 * (n_outputs(s) + inputs);
    m.time = next++;
    m.betweens = next++;
    m.state = next - s->memory;
    m.residual = next, next += capacity * n_outputs(s);
    m.alpha = next, next += capacity * components;
    m.delta = next, next += capacity;
    m.delta_alpha = next, next += capacity * components;
    m.between = next, next += s->between ? cosim_between_memory(s->between) : 0;
    m.size = next - s->memory;
    return m;
}

int64_t cosim_identifier_memory(const cosim_identifier *s) { return storage_of(s).size; }
int64_t cosim_identifier_state(const cosim_identifier *s) { return storage_of(s).state; }

static double no_value(void)
{
    const uint64_t bits = UINT64_C(0x7FF8000000000000);
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static void forget_outputs(const cosim_identifier *s, const storage *m)
{
    for (int32_t i = 0; i < s->width; ++i)
        m->outputs[i] = no_value();
}

void cosim_identifier_start(cosim_identifier *s, double *y)
{
    const storage m = storage_of(s);
    memset(s->memory, 0, (size_t)m.state * sizeof *s->memory);
    forget_outputs(s, &m);
    memcpy(y, m.outputs, (size_t)s->width * sizeof *y);
}

/* --- samples --- */

/* S grows by mu mu', N by the covariance of the noise that delta(t - D_j) brings into mu: terms with
 * the same row of delta share it. Both of means over some samples: (25) is linear in mu, so it holds
 * for them too, and the noise of a derivative nearly cancels in them. */
static void take_regressor(const cosim_identifier *s, const storage *m, double t, const double *mu)
{
    const cosim_regressor *products = s->products;
    const int32_t terms = s->rayleigh->terms;
    double alpha[COSIM_MOST_TERMS], work[COSIM_MOST_TERMS];
    for (int32_t c = 0; c < terms; ++c)
        if (isnan(mu[c]))
            return;
    for (int32_t b = 0; b < products->groups; ++b)
        for (int32_t j = 0; j < products->rows; ++j)
            alpha[b * products->rows + j] =
                cosim_evaluate(&products->alphas[b], t - products->delays[j]);
    for (int32_t c = 0; c < terms; ++c) {
        double factor = products->sign[c];
        for (int32_t f = 0; f < products->factors; ++f)
            factor *= alpha[products->factor[c * products->factors + f]];
        m->sums[c] += mu[c];
        m->factors[c] += factor;
    }
    *m->summed += 1.0;
    if (*m->summed < s->average)
        return;
    for (int32_t a = 0; a < terms; ++a)
        for (int32_t b = 0; b < terms; ++b)
            if (products->row[a] == products->row[b])
                m->N[a * terms + b] += m->factors[a] * m->factors[b];
    cosim_householder(terms, m->R, 1, m->sums, work);
    for (int32_t c = 0; c < terms; ++c)
        m->sums[c] = m->factors[c] = 0.0;
    *m->summed = 0.0;
    *m->rows += 1.0;
}

/* The outputs at the communication point, where they are sampled at instants of their own: NaN
 * unless one of these is that point. The others are appended. */
static int32_t take_between(const cosim_identifier *s, const storage *m, double t,
                            const double *samples, const double *u, double *y)
{
    const double *u_before = m->before + 2 * n_outputs(s) + s->known->inputs;
    const double before = *m->count > 0.0 ? *m->time : t;
    cosim_between_record record = cosim_between_in(s->between, m->between, (int64_t)*m->betweens);
    const int32_t status = cosim_between_take(s->between, (int64_t)*m->count, before, t, m->x,
                                              u_before, u, samples, &record, y);
    *m->betweens = (double)record.count;
    *m->time = t;
    return status;
}

static void take_delta(const cosim_identifier *s, const storage *m, double t, const double *delta)
{
    const int32_t components = s->rayleigh->components;
    const int64_t k = (int64_t)*m->count;
    for (int32_t i = 0; i < components; ++i) {
        m->alpha[k * components + i] = cosim_evaluate(&s->alphas[i], t);
        m->delta_alpha[k * components + i] =
            s->lag == 0.0 ? m->alpha[k * components + i] : cosim_evaluate(&s->alphas[i], t - s->lag);
    }
    m->delta[k] = t >= s->settled ? *delta : no_value();
    if (fabs(*delta) > *m->largest_delta)
        *m->largest_delta = fabs(*delta);
}

static int32_t take_outputs(const cosim_identifier *s, const storage *m, double t, const double *y)
{
    double at_point[COSIM_MOST_COLUMNS];
    const int32_t outputs = n_outputs(s), inputs = s->known->inputs;
    const int64_t k = (int64_t)*m->count;
    const double *u = y + outputs;
    for (int32_t o = 0; o < outputs; ++o)
        if (fabs(y[o]) > *m->largest)
            *m->largest = fabs(y[o]);
    if (s->between) {
        const double *samples = u;
        u += (outputs + 1) * s->between->most;
        const int32_t status = take_between(s, m, t, samples, u, at_point);
        if (status)
            return status;
        y = at_point;
    }
    double *ys = m->before, *us = m->before + 2 * outputs;
    memcpy(ys, ys + outputs, (size_t)outputs * sizeof *ys);
    memcpy(us, us + inputs, (size_t)inputs * sizeof *us);
    memcpy(ys + outputs, y, (size_t)outputs * sizeof *ys);
    memcpy(us + inputs, u, (size_t)inputs * sizeof *us);
    double pair[2 * COSIM_MOST_COLUMNS];
    const int64_t begin = k > 0 ? 1 : 0; /* of the pair: the sample before it, and it */
    cosim_output_error_residual(s->on_y, s->known, begin, begin + 1, us + (begin ? 0 : inputs),
                                ys + (begin ? 0 : outputs), NULL, m->x, pair);
    memcpy(m->residual + k * outputs, pair + begin * outputs, (size_t)outputs * sizeof *pair);
    return COSIM_OK;
}

static int32_t take_sample(const cosim_identifier *s, const storage *m, double t,
                           const double *input)
{
    int32_t status = COSIM_OK;
    const double *delta = input + s->rayleigh->terms;
    if (t >= s->start)
        take_regressor(s, m, t, input);
    if (s->on_delta)
        take_delta(s, m, t, delta);
    if (s->on_y)
        status = take_outputs(s, m, t, delta + 1);
    if (status)
        return status;
    *m->count += 1.0;
    return COSIM_OK;
}

/* --- estimates --- */

typedef struct {
    cosim_fit fit;
    cosim_experiment experiment;
    cosim_between_record between;
    double estimate[COSIM_MOST_PARAMETERS];
    double covariance[COSIM_MOST_PARAMETERS * COSIM_MOST_PARAMETERS];
    double statistics[COSIM_MOST_PARAMETERS];
    double nothing[COSIM_MOST_PARAMETERS];
    uint8_t state[COSIM_MOST_PARAMETERS];
} estimation;

static void prepare_fit(const cosim_identifier *s, estimation *e, double accuracy, double *theta)
{
    memset(e->nothing, 0, sizeof e->nothing);
    e->fit = (cosim_fit){
        .experiments = 1,
        .components = s->rayleigh->components,
        .parameters = s->rayleigh->parameters,
        .most_iterations = 40,
        .experiment = &e->experiment,
        .count = s->rayleigh->count,
        .lower = s->lower,
        .upper = s->upper,
        .scale = s->scale,
        .threshold = s->threshold,
        .accuracy = accuracy,
        .tolerance = TOLERANCE,
        .theta = theta,
        .estimate = e->estimate,
        .covariance = e->covariance,
        .statistics = e->statistics,
        .state = e->state,
    };
}

static void prepare_fit_of_y(const cosim_identifier *s, const storage *m, double *theta, estimation *e)
{
    const int64_t count = (int64_t)*m->count;
    const int64_t first = s->window && count > s->window ? count - s->window : 0;
    prepare_fit(s, e, ROUNDING * *m->largest * s->weight, theta);
    e->experiment = (cosim_experiment){
        .model = s->on_y,
        .record = {first, count, m->residual, m->alpha, NULL, NULL},
        .work = m->work,
        .amplitudes = m->amplitudes,
    };
    if (s->between) {
        e->between = cosim_between_in(s->between, m->between, (int64_t)*m->betweens);
        e->experiment.record.between = &e->between;
    }
}

static void prepare_fit_of_delta(const cosim_identifier *s, const storage *m, double *theta,
                                 estimation *e)
{
    const int64_t count = (int64_t)*m->count;
    const int64_t first = s->window && count > s->window ? count - s->window : 0;
    prepare_fit(s, e, ROUNDING * *m->largest_delta, theta);
    e->fit.threshold = e->nothing; /* its noise is not white, so nothing is said of what is there */
    e->experiment = (cosim_experiment){
        .model = s->on_delta,
        .record = {first, count, m->delta, m->delta_alpha, NULL, NULL},
        .work = m->delta_work,
        .amplitudes = m->delta_amplitudes,
    };
}

/* Of the last stage that there is. */
static void prepare_last_fit(const cosim_identifier *s, const storage *m, double *theta,
                             estimation *e)
{
    if (s->on_y)
        prepare_fit_of_y(s, m, theta, e);
    else
        prepare_fit_of_delta(s, m, theta, e);
}

/* Only what is fitted to y has errors: the noise of delta is not white. */
static void write_outputs(const cosim_identifier *s, const storage *m, const estimation *e)
{
    const int32_t P = s->rayleigh->parameters;
    double unused[COSIM_MOST_PARAMETERS + 1];
    double *theta = m->outputs, *error = unused, *deviation = unused + P, *amplitudes = theta + P;
    int32_t column = 0, j = 0;
    if (s->on_y) {
        error = theta + P;
        deviation = error + P;
        amplitudes = deviation + 1;
    }
    *deviation = sqrt(e->fit.variance);
    for (int32_t i = 0; i < s->rayleigh->components; ++i) {
        for (int32_t k = 0; k < s->rayleigh->count[i]; ++k, ++j) {
            const int known = e->state[j] == COSIM_ESTIMATED || e->state[j] == COSIM_FIXED;
            theta[j] = known ? e->estimate[j] : no_value();
            error[j] = known ? sqrt(e->covariance[j * P + j]) : no_value();
        }
        for (int32_t k = 0; k < s->rayleigh->size[i]; ++k, ++column)
            amplitudes[column] = e->experiment.amplitudes[column];
    }
}

/* Search a start on the regression, improve it on delta, and fit y; as far as the stages go. */
static int32_t search(const cosim_identifier *s, const storage *m, estimation *e)
{
    const int32_t P = s->rayleigh->parameters;
    double theta[COSIM_MOST_PARAMETERS], on_delta[COSIM_MOST_PARAMETERS], value;
    if (*m->rows < ROWS_A_TERM * s->rayleigh->terms)
        return COSIM_NO_VALUE;
    const int32_t found = cosim_rayleigh_search(s->rayleigh, m->R, m->N, theta, &value);
    if (found == COSIM_NO_VALUE)
        return found;
    memcpy(on_delta, theta, (size_t)P * sizeof *theta);
    prepare_fit_of_delta(s, m, on_delta, e);
    const int32_t improved = cosim_output_error_fit(&e->fit);
    if (improved == COSIM_OK)
        memcpy(theta, e->estimate, (size_t)P * sizeof *theta);
    memcpy(m->theta, theta, (size_t)P * sizeof *theta);
    if (!s->on_y)
        return improved;
    prepare_fit_of_y(s, m, m->theta, e);
    return cosim_output_error_fit(&e->fit);
}

/* Go on from the last estimate: over the new samples alone where that is enough. */
static int32_t follow(const cosim_identifier *s, const storage *m, estimation *e)
{
    const int32_t P = s->rayleigh->parameters;
    prepare_last_fit(s, m, m->theta, e);
    const cosim_experiment *x = &e->experiment;
    if (x->record.first == 0) {
        cosim_output_error_take(x->model, m->theta, &x->record, (int64_t)*m->taken, x->record.end,
                                x->work);
        const int32_t status = cosim_output_error_update(&e->fit);
        if (status != COSIM_NOT_CONVERGED)
            return status;
        memcpy(m->theta, e->estimate, (size_t)P * sizeof *m->theta);
    }
    return cosim_output_error_fit(&e->fit);
}

static int is_any_absent(const cosim_identifier *s, const estimation *e)
{
    for (int32_t j = 0; j < s->rayleigh->parameters; ++j)
        if (e->state[j] == COSIM_ABSENT)
            return 1;
    return 0;
}

static void estimate(const cosim_identifier *s, const storage *m)
{
    estimation e;
    const int due = *m->count >= *m->next_search;
    int32_t status = COSIM_NO_VALUE;
    if (*m->has_theta != 0.0)
        status = follow(s, m, &e);
    if (due && (status != COSIM_OK || is_any_absent(s, &e))) {
        double before[COSIM_MOST_PARAMETERS];
        const int was_found = status == COSIM_OK;
        memcpy(before, m->theta, (size_t)s->rayleigh->parameters * sizeof *before);
        status = search(s, m, &e);
        if (status != COSIM_OK && was_found) {
            memcpy(m->theta, before, (size_t)s->rayleigh->parameters * sizeof *before);
            prepare_last_fit(s, m, m->theta, &e);
            status = cosim_output_error_fit(&e.fit);
        }
        *m->next_search = ceil(LATER * *m->count);
    }
    *m->has_theta = status == COSIM_OK;
    *m->taken = *m->count;
    forget_outputs(s, m);
    if (status == COSIM_OK)
        write_outputs(s, m, &e);
}

static int is_zero(int32_t n, const double *R)
{
    for (int32_t i = 0; i < n; ++i)
        if (R[i * n + i] != 0.0)
            return 0;
    return 1;
}

/* The quotient alone changes when there is a new row. */
static void estimate_by_quotient(const cosim_identifier *s, const storage *m)
{
    const int32_t P = s->rayleigh->parameters;
    double theta[COSIM_MOST_PARAMETERS], value;
    int32_t status = COSIM_NOT_CONVERGED;
    if (*m->rows == *m->taken || *m->rows < ROWS_A_TERM * s->rayleigh->terms ||
        is_zero(s->rayleigh->terms, m->R))
        return;
    *m->taken = *m->rows;
    if (*m->has_theta != 0.0 && *m->rows < *m->next_search) {
        memcpy(theta, m->theta, (size_t)P * sizeof *theta);
        status = cosim_rayleigh_minimize(s->rayleigh, m->R, m->N, theta, &value);
    }
    if (status != COSIM_OK) {
        status = cosim_rayleigh_search(s->rayleigh, m->R, m->N, theta, &value);
        *m->next_search = ceil(LATER * *m->rows);
    }
    *m->has_theta = status == COSIM_OK;
    forget_outputs(s, m);
    if (status != COSIM_OK)
        return;
    memcpy(m->theta, theta, (size_t)P * sizeof *theta);
    memcpy(m->outputs, theta, (size_t)P * sizeof *theta);
}

int32_t cosim_identifier_step(void *self, double t0, double t1, double h, const double *u0,
                              const double *u1, double *y)
{
    (void)t1, (void)h, (void)u1;
    const cosim_identifier *s = self;
    const storage m = storage_of(s);
    if (s->on_delta && (int64_t)*m.count == s->capacity)
        return COSIM_FULL;
    const int32_t status = take_sample(s, &m, t0, u0);
    if (status)
        return status;
    if ((int64_t)*m.count % s->period == 0) {
        if (s->on_delta)
            estimate(s, &m);
        else
            estimate_by_quotient(s, &m);
    }
    memcpy(y, m.outputs, (size_t)s->width * sizeof *y);
    return COSIM_OK;
}
