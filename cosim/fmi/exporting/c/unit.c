#include "unit.h"

#include <float.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define NOT_ALLOWED "call not allowed in this mode"
#define NO_MEMORY "out of memory"
#define WRONG_STATES "wrong number of states"

static size_t n(void) { return (size_t)model_n; }
static size_t m(void) { return (size_t)model_m; }
static size_t p(void) { return (size_t)model_p; }
static size_t n_z(void) { return model_form ? (size_t)model_form->n_z : 0; }

static void copy_doubles(double *to, const double *from, size_t count)
{
    if (count > 0)
        memcpy(to, from, count * sizeof(double));
}

/* --- instances ----------------------------------------------------------------------------------------------------------- */

static double *take(double **rest, size_t count)
{
    double *start = *rest;
    *rest += count;
    return start;
}

unit *unit_new(void)
{
    const size_t changing = 4 + n() + 2 * m() + (size_t)model_memory + n_z();
    const size_t computed = p() + n() + n_z() + m() + (size_t)model_work;
    unit *i = calloc(1, sizeof *i);
    double *rest = i ? calloc(changing + computed, sizeof(double)) : NULL;
    if (!rest) {
        free(i);
        return NULL;
    }
    i->size = changing;
    i->values = rest;
    i->stamp = take(&rest, 1), i->mode = take(&rest, 1), i->time = take(&rest, 1);
    i->x0 = take(&rest, n()), i->u = take(&rest, m()), i->slope = take(&rest, m());
    i->memory = take(&rest, (size_t)model_memory);
    i->is_given = take(&rest, 1), i->z = take(&rest, n_z());
    i->y = take(&rest, p()), i->dx = take(&rest, n()), i->r = take(&rest, n_z()), i->before = take(&rest, m());
    i->work = take(&rest, (size_t)model_work);
    unit_reset(i);
    return i;
}

void unit_free(unit *i)
{
    if (i)
        free(i->values);
    free(i);
}

void unit_reset(unit *i)
{
    memset(i->values, 0, i->size * sizeof(double));
    *i->stamp = model_stamp;
    *i->mode = INSTANTIATED;
    copy_doubles(i->x0, model_X0, n());
    i->stale = 1;
}

int unit_is_in(const unit *i, int modes) { return ((int)*i->mode & modes) != 0; }
void unit_to(unit *i, int mode) { *i->mode = mode; }

/* The algebraic variable that an output is, or -1. */
static int32_t algebraic_of(size_t output) { return model_form ? model_form->of_output[output] : -1; }

/* Outputs, derivatives, the residual and, before the run, the start. */
static void update(unit *i)
{
    if (!i->stale)
        return;
    if (unit_is_in(i, INSTANTIATED | INITIALIZATION)) {
        model_start(i->memory, i->x0, *i->time, i->u);
        *i->is_given = 0.0;
    }
    if (*i->is_given != 0.0) {
        model_form->follow(i->memory, i->z, i->u, i->dx, i->y);
    } else {
        model_outputs(i->memory, *i->time, i->u, i->y, i->dx);
        for (size_t k = 0; k < p(); ++k)
            if (algebraic_of(k) >= 0)
                i->z[algebraic_of(k)] = i->y[k];
    }
    if (model_form)
        model_form->residual(i->memory, i->z, i->u, i->r);
    i->stale = 0;
}

/* --- variables ----------------------------------------------------------------------------------------------------------- */

typedef enum { INPUT, OUTPUT, DERIVATIVE, STATE, TIME, RESIDUAL, UNKNOWN } class_of;

static class_of classify(uint32_t reference, size_t *index)
{
    const size_t counts[] = {m(), p(), n(), n(), 1, n_z()};
    *index = reference;
    for (int class = INPUT; class < UNKNOWN; ++class) {
        if (*index < counts[class])
            return (class_of)class;
        *index -= counts[class];
    }
    return UNKNOWN;
}

/* Number of elements of a variable; 0: there is none of this reference. */
static size_t size_of(uint32_t reference)
{
    size_t index;
    return classify(reference, &index) == UNKNOWN ? 0 : (size_t)model_size[reference];
}

/* The state behind an element, or -1. */
static int32_t state_of(class_of class, size_t index)
{
    if (class == STATE)
        return (int32_t)index;
    return class == OUTPUT ? model_state_of[index] : -1;
}

/* NULL where these are variables that together have so many elements. */
static const char *check_sizes(const uint32_t references[], size_t count, size_t n_values)
{
    size_t total = 0;
    for (size_t k = 0; k < count; ++k) {
        const size_t size = size_of(references[k]);
        if (size == 0)
            return "unknown value reference";
        total += size;
    }
    return total == n_values ? NULL : "the number of values is not that of the variables' elements";
}

static double value_of(const unit *i, uint32_t element)
{
    size_t index;
    switch (classify(element, &index)) {
    case INPUT: return i->u[index];
    case OUTPUT: return i->y[index];
    case DERIVATIVE: return i->dx[index];
    case STATE: return i->memory[index];
    case RESIDUAL: return i->r[index];
    default: return *i->time;
    }
}

const char *unit_get(unit *i, const uint32_t references[], size_t count, double values[], size_t n_values)
{
    const char *wrong = unit_is_in(i, ANY) ? check_sizes(references, count, n_values) : NOT_ALLOWED;
    if (wrong)
        return wrong;
    update(i);
    for (size_t k = 0; k < count; ++k)
        for (uint32_t e = 0; e < size_of(references[k]); ++e)
            *values++ = value_of(i, references[k] + e);
    return NULL;
}

static int is_algebraic(uint32_t element)
{
    size_t index;
    return classify(element, &index) == OUTPUT && algebraic_of(index) >= 0;
}

/* Where the value of an element that may be set now is kept, or NULL. */
static double *place_of(const unit *i, uint32_t element)
{
    size_t index;
    const class_of class = classify(element, &index);
    const int32_t state = state_of(class, index);
    if (class == INPUT)
        return i->u + index;
    if (state >= 0 && model_is_exact[state] && unit_is_in(i, INSTANTIATED | INITIALIZATION))
        return i->x0 + state;
    if (is_algebraic(element) && unit_is_in(i, EVENT | CONTINUOUS))
        return i->z + algebraic_of(index);
    return NULL;
}

const char *unit_set(unit *i, const uint32_t references[], size_t count, const double values[], size_t n_values)
{
    const int allowed = unit_is_in(i, INSTANTIATED | INITIALIZATION | RUNNING | INTERMEDIATE);
    const char *wrong = allowed ? check_sizes(references, count, n_values) : NOT_ALLOWED;
    if (wrong)
        return wrong;
    for (size_t k = 0; k < count; ++k)
        for (uint32_t e = 0; e < size_of(references[k]); ++e)
            if (!place_of(i, references[k] + e))
                return "this variable cannot be set in this mode";
    for (size_t k = 0; k < count; ++k)
        for (uint32_t e = 0; e < size_of(references[k]); ++e) {
            *place_of(i, references[k] + e) = *values++;
            if (is_algebraic(references[k] + e))
                *i->is_given = 1.0;
        }
    i->stale = 1;
    return NULL;
}

const char *unit_set_states(unit *i, const double x[], size_t count)
{
    if (!unit_is_in(i, CONTINUOUS))
        return NOT_ALLOWED;
    if (count != n())
        return WRONG_STATES;
    copy_doubles(i->memory, x, count);
    i->stale = 1;
    return NULL;
}

static const char *read_doubles(unit *i, const double *from, double *to, size_t count)
{
    if (!unit_is_in(i, READABLE))
        return NOT_ALLOWED;
    if (count != n())
        return WRONG_STATES;
    update(i);
    copy_doubles(to, from, count);
    return NULL;
}

const char *unit_get_states(unit *i, double x[], size_t count) { return read_doubles(i, i->memory, x, count); }
const char *unit_get_derivatives(unit *i, double dx[], size_t count) { return read_doubles(i, i->dx, dx, count); }

const char *unit_get_nominals(const unit *i, double nominals[], size_t count)
{
    if (!unit_is_in(i, ANY))
        return NOT_ALLOWED;
    if (count != n())
        return WRONG_STATES;
    for (size_t k = 0; k < count; ++k)
        nominals[k] = 1.0;
    return NULL;
}

/* --- time and steps ------------------------------------------------------------------------------------------------------ */

/* Instants here are whole nanoseconds; t0 + h is one of them up to rounding, and is taken for it. */
static double instant(double t)
{
    const double whole = round(t * 1e9) / 1e9;
    return fabs(whole - t) <= 4.0 * DBL_EPSILON * fabs(t) ? whole : t;
}

void unit_set_time(unit *i, double t)
{
    *i->time = instant(t);
    i->stale = 1;
}

void unit_end_start(unit *i) { update(i); }

const char *unit_begin_step(unit *i, double t, double h)
{
    const double needed = (double)model_step_ns / 1e9, room = 1e-6 * h + 1e-12 * fabs(t);
    if (!(isfinite(t) && isfinite(h) && h > 0.0))
        return "the communication step size must be positive and finite";
    if (fabs(t - *i->time) > room) {
        snprintf(i->message, sizeof i->message, "the step begins at %.17g s, but the unit is at %.17g s", t, *i->time);
        return i->message;
    }
    if (model_step_ns > 0 && fabs(h - needed) > 1e-6 * needed) {
        snprintf(i->message, sizeof i->message, "a communication step of %.17g s was asked for; needed %.10g s, the step of this unit", h, needed);
        return i->message;
    }
    update(i); /* the start, if nothing was read before the first step */
    copy_doubles(i->before, i->u, m());
    return NULL;
}

const char *unit_end_step(unit *i, double t, double h)
{
    const double t0 = instant(t), t1 = instant(t + h);
    const char *wrong = model_advance(i->memory, i->work, t0, t1, h, i->before, i->u, i->y);
    if (wrong) {
        copy_doubles(i->u, i->before, m());
        return wrong;
    }
    *i->time = t1;
    *i->is_given = 0.0;
    i->stale = 1;
    return NULL;
}

const char *unit_set_slope(unit *i, uint32_t reference, double slope)
{
    size_t index;
    if (!unit_is_in(i, INITIALIZATION | STEP))
        return NOT_ALLOWED;
    if (classify(reference, &index) != INPUT)
        return "only inputs have derivatives";
    i->slope[index] = slope;
    return NULL;
}

void unit_move_inputs(unit *i, double h)
{
    for (size_t j = 0; j < m(); ++j) {
        if (i->slope[j] != 0.0)
            i->u[j] += h * i->slope[j];
        i->slope[j] = 0.0;
    }
}

/* --- derivatives: exact ---------------------------------------------------------------------------------------------------- */

static model_unknown unknown_of(class_of class)
{
    switch (class) {
    case OUTPUT: return MODEL_OUTPUT;
    case DERIVATIVE: return MODEL_DERIVATIVE;
    case RESIDUAL: return MODEL_RESIDUAL;
    default: return MODEL_STATE;
    }
}

/* Entries d(row)/d(column) of one pair of elements; 0: they are no unknown and known. While algebraic variables are calculated,
 * they follow the others; for the residual, and by themselves, they are knowns all the same. */
static int entry(unit *i, uint32_t unknown, uint32_t known, double *value)
{
    size_t row, column;
    const class_of of = classify(unknown, &row), by = classify(known, &column);
    const int32_t state = state_of(by, column), z = by == OUTPUT ? algebraic_of(column) : -1;
    const int at_start = unit_is_in(i, INSTANTIATED | INITIALIZATION);
    const model_unknown what = unknown_of(of);
    const model_known as = by == INPUT ? MODEL_BY_INPUT : z >= 0 ? MODEL_BY_ALGEBRAIC : MODEL_BY_STATE;
    const int32_t r = (int32_t)row, c = by == INPUT ? (int32_t)column : z >= 0 ? z : state;
    if ((by != INPUT && state < 0 && z < 0) || (of != OUTPUT && of != DERIVATIVE && of != STATE && of != RESIDUAL))
        return 0;
    if (of == STATE && z >= 0)
        *value = 0.0;
    else if (of != STATE && (of == RESIDUAL || z >= 0 || *i->is_given != 0.0))
        *value = model_form->partial(what, r, as, c);
    else
        *value = by == INPUT ? model_by_input(i->memory, i->work, *i->time, i->u, what, r, c, at_start)
                             : model_by_state(what, r, c);
    return 1;
}

const char *unit_derivative(unit *i, int adjoint, const uint32_t unknowns[], size_t n_unknowns, const uint32_t knowns[],
                            size_t n_knowns, const double seed[], size_t n_seed, double sensitivity[], size_t n_sensitivity)
{
    if (!unit_is_in(i, READABLE))
        return NOT_ALLOWED;
    const char *wrong = check_sizes(unknowns, n_unknowns, adjoint ? n_seed : n_sensitivity);
    wrong = wrong ? wrong : check_sizes(knowns, n_knowns, adjoint ? n_sensitivity : n_seed);
    if (wrong)
        return wrong;
    update(i);
    for (size_t k = 0; k < n_sensitivity; ++k)
        sensitivity[k] = 0.0;
    for (size_t a = 0, row = 0; a < n_unknowns; ++a)
        for (uint32_t e = 0; e < size_of(unknowns[a]); ++e, ++row)
            for (size_t b = 0, column = 0; b < n_knowns; ++b)
                for (uint32_t f = 0; f < size_of(knowns[b]); ++f, ++column) {
                    double value;
                    if (!entry(i, unknowns[a] + e, knowns[b] + f, &value))
                        return "unknowns are outputs, derivatives, states and residuals; knowns are inputs, states and algebraic variables";
                    sensitivity[adjoint ? column : row] += value * seed[adjoint ? row : column];
                }
    return NULL;
}

/* --- copies of the state --------------------------------------------------------------------------------------------------- */

size_t unit_copy_size(const unit *i) { return i->size * sizeof(double); }

const char *unit_copy(const unit *i, void **copy)
{
    if (!unit_is_in(i, ANY))
        return NOT_ALLOWED;
    if (!*copy)
        *copy = malloc(unit_copy_size(i));
    if (!*copy)
        return NO_MEMORY;
    memcpy(*copy, i->values, unit_copy_size(i));
    return NULL;
}

const char *unit_restore(unit *i, const void *copy)
{
    if (!copy || !unit_is_in(i, ANY))
        return copy ? NOT_ALLOWED : "there is no state";
    memcpy(i->values, copy, unit_copy_size(i));
    i->stale = 1;
    return NULL;
}

const char *unit_write(const unit *i, const void *copy, void *bytes, size_t size)
{
    if (!copy || size < unit_copy_size(i))
        return copy ? "the buffer is too small" : "there is no state";
    memcpy(bytes, copy, unit_copy_size(i));
    return NULL;
}

const char *unit_read(const unit *i, const void *bytes, size_t size, void **copy)
{
    double stamp = 0.0;
    if (size == unit_copy_size(i))
        memcpy(&stamp, bytes, sizeof stamp);
    if (stamp != model_stamp)
        return "not a state of this FMU";
    if (!*copy)
        *copy = malloc(size);
    if (!*copy)
        return NO_MEMORY;
    memcpy(*copy, bytes, size);
    return NULL;
}
