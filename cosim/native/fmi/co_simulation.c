#include "co_simulation.h"

#include <math.h>
#include <string.h>

#include "copying.h"

#define CLOSE 1e-9 /* of a communication step: times that are the same */

/* What is not usual is no part of other functions: those fill few lines of the cache then. */
#define RARE __attribute__((noinline))

typedef cosim_co_simulation Component;
typedef int (*get_state_function)(void *instance, void **state);
typedef int (*set_state_function)(void *instance, void *state);

/* The inputs over one communication step. */
typedef struct {
    double t, h;
    const double *u0, *u1, *change;
} Ramp;

/* How far into the step from t over h an instant is; the ends where it is close to them. */
static double fraction(double t, double h, double time)
{
    const double s = (time - t) / h;
    if (fabs(s) <= CLOSE)
        return 0.0;
    if (fabs(s - 1.0) <= CLOSE)
        return 1.0;
    return s;
}

static double input_at(const Ramp *ramp, double s, int32_t i)
{
    if (s == 1.0)
        return ramp->u1[i];
    return s != 0.0 ? ramp->u0[i] + s * ramp->change[i] : ramp->u0[i];
}

/* Inputs that are interpolated at `s`, the others at their one value. */
static void interpolated_at(const Component *c, const Ramp *ramp, double s, double *u)
{
    for (int32_t i = 0; i < c->n_u; ++i)
        u[i] = input_at(ramp, c->ramped[i] ? s : 0.5, i);
}

static bool has_input_event(const Component *c, const double *u)
{
    for (int32_t i = 0; i < c->n_event; ++i)
        if (memcmp(u + c->event_columns[i], c->event_inputs + i, sizeof *u))
            return true;
    return false;
}

/* Whether a time event is inside a step. */
static bool has_time_event(const Component *c, double t, double h)
{
    if (c->next_event == INFINITY)
        return false;
    const double s = fraction(t, h, c->next_event);
    return s > 0.0 && s < 1.0;
}

/* Whether a time event is due at the end of a step. */
static bool is_event_due(const Component *c, double t, double h)
{
    return c->next_event != INFINITY && fraction(t, h, c->next_event) <= 1.0;
}

static bool can_step(const Component *c)
{
    return c->fmu && cosim_fmu_is_open(c->fmu) && c->initialized && !c->ended;
}

static int32_t leave(Component *c, int32_t note)
{
    c->note = note;
    return COSIM_DECLINED;
}

/* y <- y + D (u - inputs) */
RARE static int32_t add_feedthrough(Component *c, const double *u, double *y)
{
    const cosim_fmu_directional *feedthrough = &c->feedthrough;
    double *seed = c->scratch, *changes = c->scratch + c->n_u;
    bool any = false;
    for (size_t i = 0; i < feedthrough->knowns_size; ++i) {
        seed[i] = u[c->knowns[i]] - c->inputs[c->knowns[i]];
        if (seed[i] != 0.0)
            any = true;
    }
    if (!any)
        return COSIM_OK;
    const int32_t status = cosim_fmu_directional_derivative(c->fmu, feedthrough, seed, changes);
    if (status != COSIM_OK)
        return status;
    for (size_t i = 0; i < feedthrough->unknowns_size; ++i)
        y[c->unknowns[i]] += changes[i];
    return COSIM_OK;
}

/* y <- outputs + D (u - inputs) */
static inline int32_t corrected_outputs(Component *c, const double *u, double *y)
{
    for (int32_t i = 0; i < c->n_y; ++i)
        y[i] = c->outputs[i];
    return c->feedthrough.n_unknowns ? add_feedthrough(c, u, y) : COSIM_OK;
}

RARE static int32_t save_state(const Component *c)
{
    const int status = ((get_state_function)c->get_state->function)(c->fmu->instance, c->fmu_state);
    return cosim_fmu_check(c->fmu, c->get_state, status);
}

/* Leave what a failed call, or a value that does not fit its type, ended before do_step. */
RARE static int32_t leave_before_step(Component *c, int32_t status)
{
    return leave(c, status == COSIM_CALL_FAILED ? COSIM_FAILED : COSIM_NOTHING);
}

/* Call do_step; COSIM_DECLINED as well where an event is due at its end. */
static int32_t do_step(Component *c, double t, double h)
{
    const int32_t status = cosim_fmu_do_step(c->fmu, c->fmu->version, &c->do_step, t, h);
    return status == COSIM_OK && is_event_due(c, t, h) ? COSIM_DECLINED : status;
}

/* Set inputs to their values at the beginning of a step, with their slopes, and call do_step. */
RARE static int32_t do_step_on_ramps(Component *c, double t0, double h, const double *u0,
                                const double *u1)
{
    double *begin = c->scratch, *end = begin + c->n_u, *change = end + c->n_u;
    double *inputs = change + c->n_u;
    for (int32_t i = 0; i < c->n_u; ++i) {
        const bool is_latest = c->latest[i] && !c->ramped[i];
        begin[i] = is_latest ? u1[i] : u0[i];
        end[i] = c->held[i] ? u0[i] : u1[i];
        change[i] = c->held[i] || is_latest ? 0.0 : u1[i] - u0[i];
    }
    const Ramp ramp = {t0, h, begin, end, change};
    interpolated_at(c, &ramp, 0.0, inputs);
    const int32_t status = cosim_fmu_set(c->fmu, &c->step_inputs, inputs);
    if (status != COSIM_OK)
        return leave_before_step(c, status);
    if (cosim_fmu_set_slopes(c->fmu, &c->slopes, change, h) != COSIM_OK)
        return leave(c, COSIM_SLOPES_FAILED);
    if (do_step(c, t0, h) != COSIM_OK)
        return leave(c, COSIM_STEPPED);
    const double until = cosim_fmu_interpolated_until(c->fmu, &c->do_step);
    double s = 1.0;
    if (until != INFINITY) {
        s = fraction(t0, h, until);
        s = s > 0.0 ? s : 0.0;
        s = s < 1.0 ? s : 1.0;
    }
    interpolated_at(c, &ramp, s, c->inputs);
    return COSIM_OK;
}

/* The mean of both ends of a step, or the value at its end. */
static inline void mean_inputs(const Component *c, const double *u0, const double *u1)
{
    double *inputs = c->inputs;
    /* volatile: vectorizing does not pay for a few */
    const volatile uint8_t *held = c->held, *latest = c->latest;
    for (int32_t i = 0; i < c->n_u; ++i) {
        const double begin = latest[i] ? u1[i] : u0[i];
        const double change = held[i] | latest[i] ? 0.0 : u1[i] - u0[i];
        inputs[i] = begin + 0.5 * change;
    }
}

/* Set inputs to one value over a step, and call do_step. */
static int32_t do_step_with_means(Component *c, double t0, double h, const double *u0,
                                  const double *u1)
{
    mean_inputs(c, u0, u1);
    const double *inputs = c->inputs;
    const int32_t status = cosim_fmu_set(c->fmu, &c->step_inputs, inputs);
    if (status != COSIM_OK)
        return leave_before_step(c, status);
    if (do_step(c, t0, h) != COSIM_OK)
        return leave(c, COSIM_STEPPED);
    return COSIM_OK;
}

RARE static int32_t step(Component *c, double t0, double h, const double *u0, const double *u1,
                         double *y)
{
    if (!can_step(c) || has_input_event(c, u0) || has_time_event(c, t0, h))
        return COSIM_DECLINED;
    if (c->get_state) {
        if (!c->fmu_state)
            return COSIM_DECLINED;
        if (save_state(c) != COSIM_OK)
            return leave(c, COSIM_FAILED);
    }
    int32_t status = c->interpolates ? do_step_on_ramps(c, t0, h, u0, u1)
                                     : do_step_with_means(c, t0, h, u0, u1);
    if (status != COSIM_OK)
        return status;
    status = cosim_fmu_get(c->fmu, &c->outputs_read, c->outputs);
    if (status != COSIM_OK)
        return leave(c, status == COSIM_CALL_FAILED ? COSIM_FAILED : COSIM_UNREAD);
    c->stepped = 1;
    c->inner_steps = 0;
    if (c->inner_step->watches)
        c->inner_steps = cosim_inner_step_observe(c->inner_step, c->outputs, c->inputs);
    if (c->inner_steps || has_input_event(c, u1))
        return leave(c, COSIM_COMPLETED);
    status = corrected_outputs(c, u1, y);
    return status == COSIM_OK ? COSIM_OK : leave(c, COSIM_FAILED);
}

/* Whether a step needs no more than inputs that are set, do_step and outputs. */
static inline bool is_plain(const Component *c)
{
    const int32_t other = c->ended | c->inner_step->watches;
    return (c->plain & c->initialized & !other) && cosim_fmu_is_open(c->fmu) &&
           !(c->next_event < INFINITY);
}

/* Read the outputs of a step that is plain. */
static inline int32_t read_outputs(Component *c, int32_t version, double *y)
{
    if (cosim_fmu_get_direct(c->fmu, version, &c->outputs_read, y) != COSIM_OK)
        return leave(c, COSIM_FAILED);
    c->stepped = 1;
    c->inner_steps = 0;
    cosim_copy_values(c->outputs, y, c->n_y);
    return COSIM_OK;
}

/* The same step where it is plain. */
static inline int32_t plain_step(Component *c, int32_t version, double t0, double h,
                                 const double *u0, const double *u1, double *y)
{
    cosim_fmu *fmu = c->fmu;
    mean_inputs(c, u0, u1);
    if (cosim_fmu_set_direct(fmu, version, &c->step_inputs, c->inputs) != COSIM_OK)
        return leave(c, COSIM_FAILED);
    if (cosim_fmu_do_step(fmu, version, &c->do_step, t0, h) != COSIM_OK)
        return leave(c, COSIM_STEPPED);
    return read_outputs(c, version, y);
}

/* Inputs at the beginning of a step with slopes, and their change over it; the state gets those at
 * its end. */
static inline void ramp_inputs(const Component *c, const double *u0, const double *u1,
                               double *begin, double *change)
{
    /* volatile: as of inputs */
    const volatile uint8_t *held = c->held, *latest = c->latest, *ramped = c->ramped;
    for (int32_t i = 0; i < c->n_u; ++i) {
        const bool is_held = held[i];
        const bool is_ramped = ramped[i];
        const bool is_latest = latest[i] && !is_ramped;
        const double first = is_latest ? u1[i] : u0[i];
        change[i] = is_held || is_latest ? 0.0 : u1[i] - u0[i];
        const double mean = first + 0.5 * change[i];
        const double end = is_held ? u0[i] : u1[i];
        begin[i] = is_ramped ? first : mean;
        c->inputs[i] = is_ramped ? end : mean;
    }
}

/* The same with the slopes of FMI 2.0, which nothing ends inside a step. */
static int32_t plain_step_on_ramps(Component *c, double t0, double h, const double *u0,
                                   const double *u1, double *y)
{
    cosim_fmu *fmu = c->fmu;
    double *begin = c->scratch, *change = begin + c->n_u;
    ramp_inputs(c, u0, u1, begin, change);
    if (cosim_fmu_set_direct(fmu, 2, &c->step_inputs, begin) != COSIM_OK)
        return leave(c, COSIM_FAILED);
    if (cosim_fmu_set_slopes(fmu, &c->slopes, change, h) != COSIM_OK)
        return leave(c, COSIM_SLOPES_FAILED);
    if (cosim_fmu_do_step(fmu, 2, &c->do_step, t0, h) != COSIM_OK)
        return leave(c, COSIM_STEPPED);
    return read_outputs(c, 2, y);
}

int32_t cosim_co_simulation_step(void *self, double t0, double t1, double h, const double *u0,
                                 const double *u1, double *y)
{
    (void)t1;
    Component *c = self;
    c->note = COSIM_NOTHING;
    c->first_event = INFINITY;
    if (!is_plain(c) || (c->interpolates && c->fmu->version != 2))
        return step(c, t0, h, u0, u1, y);
    if (c->interpolates)
        return plain_step_on_ramps(c, t0, h, u0, u1, y);
    if (c->fmu->version == 3)
        return plain_step(c, 3, t0, h, u0, u1, y);
    return c->fmu->version == 2 ? plain_step(c, 2, t0, h, u0, u1, y)
                                : plain_step(c, 1, t0, h, u0, u1, y);
}

int32_t cosim_co_simulation_outputs(void *self, double t, const double *u, double *y)
{
    (void)t;
    Component *c = self;
    c->note = COSIM_NOTHING;
    if (!can_step(c) || has_input_event(c, u))
        return COSIM_DECLINED;
    const int32_t status = corrected_outputs(c, u, y);
    return status == COSIM_OK ? COSIM_OK : leave(c, COSIM_FAILED);
}

typedef enum { TO_COPY, FROM_COPY } Direction;

static inline double *move(double *copy, double *values, int32_t count, Direction direction)
{
    if (direction == TO_COPY)
        cosim_copy_values(copy, values, count);
    else
        cosim_copy_values(values, copy, count);
    return copy + count;
}

/* Copy what shows an inner step, or put its copy back. */
RARE static void move_inner_step(Component *c, double *copy, Direction direction)
{
    cosim_inner_step *inner = c->inner_step;
    if (direction == TO_COPY)
        c->copy->inner_step = *inner;
    else
        *inner = c->copy->inner_step;
    copy = move(copy, inner->outputs, inner->n, direction);
    copy = move(copy, inner->inputs, inner->n_u, direction);
    move(copy, inner->outputs_before, inner->n, direction);
}

/* Copy the arrays of the state, or put their copy back. */
static inline void move_values(Component *c, Direction direction)
{
    const int32_t count = c->n_y + c->n_u + c->n_event; /* one array behind the other */
    double *copy = move(c->copy->values, c->outputs, count, direction);
    if (direction == TO_COPY)
        c->copy->watches = c->inner_step->watches;
    if (c->copy->watches) /* once it is decided it stays so */
        move_inner_step(c, copy, direction);
}

int32_t cosim_co_simulation_save(void *self)
{
    Component *c = self;
    cosim_co_simulation_copy *copy = c->copy;
    c->note = COSIM_NOTHING;
    if (!can_step(c))
        return COSIM_DECLINED;
    copy->messages = cosim_messages_up_to_now(c->fmu->messages);
    copy->has_warned = c->do_step.call->warned;
    const get_state_function get = (get_state_function)copy->get->function;
    if (cosim_fmu_check(c->fmu, copy->get, get(c->fmu->instance, copy->fmu_state)) != COSIM_OK)
        return leave(c, COSIM_FAILED);
    cosim_messages_forget(c->fmu->messages, copy->messages);
    copy->interpolates = c->interpolates;
    copy->stepped = c->stepped;
    copy->ended = c->ended;
    copy->next_event = c->next_event;
    copy->inner_steps = c->inner_steps;
    move_values(c, TO_COPY);
    return COSIM_OK;
}

int32_t cosim_co_simulation_restore(void *self)
{
    Component *c = self;
    const cosim_co_simulation_copy *copy = c->copy;
    c->note = COSIM_NOTHING;
    const set_state_function set = (set_state_function)copy->set->function;
    if (cosim_fmu_check(c->fmu, copy->set, set(c->fmu->instance, *copy->fmu_state)) != COSIM_OK)
        return leave(c, COSIM_FAILED);
    cosim_messages_forget(c->fmu->messages, copy->messages);
    if (!copy->has_warned)
        c->do_step.call->warned = 0;
    c->interpolates = copy->interpolates;
    c->stepped = copy->stepped;
    c->ended = copy->ended;
    c->next_event = copy->next_event;
    c->inner_steps = copy->inner_steps;
    move_values(c, FROM_COPY);
    return COSIM_OK;
}
