#include "identifier.h"
#include "householder.h"
#include "linear.h"
#include "weights.h"

#include <math.h>
#include <string.h>

#define LATER 1.4  /* a search that missed a component is repeated at so many times more samples */
#define AGAIN 2.0  /* one that found all */
#define SELDOM 32.0 /* and one that confirmed a fit far better than all others */
#define GROWN 6.0  /* deviations of a variance by which that of the residual has grown then */
#define STARTS 8   /* points of the grid that y is fitted from */
#define BESIDE 4   /* and beside a fit */
#define ROUNDS 3   /* of a search beside the best fit of the last one */
#define RIVALS 8   /* other minima that are kept from one search to the next */
#define ROWS_A_TERM 2 /* rows of a regression before the first search */
#define ITERATIONS 120 /* of a fit */
#define START_ITERATIONS 20 /* of one from a start; only the lowest is worth more */
#define SAME 0.1             /* standard errors between two fits of the same minimum */
#define NEAR 0.05            /* longest steps between a start and the minimum that it leads to */
#define ROUNDING_OF_THETA 0x1p-20 /* relative to its longest step */
#define MARGIN 25.0   /* variances by which other minima must be worse to be no rivals */
#define RULED_OUT 12.0 /* by which they must be so that the standard error need not reach them */
#define CLEAR 1e4     /* by which they are where more samples will not make rivals of them */
#define ROUNDING 0x1p-44 /* of a simulated output, relative to the largest one */
#define WEIGHINGS 4   /* of several outputs by what a fit to them leaves, after a search */
#define FEWEST 20.0   /* degrees of freedom for each entry of a covariance with correlations */
#define MOST_EXACT 0x1p-26 /* of an output, relative to its largest value: it may be on a lattice */
#define TOLERANCE 6.0 /* of a step since the last pass, in steps that are small enough */

/* The state, and behind it the samples, which are only ever appended. */
typedef struct {
    double *count, *taken, *has_theta, *next_search, *largest, *largest_delta, *rows, *summed;
    double *sums, *factors; /* of mu, and of the products of alphas in it */
    double *theta, *outputs;
    /* what the last search left: how many, (RIVALS, parameters), and by how many variances they are
     * worse */
    double *rivals, *rival_theta, *excess;
    double *searched, *variance, *freedom; /* samples at the last search, and what its fit left */
    double *R, *N;
    double *x;
    double *amplitudes, *work;             /* of y */
    double *W, *deviations;                /* of its noise */
    double *delta_amplitudes, *delta_work; /* of delta */
    double *before; /* y and u of the last two samples */
    double *pasts;          /* signals among the alphas, of the last samples */
    double *time, *betweens; /* of the last sample; number of samples between those of the grid */
    double *P, *gain; /* (modes, modes), (states, outputs) of the predictor for the next sample */
    int64_t state;
    double *grid_work; /* of the grid of starts; scratch from here on, but for the samples */
    double *grid_G0, *grid_theta; /* of its points, the last ones those of a fit */
    double *grid_search, *covariance, *least, *factor; /* scratch */
    double *at_point, *pair; /* y at a communication point, and two residuals; scratch */
    double *residual, *alpha;
    double *delta, *delta_alpha;
    double *between;
    /* of the intervals that end at each sample, where y is predicted from samples that may be
     * missing */
    double *step, *Ad, *B0, *B1, *K, *L;
    int32_t *interval;
    double *of_modes, *known_B0, *predicting; /* scratch */
    int32_t *there;
    uint8_t *measured;
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

/* The numbers of all points of a grid: their theta, or their G. */
static int64_t entries_of(const cosim_start_grid *grid, int order)
{
    int64_t entries = 0;
    for (int32_t i = 0; i < grid->components; ++i) {
        const int32_t V = grid->size[i];
        entries += (int64_t)grid->points[i] * (order == 2 ? V * V : grid->count[i]);
    }
    return entries;
}

static storage storage_of(const cosim_identifier *s)
{
    const int64_t P = s->rayleigh->parameters, terms = s->rayleigh->terms;
    const int64_t components = s->rayleigh->components;
    const int64_t capacity = s->on_delta ? s->capacity : 0;
    const int64_t inputs = s->on_y ? s->known->inputs : 0;
    storage m;
    int64_t next = 0;
    m.count = cosim_place(s->memory, &next, 1);
    m.taken = cosim_place(s->memory, &next, 1);
    m.has_theta = cosim_place(s->memory, &next, 1);
    m.next_search = cosim_place(s->memory, &next, 1);
    m.largest = cosim_place(s->memory, &next, n_outputs(s));
    m.largest_delta = cosim_place(s->memory, &next, 1);
    m.rows = cosim_place(s->memory, &next, 1);
    m.summed = cosim_place(s->memory, &next, 1);
    m.sums = cosim_place(s->memory, &next, terms);
    m.factors = cosim_place(s->memory, &next, terms);
    m.theta = cosim_place(s->memory, &next, P);
    m.outputs = cosim_place(s->memory, &next, s->width);
    m.rivals = cosim_place(s->memory, &next, 1);
    m.rival_theta = cosim_place(s->memory, &next, RIVALS * P);
    m.excess = cosim_place(s->memory, &next, RIVALS);
    m.searched = cosim_place(s->memory, &next, 1);
    m.variance = cosim_place(s->memory, &next, 1);
    m.freedom = cosim_place(s->memory, &next, 1);
    m.R = cosim_place(s->memory, &next, terms * terms);
    m.N = cosim_place(s->memory, &next, terms * terms);
    m.x = cosim_place(s->memory, &next, s->on_y ? 2 * s->on_y->states : 0);
    m.amplitudes = cosim_place(s->memory, &next, columns_of(s->on_y));
    m.work = cosim_place(s->memory, &next, memory_of(s->on_y));
    m.W = cosim_place(s->memory, &next, n_outputs(s) * n_outputs(s));
    m.deviations = cosim_place(s->memory, &next, n_outputs(s));
    m.delta_amplitudes = cosim_place(s->memory, &next, columns_of(s->on_delta));
    m.delta_work = cosim_place(s->memory, &next, memory_of(s->on_delta));
    m.before = cosim_place(s->memory, &next, 2 * (n_outputs(s) + inputs));
    m.pasts = cosim_place(s->memory, &next, cosim_past_alphas_memory(s->products->alphas));
    m.time = cosim_place(s->memory, &next, 1);
    m.betweens = cosim_place(s->memory, &next, 1);
    const cosim_predictor *modes = s->predictor ? &s->predictor->modes : NULL;
    const int64_t n_modes = modes ? modes->states : 0, outputs = modes ? modes->outputs : 0;
    const int64_t states = modes ? s->on_y->states : 0;
    const int64_t sources = modes ? s->on_y->sources : 0, room = modes ? capacity : 0;
    m.P = cosim_place(s->memory, &next, n_modes * n_modes);
    m.gain = cosim_place(s->memory, &next, states * outputs);
    const cosim_output_error *on_grid = s->grids ? s->grid->model : NULL;
    m.state = next;
    m.grid_work = cosim_place(s->memory, &next, memory_of(on_grid));
    m.grid_G0 = cosim_place(s->memory, &next, s->grids ? entries_of(s->grid, 2) : 0);
    m.grid_theta = cosim_place(s->memory, &next, s->grids ? entries_of(s->grid, 1) : 0);
    m.grid_search =
        cosim_place(s->memory, &next, s->grids ? cosim_start_grid_memory(s->grid, 1) : 0);
    m.at_point = cosim_place(s->memory, &next, n_outputs(s));
    m.pair = cosim_place(s->memory, &next, 2 * n_outputs(s));
    m.covariance = cosim_place(s->memory, &next, n_outputs(s) * n_outputs(s));
    m.least = cosim_place(s->memory, &next, n_outputs(s));
    m.factor = cosim_place(s->memory, &next, n_outputs(s) * n_outputs(s));
    m.residual = cosim_place(s->memory, &next, capacity * n_outputs(s));
    m.alpha = cosim_place(s->memory, &next, capacity * components);
    m.delta = cosim_place(s->memory, &next, capacity);
    m.delta_alpha = cosim_place(s->memory, &next, capacity * components);
    m.between = cosim_place(s->memory, &next, s->between ? cosim_between_memory(s->between) : 0);
    m.step = cosim_place(s->memory, &next, room);
    m.interval = (int32_t *)cosim_place(s->memory, &next, room);
    m.Ad = cosim_place(s->memory, &next, room * states * states);
    m.B0 = cosim_place(s->memory, &next, room * sources * states);
    m.B1 = cosim_place(s->memory, &next, room * sources * states);
    m.K = cosim_place(s->memory, &next, room * states * outputs);
    m.L = cosim_place(s->memory, &next, room * outputs * outputs);
    m.of_modes = cosim_place(s->memory, &next, n_modes * outputs);
    m.known_B0 = cosim_place(s->memory, &next, states * inputs);
    m.there = (int32_t *)cosim_place(s->memory, &next, outputs);
    m.measured = (uint8_t *)cosim_place(s->memory, &next, outputs);
    m.predicting = cosim_place(s->memory, &next,
                               outputs * (3 * outputs + n_modes) + n_modes * n_modes);
    m.size = next;
    return m;
}

int64_t cosim_identifier_memory(const cosim_identifier *s) { return storage_of(s).size; }
int64_t cosim_identifier_state(const cosim_identifier *s) { return storage_of(s).state; }

int64_t cosim_identifier_samples(const cosim_identifier *s, const double *state, int64_t *parts)
{
    const storage m = storage_of(s);
    const double *memory = s->memory;
    const int64_t count = s->on_delta ? (int64_t)state[m.count - memory] : 0;
    const int64_t components = s->rayleigh->components, outputs = n_outputs(s);
    int64_t next = 0;
    next = cosim_note_part(m.residual - memory, count * outputs, parts, next);
    next = cosim_note_part(m.alpha - memory, count * components, parts, next);
    next = cosim_note_part(m.delta - memory, count, parts, next);
    next = cosim_note_part(m.delta_alpha - memory, count * components, parts, next);
    if (s->between) {
        const int64_t betweens = (int64_t)state[m.betweens - memory];
        const cosim_between_record record = cosim_between_in(s->between, m.between, betweens);
        const int64_t width = cosim_between_width(s->between);
        next = cosim_note_part(record.place - memory, betweens, parts, next);
        next = cosim_note_part(record.rows - memory, betweens * width, parts, next);
        next = cosim_note_part(record.residual - memory, betweens * outputs, parts, next);
    }
    if (s->predictor) {
        const int64_t states = s->on_y->states, sources = s->on_y->sources;
        next = cosim_note_part(m.step - memory, count, parts, next);
        next = cosim_note_part((double *)m.interval - memory, (count + 1) / 2, parts, next);
        next = cosim_note_part(m.Ad - memory, count * states * states, parts, next);
        next = cosim_note_part(m.B0 - memory, count * sources * states, parts, next);
        next = cosim_note_part(m.B1 - memory, count * sources * states, parts, next);
        next = cosim_note_part(m.K - memory, count * states * outputs, parts, next);
        next = cosim_note_part(m.L - memory, count * outputs * outputs, parts, next);
    }
    return next;
}

static void forget_outputs(const cosim_identifier *s, const storage *m)
{
    for (int32_t i = 0; i < s->width; ++i)
        m->outputs[i] = cosim_no_value();
}

void cosim_identifier_start(cosim_identifier *s, double *y)
{
    const storage m = storage_of(s);
    memset(s->memory, 0, (size_t)m.state * sizeof *s->memory);
    if (s->on_y) {
        const size_t outputs = (size_t)n_outputs(s);
        memcpy(m.W, s->on_y->W, outputs * outputs * sizeof *m.W);
        memcpy(m.deviations, s->deviations, outputs * sizeof *m.deviations);
    }
    if (s->predictor) {
        const size_t modes = (size_t)s->predictor->modes.states;
        memcpy(m.P, s->predictor->P, modes * modes * sizeof *m.P);
    }
    forget_outputs(s, &m);
    memcpy(y, m.outputs, (size_t)s->width * sizeof *y);
}

/* --- samples --- */

/* S grows by mu mu', N by the covariance of the noise that delta(t - D_j) brings into mu: terms
 * with the same row of delta share it. Both of means over some samples: (25) is linear in mu, so it
 * holds for them too, and the noise of a derivative nearly cancels in them. */
static void take_regressor(const cosim_identifier *s, const storage *m, double t, const double *mu)
{
    const cosim_regressor *products = s->products;
    const int32_t terms = s->rayleigh->terms;
    const int64_t now = (int64_t)*m->count;
    double alpha[COSIM_MOST_TERMS]; /* (groups, rows), which are no more than the terms they make */
    double work[COSIM_MOST_TERMS];
    for (int32_t c = 0; c < terms; ++c)
        if (isnan(mu[c]))
            return;
    cosim_past_alphas_at(products->alphas, m->pasts, now, t, mu + terms, alpha);
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
    return status;
}

/* The alphas of the sample, and those as late as delta; without these delta does not count. */
static void take_delta(const cosim_identifier *s, const storage *m, double t, const double *signals,
                       const double *delta)
{
    const int32_t components = s->rayleigh->components;
    const int64_t k = (int64_t)*m->count;
    double *late = m->delta_alpha + k * components;
    m->delta[k] = t >= s->settled ? *delta : cosim_no_value();
    cosim_alphas_at(&s->lagging->alphas, t, signals, m->alpha + k * components);
    cosim_past_alphas_at(s->lagging, m->pasts, k, t, signals, late);
    for (int32_t i = 0; i < components; ++i)
        if (isnan(late[i])) {
            late[i] = 0.0;
            m->delta[k] = cosim_no_value();
        }
    if (fabs(*delta) > *m->largest_delta)
        *m->largest_delta = fabs(*delta);
}

/* M - K N for `columns` columns; those of N are `of_column` apart, its rows `of_row`. */
static void less_gain(int32_t n, int32_t outputs, int32_t columns, const double *K, const double *N,
                      int32_t of_row, int32_t of_column, double *M, int32_t M_row, int32_t M_column)
{
    for (int32_t a = 0; a < n; ++a)
        for (int32_t c = 0; c < columns; ++c)
            for (int32_t o = 0; o < outputs; ++o)
                M[a * M_row + c * M_column] -= K[a * outputs + o] * N[o * of_row + c * of_column];
}

/* What leads to sample k from the one before: with the gain that y there has, 0 where it is
 * missing. */
static void set_interval_to(const cosim_identifier *s, const storage *m, int64_t k)
{
    const cosim_output_error *model = s->on_y;
    const int32_t n = model->states, outputs = model->outputs, sources = model->sources;
    const int32_t inputs = s->known->inputs;
    double *Ad = m->Ad + k * n * n, *B0 = m->B0 + k * sources * n;
    m->step[k] = model->step[0];
    m->interval[k] = (int32_t)k;
    memcpy(Ad, model->Ad, (size_t)(n * n) * sizeof *Ad);
    memcpy(B0, model->B0, (size_t)(sources * n) * sizeof *B0);
    memcpy(m->B1 + k * sources * n, model->B1, (size_t)(sources * n) * sizeof *B0);
    memcpy(m->K + k * n * outputs, m->gain, (size_t)(n * outputs) * sizeof *Ad);
    memcpy(m->known_B0, s->known->B0, (size_t)(n * inputs) * sizeof *Ad);
    less_gain(n, outputs, n, m->gain, model->C, n, 1, Ad, n, 1);
    less_gain(n, outputs, sources, m->gain, model->D, 1, outputs, B0, 1, n);
    less_gain(n, outputs, inputs, m->gain, s->known->D, inputs, 1, m->known_B0, inputs, 1);
}

/* The gain of sample k for the next one. */
static int32_t set_gain(const cosim_identifier *s, const storage *m, int64_t k, const double *y)
{
    const cosim_predictor *modes = &s->predictor->modes;
    const int32_t n = s->on_y->states, outputs = modes->outputs;
    for (int32_t o = 0; o < outputs; ++o)
        m->measured[o] = (uint8_t)!isnan(y[o]);
    const int32_t status =
        cosim_predictor_gain(modes, m->measured, modes->T, m->P, m->of_modes,
                             m->L + k * outputs * outputs, m->there, m->predicting);
    for (int32_t a = 0; a < n; ++a)
        for (int32_t o = 0; o < outputs; ++o) {
            double sum = 0.0;
            for (int32_t w = 0; w < modes->states; ++w)
                sum += s->predictor->V[a * modes->states + w] * m->of_modes[w * outputs + o];
            m->gain[a * outputs + o] = sum;
        }
    return status;
}

/* The model of y from interval k on: with the gain of each sample, where some may be missing. */
static cosim_output_error model_of_y(const cosim_identifier *s, const storage *m,
                                     const cosim_output_error *from, int64_t k)
{
    cosim_output_error model = *from;
    const int64_t n = model.states, outputs = model.outputs, sources = model.sources;
    if (!s->predictor)
        return model;
    model.step = m->step + k;
    model.Ad = m->Ad + k * n * n;
    model.B0 = m->B0 + k * sources * n;
    model.B1 = m->B1 + k * sources * n;
    model.K = m->K + k * n * outputs;
    model.L = m->L + k * outputs * outputs;
    return model;
}

static int32_t take_outputs(const cosim_identifier *s, const storage *m, double t, const double *y)
{
    const int32_t outputs = n_outputs(s), inputs = s->known->inputs;
    const int64_t k = (int64_t)*m->count;
    const double *u = y + outputs;
    for (int32_t o = 0; o < outputs; ++o)
        if (fabs(y[o]) > m->largest[o])
            m->largest[o] = fabs(y[o]);
    if (s->between) {
        const double *samples = u;
        u += (outputs + 1) * s->between->most;
        const int32_t status = take_between(s, m, t, samples, u, m->at_point);
        if (status)
            return status;
        if (s->predictor && *m->betweens > 0.0)
            return COSIM_OUTSIDE;
        y = m->at_point;
    }
    double *ys = m->before, *us = m->before + 2 * outputs;
    memcpy(ys, ys + outputs, (size_t)outputs * sizeof *ys);
    memcpy(us, us + inputs, (size_t)inputs * sizeof *us);
    memcpy(ys + outputs, y, (size_t)outputs * sizeof *ys);
    memcpy(us + inputs, u, (size_t)inputs * sizeof *us);
    const int64_t begin = k > 0 ? 1 : 0; /* of the pair: the sample before it, and it */
    const uint8_t predicts = 1;
    cosim_known_input known = *s->known;
    if (s->predictor) {
        set_interval_to(s, m, k);
        known.B0 = m->known_B0;
        known.predicts = &predicts;
        const int32_t status = set_gain(s, m, k, y);
        if (status)
            return status;
    }
    const cosim_output_error model = model_of_y(s, m, s->on_y, s->predictor ? k : 0);
    cosim_output_error_residual(&model, &known, begin, begin + 1, us + (begin ? 0 : inputs),
                                ys + (begin ? 0 : outputs), NULL, m->x, m->pair);
    memcpy(m->residual + k * outputs, m->pair + begin * outputs, (size_t)outputs * sizeof *m->pair);
    return COSIM_OK;
}

static int32_t take_sample(const cosim_identifier *s, const storage *m, double t,
                           const double *input)
{
    int32_t status = COSIM_OK;
    const cosim_past_alphas *pasts = s->products->alphas;
    const double *signals = input + s->rayleigh->terms, *delta = signals + pasts->alphas.signals;
    if (t >= s->start && s->average > 0)
        take_regressor(s, m, t, input);
    if (s->on_delta)
        take_delta(s, m, t, signals, delta);
    if (s->on_y)
        status = take_outputs(s, m, t, delta + s->disturbances);
    if (status)
        return status;
    cosim_past_alphas_keep(pasts, m->pasts, (int64_t)*m->count, signals);
    *m->count += 1.0;
    *m->time = t;
    return COSIM_OK;
}

/* --- estimates --- */

typedef struct {
    cosim_fit fit;
    cosim_experiment experiment;
    cosim_output_error weighed; /* on_y with the W of now */
    cosim_between_record between;
    double estimate[COSIM_MOST_PARAMETERS];
    double covariance[COSIM_MOST_PARAMETERS * COSIM_MOST_PARAMETERS];
    double statistics[COSIM_MOST_COLUMNS];
    double nothing[COSIM_MOST_COLUMNS];
    uint8_t state[COSIM_MOST_PARAMETERS];
} estimation;

static void prepare_fit(const cosim_identifier *s, estimation *e, double accuracy, double *theta)
{
    memset(e->nothing, 0, sizeof e->nothing);
    e->fit = (cosim_fit){
        .experiments = 1,
        .components = s->rayleigh->components,
        .parameters = s->rayleigh->parameters,
        .most_iterations = ITERATIONS,
        .experiment = &e->experiment,
        .count = s->rayleigh->count,
        .lower = s->lower,
        .upper = s->upper,
        .scale = s->scale,
        .threshold = s->threshold,
        .accuracy = accuracy,
        .tolerance = TOLERANCE,
        .most_squares = INFINITY,
        .theta = theta,
        .estimate = e->estimate,
        .covariance = e->covariance,
        .statistics = e->statistics,
        .state = e->state,
    };
}

/* Of a row of y, made white. */
static double rounding_of(const cosim_identifier *s, const storage *m)
{
    const int32_t outputs = n_outputs(s);
    double largest = 0.0;
    for (int32_t w = 0; w < outputs; ++w) {
        double sum = 0.0;
        for (int32_t o = 0; o < outputs; ++o)
            sum += fabs(m->W[w * outputs + o]) * m->largest[o];
        largest = sum > largest ? sum : largest;
    }
    return ROUNDING * largest;
}

static void prepare_fit_of_y(const cosim_identifier *s, const storage *m, double *theta,
                             estimation *e)
{
    const int64_t count = (int64_t)*m->count;
    const int64_t first = s->window && count > s->window ? count - s->window : 0;
    prepare_fit(s, e, rounding_of(s, m), theta);
    e->weighed = model_of_y(s, m, s->on_y, 0);
    e->weighed.W = m->W;
    e->experiment = (cosim_experiment){
        .model = &e->weighed,
        .record = {first, count, m->residual, m->alpha, s->predictor ? m->interval : NULL, NULL},
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

/* --- the noise of several outputs --- */

/* W by what the linear unknowns leave of y, with `freedom` for each output. */
static void weigh(const cosim_identifier *s, const storage *m, estimation *e,
                  const double *unknowns, double freedom)
{
    const int32_t n = n_outputs(s);
    const cosim_experiment *x = &e->experiment;
    const int correlated = freedom >= FEWEST * n * n;
    cosim_output_error_products(x->model, e->fit.theta, unknowns, &x->record, x->work,
                                m->covariance);
    for (int32_t i = 0; i < n; ++i) {
        for (int32_t j = 0; j < n; ++j)
            m->covariance[i * n + j] *= i == j || correlated ? 1.0 / freedom : 0.0;
        m->least[i] = MOST_EXACT * m->largest[i];
    }
    cosim_noise_weights(n, m->covariance, m->least, m->deviations, m->factor, m->W);
    e->fit.accuracy = rounding_of(s, m);
}

/* Before there is a fit outputs count by their sizes, so that their units do not. */
static void weigh_by_size(const cosim_identifier *s, const storage *m)
{
    const double nothing[COSIM_MOST_COLUMNS] = {0.0};
    estimation e;
    prepare_fit_of_y(s, m, m->theta, &e);
    weigh(s, m, &e, nothing, 1.0);
}

/* Fit all samples; where the noise is not known, so many times more with what the last fit says of
 * it. */
static int32_t fit_weighed(const cosim_identifier *s, const storage *m, estimation *e,
                           int32_t weighings)
{
    int32_t status = cosim_output_error_fit(&e->fit);
    for (int32_t i = 0; s->weighs && i < weighings && status == COSIM_OK; ++i) {
        memcpy(m->theta, e->estimate, (size_t)s->rayleigh->parameters * sizeof *m->theta);
        weigh(s, m, e, m->amplitudes, e->fit.freedom / n_outputs(s));
        status = cosim_output_error_fit(&e->fit);
    }
    return status;
}

static double largest_of(double a, double b) { return a > b ? a : b; }

/* How far the parameter of another minimum is that the samples did not rule out. */
static double farthest_rival(const cosim_identifier *s, const storage *m, int32_t parameter,
                             double theta)
{
    const int32_t P = s->rayleigh->parameters;
    double farthest = 0.0;
    for (int32_t i = 0; i < (int32_t)*m->rivals && m->excess[i] <= RULED_OUT; ++i)
        farthest = largest_of(farthest, fabs(m->rival_theta[i * P + parameter] - theta));
    return farthest;
}

/* Only what is fitted to y has errors: the noise of delta is not white. Those of outputs that are
 * more exact than they are taken for say nothing of the others. */
static void write_outputs(const cosim_identifier *s, const storage *m, const estimation *e)
{
    const int32_t P = s->rayleigh->parameters;
    double unused[COSIM_MOST_PARAMETERS];
    double *theta = m->outputs, *error = unused, *amplitudes = theta + P;
    const double variance = e->fit.variance;
    const int is_more_exact = s->weighs && variance < 1.0;
    const double factor = is_more_exact ? 1.0 / variance : 1.0;
    int32_t column = 0, j = 0;
    if (s->on_y) {
        double *deviation = theta + 2 * P;
        error = theta + P;
        amplitudes = deviation + n_outputs(s);
        for (int32_t o = 0; o < n_outputs(s); ++o)
            deviation[o] = m->deviations[o] * (is_more_exact ? 1.0 : sqrt(variance));
    }
    for (int32_t i = 0; i < s->rayleigh->components; ++i) {
        for (int32_t k = 0; k < s->rayleigh->count[i]; ++k, ++j) {
            const int known = e->state[j] == COSIM_ESTIMATED || e->state[j] == COSIM_FIXED;
            const double own = sqrt(factor * e->covariance[j * P + j]);
            theta[j] = known ? e->estimate[j] : cosim_no_value();
            error[j] = cosim_no_value();
            if (known)
                error[j] = largest_of(own, farthest_rival(s, m, j, theta[j]));
        }
        for (int32_t k = 0; k < s->rayleigh->size[i]; ++k, ++column)
            amplitudes[column] = e->experiment.amplitudes[column];
    }
}

/* --- starts --- */

/* The minimum of the Rayleigh quotient, improved on delta; returns how many starts these are. */
static int32_t start_on_regression(const cosim_identifier *s, const storage *m, double *theta)
{
    estimation e;
    double on_delta[COSIM_MOST_PARAMETERS], value;
    if (*m->rows < ROWS_A_TERM * s->rayleigh->terms)
        return 0;
    if (cosim_rayleigh_search(s->rayleigh, m->R, m->N, theta, &value) == COSIM_NO_VALUE)
        return 0;
    memcpy(on_delta, theta, (size_t)s->rayleigh->parameters * sizeof *theta);
    prepare_fit_of_delta(s, m, on_delta, &e);
    if (cosim_output_error_fit(&e.fit) == COSIM_OK)
        memcpy(theta, e.estimate, (size_t)s->rayleigh->parameters * sizeof *theta);
    return 1;
}

/* The grid for the samples so far: a start must not depend on how many there will be. */
static const cosim_start_grid *grid_of(const cosim_identifier *s, const storage *m)
{
    int32_t k = 0;
    while (k + 1 < s->grids && *m->count > (double)s->reach[k])
        ++k;
    return s->grid + k;
}

/* Put a fit beside the points of a grid. */
static void put_fit(const cosim_identifier *s, const storage *m, const cosim_start_grid *grid,
                    const double *fit)
{
    const double *G0 = s->on_y->G0, *G1 = s->on_y->G1;
    double *to = m->grid_G0, *theta = m->grid_theta;
    memcpy(to, grid->model->G0, (size_t)entries_of(grid, 2) * sizeof *to);
    memcpy(theta, grid->theta, (size_t)entries_of(grid, 1) * sizeof *theta);
    for (int32_t i = 0; i < grid->components; ++i) {
        const int32_t V = grid->size[i], count = grid->count[i], last = grid->points[i] - 1;
        cosim_system_matrix(V, count, G0, G1, fit, to + last * V * V);
        memcpy(theta + last * count, fit, (size_t)count * sizeof *theta);
        to += grid->points[i] * V * V, theta += grid->points[i] * count;
        G0 += V * V, G1 += count * V * V;
        fit += count;
    }
}

/* The best points of the grid, for all samples so far; of those beside a fit, where there is
 * one. */
static int32_t starts_on_grid(const cosim_identifier *s, const storage *m, const double *fit,
                              double *theta)
{
    cosim_start_grid grid = *grid_of(s, m);
    cosim_output_error model = model_of_y(s, m, grid.model, 0);
    const int32_t unknowns = cosim_output_error_columns(s->on_y);
    estimation e;
    if (*m->count < (double)ROWS_A_TERM * unknowns * model.average)
        return 0;
    if (s->weighs)
        model.W = m->W;
    if (fit) {
        put_fit(s, m, &grid, fit);
        model.G0 = m->grid_G0;
        grid.theta = m->grid_theta;
    }
    grid.model = &model;
    prepare_fit_of_y(s, m, theta, &e);
    cosim_record record = e.experiment.record;
    record.first = 0;
    cosim_output_error_start(&model, theta, m->grid_work);
    cosim_output_error_take(&model, theta, &record, 0, record.end, m->grid_work);
    if (fit)
        return cosim_start_grid_beside(&grid, m->grid_work, m->grid_search, BESIDE, theta);
    return cosim_start_grid_search(&grid, 1, m->grid_work, m->grid_search, STARTS, theta);
}

/* --- the best of several fits --- */

typedef struct {
    double theta[COSIM_MOST_PARAMETERS]; /* where the regression was linearized */
    double error[COSIM_MOST_PARAMETERS]; /* standard errors; 0: not estimated */
    double squares, variance;
    int32_t present;  /* parameters whose components are there */
    int is_minimum;
    /* all are, known to a small part of their ranges, and no other fit is as good */
    int is_certain;
    int is_clear;     /* it was the best before, and others are far worse */
} candidate;

static candidate candidate_of(const cosim_identifier *s, const double *theta, const estimation *e,
                              int32_t status)
{
    const int32_t P = s->rayleigh->parameters;
    candidate c = {.squares = e->fit.variance * e->fit.freedom, .variance = e->fit.variance};
    c.is_minimum = status == COSIM_OK;
    c.is_certain = c.is_minimum;
    memcpy(c.theta, theta, (size_t)P * sizeof *theta);
    for (int32_t j = 0; j < P; ++j) {
        c.error[j] = sqrt(e->covariance[j * P + j]);
        c.present += e->state[j] != COSIM_ABSENT;
        if (e->state[j] != COSIM_ESTIMATED && e->state[j] != COSIM_FIXED)
            c.is_certain = 0;
        if (!(c.error[j] <= s->scale[j]))
            c.is_certain = 0;
    }
    return c;
}

/* Two fits that differ by less than one variance are the same minimum, or as good. */
static int is_better(const candidate *c, const candidate *than)
{
    if (c->is_minimum != than->is_minimum)
        return c->is_minimum;
    return c->squares + c->variance < than->squares;
}

/* Whether another minimum explains the samples so well that noise may have decided between them. */
static int is_rival(const cosim_identifier *s, const candidate *c, const candidate *best)
{
    if (c->squares > best->squares + MARGIN * best->variance)
        return 0;
    for (int32_t j = 0; j < s->rayleigh->parameters; ++j)
        if (fabs(c->theta[j] - best->theta[j]) > best->error[j] + ROUNDING_OF_THETA * s->scale[j])
            return 1;
    return 0;
}

/* Whether a start will lead to a minimum that is known already. */
static int is_known(const cosim_identifier *s, const double *start, const candidate *fits,
                    int32_t fitted)
{
    for (int32_t i = 0; i < fitted; ++i) {
        int is_near = fits[i].is_minimum;
        for (int32_t j = 0; j < s->rayleigh->parameters; ++j)
            if (fabs(start[j] - fits[i].theta[j]) > NEAR * s->scale[j])
                is_near = 0;
        if (is_near)
            return 1;
    }
    return 0;
}

/* Of all theta of the same model take the one that is reported; returns whether it is another. */
static int put_in_order(const cosim_identifier *s, double *theta)
{
    const size_t size = (size_t)s->rayleigh->parameters * sizeof *theta;
    double before[COSIM_MOST_PARAMETERS];
    if (!s->grids)
        return 0;
    memcpy(before, theta, size);
    cosim_start_grid_order(s->grid, theta);
    return memcmp(before, theta, size) != 0;
}

/* Whether two fits have the same minimum. */
static int are_same(const cosim_identifier *s, const candidate *a, const candidate *b)
{
    for (int32_t j = 0; j < s->rayleigh->parameters; ++j)
        if (fabs(a->theta[j] - b->theta[j]) > SAME * b->error[j] + ROUNDING_OF_THETA * s->scale[j])
            return 0;
    return a->is_minimum && b->is_minimum;
}

static int is_among(const cosim_identifier *s, const candidate *c, const candidate *fits,
                    int32_t fitted)
{
    for (int32_t i = 0; i < fitted; ++i)
        if (are_same(s, c, &fits[i]))
            return 1;
    return 0;
}

/* Fit y from the starts behind the fits that there are, each minimum once; returns how many there
 * are then. Fits that will be far worse than `most` squares are given up. */
static int32_t fit_starts(const cosim_identifier *s, const storage *m, double most, int32_t count,
                          double *starts, candidate *fits, int32_t fitted)
{
    for (int32_t i = 0; i < count; ++i) {
        double *theta = starts + i * s->rayleigh->parameters;
        estimation e;
        if (is_known(s, theta, fits, fitted))
            continue;
        prepare_last_fit(s, m, theta, &e);
        e.fit.most_iterations = START_ITERATIONS;
        e.fit.most_squares = most;
        int32_t status = cosim_output_error_fit(&e.fit);
        if (status == COSIM_OK && put_in_order(s, theta)) {
            prepare_last_fit(s, m, theta, &e);
            status = cosim_output_error_fit(&e.fit);
        }
        if (status == COSIM_NO_VALUE)
            continue;
        fits[fitted] = candidate_of(s, theta, &e, status);
        if (!is_among(s, &fits[fitted], fits, fitted))
            ++fitted;
    }
    return fitted;
}

/* Iterate on, where a fit from a start has not come to its end. */
static void go_on(const cosim_identifier *s, const storage *m, candidate *c)
{
    double theta[COSIM_MOST_PARAMETERS];
    estimation e;
    memcpy(theta, c->theta, sizeof theta);
    prepare_last_fit(s, m, theta, &e);
    const int32_t status = cosim_output_error_fit(&e.fit);
    if (status != COSIM_NO_VALUE)
        *c = candidate_of(s, theta, &e, status);
}

/* Keep the rivals of the best fit, the nearest to it in squares, until the next search. */
static void keep_rivals(const cosim_identifier *s, const storage *m, candidate *best,
                        int32_t fitted, const candidate *fits)
{
    const int32_t P = s->rayleigh->parameters;
    double squares[RIVALS];
    int64_t places[RIVALS];
    int32_t count = 0;
    for (int32_t i = 0; i < fitted; ++i)
        if (is_rival(s, &fits[i], best))
            count = cosim_keep_smallest(fits[i].squares, i, count, RIVALS, squares, places);
    for (int32_t i = 0; i < count; ++i) {
        memcpy(m->rival_theta + i * P, fits[places[i]].theta, (size_t)P * sizeof *best->theta);
        m->excess[i] = (squares[i] - best->squares) / best->variance;
    }
    *m->rivals = count;
    best->is_certain = best->is_certain && !count;
}

/* Of all fits the best, and whether it is a minimum. */
static int choose_best(const cosim_identifier *s, const storage *m, int32_t fitted, candidate *fits,
                       candidate *best)
{
    candidate *lowest = fits;
    for (int32_t i = 1; i < fitted; ++i)
        if (fits[i].squares < lowest->squares)
            lowest = &fits[i];
    if (!lowest->is_minimum)
        go_on(s, m, lowest);
    *best = fits[0];
    for (int32_t i = 1; i < fitted; ++i)
        if (is_better(&fits[i], best))
            *best = fits[i];
    return best->is_minimum;
}

/* Whether the best fit is not certain, or has a rival. */
static int is_doubtful(const cosim_identifier *s, int32_t fitted, const candidate *fits,
                       const candidate *best)
{
    for (int32_t i = 0; i < fitted; ++i)
        if (is_rival(s, &fits[i], best))
            return 1;
    return !best->is_certain;
}

/* Fit from points of the grid beside the best fit too, as long as there are better ones. */
static int search_beside(const cosim_identifier *s, const storage *m, int32_t *fitted,
                         candidate *fits, candidate *best)
{
    double starts[BESIDE * COSIM_MOST_PARAMETERS];
    int is_minimum = choose_best(s, m, *fitted, fits, best);
    if (!s->grids || (*m->time < s->start && is_doubtful(s, *fitted, fits, best)))
        return is_minimum; /* it will have no value */
    for (int round = 0; is_minimum && round < ROUNDS; ++round) {
        const double before = best->squares;
        const int32_t count = starts_on_grid(s, m, best->theta, starts);
        const double most = best->squares + CLEAR * best->variance;
        *fitted = fit_starts(s, m, most, count, starts, fits, *fitted);
        is_minimum = choose_best(s, m, *fitted, fits, best);
        if (best->squares == before)
            break;
    }
    return is_minimum;
}

/* `best`: the best fit from all starts, and from what it was. Returns whether there is one. */
static int search(const cosim_identifier *s, const storage *m, int found, candidate *best)
{
    const int32_t P = s->rayleigh->parameters;
    double starts[(STARTS + 1 + RIVALS) * COSIM_MOST_PARAMETERS];
    candidate fits[STARTS + RIVALS + ROUNDS * BESIDE + 2];
    int32_t count = (int32_t)*m->rivals, fitted = 0;
    memcpy(starts, m->rival_theta, (size_t)(count * P) * sizeof *starts);
    count += start_on_regression(s, m, starts + count * P);
    if (s->grids && !found)
        count += starts_on_grid(s, m, NULL, starts + count * P);
    if (found)
        fits[fitted++] = *best;
    fitted = fit_starts(s, m, INFINITY, count, starts, fits, fitted);
    if (!fitted || !search_beside(s, m, &fitted, fits, best))
        return 0;
    keep_rivals(s, m, best, fitted, fits);
    best->is_clear = best->is_certain && found && is_among(s, best, fits, 1);
    for (int32_t i = 0; i < fitted; ++i)
        if (fits[i].squares <= best->squares + CLEAR * best->variance &&
            !are_same(s, &fits[i], best))
            best->is_clear = 0;
    return 1;
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
    return fit_weighed(s, m, e, 1);
}

/* At how many times the samples of a search the next one is due. */
static double time_to_search(const cosim_identifier *s, int found, const candidate *best)
{
    if (!found || best->present < s->rayleigh->parameters)
        return LATER;
    return best->is_clear ? SELDOM : AGAIN;
}

/* Whether to search: as planned, or sooner where there is no fit any more, or it leaves more. */
static int is_due(const storage *m, int found, const cosim_fit *fit)
{
    const double times = *m->count / *m->searched;
    if (*m->count >= *m->next_search || (!found && times >= LATER))
        return 1;
    const double largest = *m->variance * (1.0 + GROWN * sqrt(2.0 / *m->freedom));
    return found && times >= AGAIN && fit->variance > largest;
}

static void estimate(const cosim_identifier *s, const storage *m)
{
    const int32_t P = s->rayleigh->parameters;
    estimation e;
    candidate best = {0};
    int found = *m->has_theta != 0.0 && follow(s, m, &e) == COSIM_OK;
    if (is_due(m, found, &e.fit)) {
        if (found)
            best = candidate_of(s, m->theta, &e, COSIM_OK);
        else if (s->weighs)
            weigh_by_size(s, m);
        found = search(s, m, found, &best);
        if (found) {
            memcpy(m->theta, best.theta, (size_t)P * sizeof *m->theta);
            if (s->grids)
                cosim_start_grid_order(s->grid, m->theta);
            prepare_last_fit(s, m, m->theta, &e);
            found = fit_weighed(s, m, &e, WEIGHINGS) == COSIM_OK;
        }
        /* before mu counts there may be too few samples to tell minima apart */
        found = found && (best.is_certain || *m->time >= s->start);
        *m->next_search = ceil(time_to_search(s, found, &best) * *m->count);
        *m->searched = *m->count;
        *m->variance = found ? e.fit.variance : INFINITY;
        *m->freedom = found ? e.fit.freedom : 1.0;
    }
    *m->has_theta = found;
    *m->taken = *m->count;
    forget_outputs(s, m);
    if (found)
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
