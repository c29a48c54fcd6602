#include "instance.h"

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
static size_t n_z(void) { return model_residual_form ? (size_t)model_residual_form->n_z : 0; }

static void copy_doubles(double *to, const double *from, size_t count)
{
    if (count > 0)
        memcpy(to, from, count * sizeof(double));
}

/* --- instances --- */

/* What is not that of the memory and the inputs any more. */
enum { STATES = 1, OUTPUTS = 2, DERIVATIVES = 4 };

static void forget(instance *i) { i->stale = STATES | OUTPUTS | DERIVATIVES; }

static double *take(double **rest, size_t count)
{
    double *taken = *rest;
    *rest += count;
    return taken;
}

instance *instance_new(void)
{
    const size_t changing = 4 + n() + 2 * m() + (size_t)model_memory + n_z();
    const size_t computed = p() + n() + n_z() + m() + (size_t)model_work;
    instance *i = calloc(1, sizeof *i);
    double *rest = i ? calloc(changing + computed, sizeof(double)) : NULL;
    if (!rest) {
        free(i);
        return NULL;
    }
    i->size = changing;
    i->values = rest;
    i->stamp = take(&rest, 1);
    i->mode = take(&rest, 1);
    i->time = take(&rest, 1);
    i->x0 = take(&rest, n());
    i->u = take(&rest, m());
    i->slope = take(&rest, m());
    i->memory = take(&rest, (size_t)model_memory);
    i->z_is_set = take(&rest, 1);
    i->z = take(&rest, n_z());
    i->y = take(&rest, p());
    i->dx = take(&rest, n());
    i->r = take(&rest, n_z());
    i->previous_u = take(&rest, m());
    i->work = take(&rest, (size_t)model_work);
    instance_reset(i);
    return i;
}

void instance_free(instance *i)
{
    if (i)
        free(i->values);
    free(i);
}

void instance_reset(instance *i)
{
    memset(i->values, 0, i->size * sizeof(double));
    *i->stamp = model_stamp;
    *i->mode = INSTANTIATED;
    copy_doubles(i->x0, model_X0, n());
    forget(i);
}

int instance_is_in(const instance *i, int modes) { return ((int)*i->mode & modes) != 0; }
void instance_enter(instance *i, int mode) { *i->mode = mode; }

/* The algebraic variable that an output is, or -1. */
static int32_t algebraic_of(size_t output)
{
    return model_residual_form ? model_residual_form->of_output[output] : -1;
}

/* Before the run the initial states follow the inputs. */
static void update_states(instance *i)
{
    if (i->stale & STATES && instance_is_in(i, INSTANTIATED | INITIALIZATION)) {
        model_initialize(i->memory, i->x0, *i->time, i->u);
        *i->z_is_set = 0.0;
    }
    i->stale &= ~STATES;
}

/* Outputs and the residual. */
static void update_outputs(instance *i)
{
    update_states(i);
    if (!(i->stale & OUTPUTS))
        return;
    if (*i->z_is_set != 0.0) {
        model_residual_form->outputs(i->memory, i->z, i->u, i->dx, i->y);
        i->stale &= ~DERIVATIVES;
    } else {
        model_outputs(i->memory, *i->time, i->u, i->y);
        if (model_residual_form)
            for (size_t k = 0; k < p(); ++k)
                if (algebraic_of(k) >= 0)
                    i->z[algebraic_of(k)] = i->y[k];
    }
    if (model_residual_form)
        model_residual_form->residual(i->memory, i->z, i->u, i->r);
    i->stale &= ~OUTPUTS;
}

/* Without outputs, which a solver does not read; algebraic variables are outputs. */
static void update_derivatives(instance *i)
{
    update_states(i);
    if (model_residual_form)
        update_outputs(i);
    if (i->stale & DERIVATIVES)
        model_derivatives(i->memory, *i->time, i->u, i->dx);
    i->stale &= ~DERIVATIVES;
}

static void update(instance *i)
{
    update_outputs(i);
    update_derivatives(i);
}

/* --- variables --- */

typedef enum { INPUT, OUTPUT, DERIVATIVE, STATE, TIME, RESIDUAL, UNKNOWN } class_of;

/* Whether a reference is among the next ones, else that in those behind them. */
static int is_below(size_t count, size_t *index)
{
    if (*index < count)
        return 1;
    *index -= count;
    return 0;
}

static class_of classify(uint32_t reference, size_t *index)
{
    *index = reference;
    if (is_below(m(), index))
        return INPUT;
    if (is_below(p(), index))
        return OUTPUT;
    if (is_below(n(), index))
        return DERIVATIVE;
    if (is_below(n(), index))
        return STATE;
    if (is_below(1, index))
        return TIME;
    return is_below(n_z(), index) ? RESIDUAL : UNKNOWN;
}

/* Number of elements of a variable; 0: there is none of this reference. */
static size_t size_of(uint32_t reference)
{
    return reference < m() + p() + 2 * n() + 1 + n_z() ? (size_t)model_size[reference] : 0;
}

/* The state behind an element, or -1. */
static int32_t state_of(class_of class, size_t index)
{
    if (class == STATE)
        return (int32_t)index;
    return class == OUTPUT ? model_state_of[index] : -1;
}

/* NULL where these are variables that together have this many elements. */
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

/* The elements of a variable stand one behind the other. */
static const double *values_of(instance *i, uint32_t reference)
{
    size_t index;
    switch (classify(reference, &index)) {
    case INPUT: return i->u + index;
    case OUTPUT: update_outputs(i); return i->y + index;
    case DERIVATIVE: update_derivatives(i); return i->dx + index;
    case STATE: return i->memory + index;
    case RESIDUAL: update_outputs(i); return i->r + index;
    default: return i->time;
    }
}

const char *instance_get(instance *i, const uint32_t references[], size_t count, double values[],
                         size_t n_values)
{
    const char *error =
        instance_is_in(i, ANY) ? check_sizes(references, count, n_values) : NOT_ALLOWED;
    if (error)
        return error;
    update_states(i);
    for (size_t k = 0; k < count; ++k) {
        const double *from = values_of(i, references[k]);
        for (uint32_t e = 0; e < (uint32_t)model_size[references[k]]; ++e)
            *values++ = from[e];
    }
    return NULL;
}

static int is_algebraic(uint32_t element)
{
    size_t index;
    return model_residual_form && classify(element, &index) == OUTPUT && algebraic_of(index) >= 0;
}

/* Where the value of an element that may be set now is kept, or NULL. */
static double *storage_of(const instance *i, uint32_t element)
{
    size_t index;
    const class_of class = classify(element, &index);
    const int32_t state = state_of(class, index);
    if (class == INPUT)
        return i->u + index;
    if (state >= 0 && model_is_exact[state] && instance_is_in(i, INSTANTIATED | INITIALIZATION))
        return i->x0 + state;
    if (is_algebraic(element) && instance_is_in(i, EVENT | CONTINUOUS))
        return i->z + algebraic_of(index);
    return NULL;
}

const char *instance_set(instance *i, const uint32_t references[], size_t count,
                         const double values[], size_t n_values)
{
    const int allowed = instance_is_in(i, INSTANTIATED | INITIALIZATION | RUNNING | INTERMEDIATE);
    const char *error = allowed ? check_sizes(references, count, n_values) : NOT_ALLOWED;
    if (error)
        return error;
    for (size_t k = 0; k < count; ++k) {
        if (references[k] < m()) /* inputs can be set in all of these modes */
            continue;
        for (uint32_t e = 0; e < size_of(references[k]); ++e)
            if (!storage_of(i, references[k] + e))
                return "this variable cannot be set in this mode";
    }
    for (size_t k = 0; k < count; ++k) {
        const uint32_t size = (uint32_t)model_size[references[k]];
        for (uint32_t e = 0; e < size; ++e) {
            const uint32_t element = references[k] + e;
            if (element < m()) {
                i->u[element] = *values++;
                continue;
            }
            *storage_of(i, element) = *values++;
            if (is_algebraic(element))
                *i->z_is_set = 1.0;
        }
    }
    forget(i);
    return NULL;
}

const char *instance_set_states(instance *i, const double x[], size_t count)
{
    if (!instance_is_in(i, CONTINUOUS))
        return NOT_ALLOWED;
    if (count != n())
        return WRONG_STATES;
    copy_doubles(i->memory, x, count);
    forget(i);
    return NULL;
}

static const char *check_reading(const instance *i, size_t count)
{
    if (!instance_is_in(i, READABLE))
        return NOT_ALLOWED;
    return count == n() ? NULL : WRONG_STATES;
}

const char *instance_get_states(instance *i, double x[], size_t count)
{
    const char *error = check_reading(i, count);
    if (error)
        return error;
    update_states(i);
    copy_doubles(x, i->memory, count);
    return NULL;
}

const char *instance_get_derivatives(instance *i, double dx[], size_t count)
{
    const char *error = check_reading(i, count);
    if (error)
        return error;
    update_derivatives(i);
    copy_doubles(dx, i->dx, count);
    return NULL;
}

const char *instance_get_nominals(const instance *i, double nominals[], size_t count)
{
    if (!instance_is_in(i, ANY))
        return NOT_ALLOWED;
    if (count != n())
        return WRONG_STATES;
    for (size_t k = 0; k < count; ++k)
        nominals[k] = 1.0;
    return NULL;
}

/* --- time and steps --- */

/* Instants are whole nanoseconds here: t0 + h is one of them up to rounding, and is taken for it.
 */
static double instant(double t)
{
    const double whole = round(t * 1e9) / 1e9;
    return fabs(whole - t) <= 4.0 * DBL_EPSILON * fabs(t) ? whole : t;
}

void instance_set_time(instance *i, double t)
{
    *i->time = instant(t);
    forget(i);
}

void instance_initialize(instance *i) { update(i); }

const char *instance_begin_step(instance *i, double t, double h)
{
    const double tolerance = 1e-6 * h + 1e-12 * fabs(t);
    if (!(isfinite(t) && isfinite(h) && h > 0.0))
        return "the communication step size must be positive and finite";
    if (fabs(t - *i->time) > tolerance) {
        snprintf(i->message, sizeof i->message,
                 "the step begins at %.17g s, but the FMU is at %.17g s", t, *i->time);
        return i->message;
    }
    if (model_step > 0.0 && fabs(h - model_step) > 1e-6 * model_step) {
        snprintf(
            i->message, sizeof i->message,
            "a communication step of %.17g s was asked for; needed %.10g s, the step of this FMU",
            h, model_step);
        return i->message;
    }
    update_states(i); /* initializes, if nothing was read before the first step */
    copy_doubles(i->previous_u, i->u, m());
    return NULL;
}

const char *instance_end_step(instance *i, double t, double h)
{
    const double t0 = instant(t), t1 = instant(t + h);
    const char *error = model_advance(i->memory, i->work, t0, t1, h, i->previous_u, i->u, i->y);
    if (error) {
        copy_doubles(i->u, i->previous_u, m());
        return error;
    }
    *i->time = t1;
    *i->z_is_set = 0.0;
    forget(i);
    if (model_has_derivatives && !model_residual_form)
        i->stale &= ~OUTPUTS; /* the step has computed them */
    return NULL;
}

const char *instance_set_slope(instance *i, uint32_t reference, double slope)
{
    size_t index;
    if (!instance_is_in(i, INITIALIZATION | STEP))
        return NOT_ALLOWED;
    if (classify(reference, &index) != INPUT)
        return "only inputs have derivatives";
    i->slope[index] = slope;
    return NULL;
}

void instance_move_inputs(instance *i, double h)
{
    for (size_t j = 0; j < m(); ++j) {
        if (i->slope[j] != 0.0)
            i->u[j] += h * i->slope[j];
        i->slope[j] = 0.0;
    }
}

/* --- derivatives: exact --- */

static model_unknown unknown_of(class_of class)
{
    switch (class) {
    case OUTPUT: return MODEL_OUTPUT;
    case DERIVATIVE: return MODEL_DERIVATIVE;
    case RESIDUAL: return MODEL_RESIDUAL;
    default: return MODEL_STATE;
    }
}

/* Entries d(row)/d(column) of one pair of elements; 0: they are no unknown and known. While
 * algebraic variables are calculated, they follow the others; for the residual, and by themselves,
 * they are knowns all the same. */
static int entry(instance *i, uint32_t unknown, uint32_t known, double *value)
{
    size_t row, column;
    const class_of of = classify(unknown, &row), by = classify(known, &column);
    const int32_t state = state_of(by, column), z = by == OUTPUT ? algebraic_of(column) : -1;
    const int in_initialization = instance_is_in(i, INSTANTIATED | INITIALIZATION);
    const model_unknown what = unknown_of(of);
    const int32_t r = (int32_t)row;
    model_known as = MODEL_BY_STATE;
    int32_t c = state;
    if (by == INPUT) {
        as = MODEL_BY_INPUT;
        c = (int32_t)column;
    } else if (z >= 0) {
        as = MODEL_BY_ALGEBRAIC;
        c = z;
    }
    if ((by != INPUT && state < 0 && z < 0) ||
        (of != OUTPUT && of != DERIVATIVE && of != STATE && of != RESIDUAL))
        return 0;
    if (of == STATE && z >= 0)
        *value = 0.0;
    else if (of != STATE && (of == RESIDUAL || z >= 0 || *i->z_is_set != 0.0))
        *value = model_residual_form->partial(what, r, as, c);
    else if (by == INPUT)
        *value = model_by_input(i->memory, i->work, *i->time, i->u, what, r, c, in_initialization);
    else
        *value = model_by_state(what, r, c);
    return 1;
}

const char *instance_derivative(instance *i, int adjoint, const uint32_t unknowns[],
                                size_t n_unknowns, const uint32_t knowns[], size_t n_knowns,
                                const double seed[], size_t n_seed, double sensitivity[],
                                size_t n_sensitivity)
{
    if (!instance_is_in(i, READABLE))
        return NOT_ALLOWED;
    const char *error = check_sizes(unknowns, n_unknowns, adjoint ? n_seed : n_sensitivity);
    error = error ? error : check_sizes(knowns, n_knowns, adjoint ? n_sensitivity : n_seed);
    if (error)
        return error;
    update(i);
    for (size_t k = 0; k < n_sensitivity; ++k)
        sensitivity[k] = 0.0;
    for (size_t a = 0, row = 0; a < n_unknowns; ++a)
        for (uint32_t e = 0; e < size_of(unknowns[a]); ++e, ++row)
            for (size_t b = 0, column = 0; b < n_knowns; ++b)
                for (uint32_t f = 0; f < size_of(knowns[b]); ++f, ++column) {
                    double value;
                    if (!entry(i, unknowns[a] + e, knowns[b] + f, &value))
                        return "unknowns are outputs, derivatives, states and residuals; knowns "
                               "are inputs, states and algebraic variables";
                    sensitivity[adjoint ? column : row] += value * seed[adjoint ? row : column];
                }
    return NULL;
}

/* --- copies of the state --- */

size_t instance_copy_size(const instance *i) { return i->size * sizeof(double); }

const char *instance_copy(const instance *i, void **copy)
{
    if (!instance_is_in(i, ANY))
        return NOT_ALLOWED;
    if (!*copy)
        *copy = malloc(instance_copy_size(i));
    if (!*copy)
        return NO_MEMORY;
    memcpy(*copy, i->values, instance_copy_size(i));
    return NULL;
}

const char *instance_restore(instance *i, const void *copy)
{
    if (!copy || !instance_is_in(i, ANY))
        return copy ? NOT_ALLOWED : "there is no state";
    memcpy(i->values, copy, instance_copy_size(i));
    forget(i);
    return NULL;
}

const char *instance_write(const instance *i, const void *copy, void *bytes, size_t size)
{
    if (!copy || size < instance_copy_size(i))
        return copy ? "the buffer is too small" : "there is no state";
    memcpy(bytes, copy, instance_copy_size(i));
    return NULL;
}

const char *instance_read(const instance *i, const void *bytes, size_t size, void **copy)
{
    double stamp = 0.0;
    if (size == instance_copy_size(i))
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
