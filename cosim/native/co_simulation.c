#include "co_simulation.h"

#include <math.h>
#include <string.h>

#define CLOSE 1e-9 /* of a communication step: times that are the same */

typedef cosim_co_simulation Component;
typedef int (*get_state_function)(void *instance, void **state);

/* The inputs over one communication step. */
typedef struct {
    double t, h;
    const double *u0, *u1, *change;
} Ramp;

static double fraction(const Ramp *ramp, double time)
{
    const double s = (time - ramp->t) / ramp->h;
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

/* Inputs that are interpolated at `s`, the others at the mean. */
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

static bool can_step(const Component *c)
{
    return c->fmu && cosim_fmu_is_open(c->fmu) && c->initialized && !c->ended;
}

static int32_t leave(Component *c, int32_t note)
{
    c->note = note;
    return COSIM_DECLINED;
}

/* y <- outputs + D (u - inputs) */
static int32_t corrected_outputs(Component *c, const double *u, double *y)
{
    memcpy(y, c->outputs, (size_t)c->n_y * sizeof *y);
    const cosim_fmu_directional *feedthrough = &c->feedthrough;
    if (feedthrough->n_unknowns == 0)
        return COSIM_OK;
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

static int32_t save_state(const Component *c)
{
    const int status = ((get_state_function)c->get_state->function)(c->fmu->instance, c->fmu_state);
    return cosim_fmu_judge(c->fmu, c->get_state, status);
}

/* Set the inputs of a step, and their slopes. */
static int32_t set_inputs(Component *c, const Ramp *ramp, double *inputs)
{
    if (c->interpolates)
        interpolated_at(c, ramp, 0.0, inputs);
    else
        for (int32_t i = 0; i < c->n_u; ++i)
            inputs[i] = input_at(ramp, 0.5, i);
    const int32_t status = cosim_fmu_set(c->fmu, &c->step_inputs, inputs);
    if (status != COSIM_OK)
        return leave(c, status == COSIM_CALL_FAILED ? COSIM_FAILED : COSIM_NOTHING);
    if (!c->interpolates)
        return COSIM_OK;
    const double *change = ramp->change;
    if (cosim_fmu_set_slopes(c->fmu, &c->slopes, change, ramp->h) != COSIM_OK)
        return leave(c, COSIM_SLOPES_FAILED);
    return COSIM_OK;
}

/* Find out which inputs the outputs after a step belong to. */
static void keep_inputs(Component *c, const Ramp *ramp, const double *set)
{
    if (!c->interpolates) {
        memcpy(c->inputs, set, (size_t)c->n_u * sizeof *set);
        return;
    }
    const double until = cosim_fmu_interpolated_until(c->fmu, &c->do_step);
    double s = 1.0;
    if (until != INFINITY) {
        s = fraction(ramp, until);
        s = s > 0.0 ? s : 0.0;
        s = s < 1.0 ? s : 1.0;
    }
    interpolated_at(c, ramp, s, c->inputs);
}

int32_t cosim_co_simulation_step(void *self, double t0, double t1, double h, const double *u0,
                                 const double *u1, double *y)
{
    (void)t1;
    Component *c = self;
    c->note = COSIM_NOTHING;
    if (!can_step(c) || (c->get_state && !c->fmu_state) || has_input_event(c, u0))
        return COSIM_DECLINED;
    double *end = c->scratch, *change = end + c->n_u, *inputs = change + c->n_u;
    for (int32_t i = 0; i < c->n_u; ++i) {
        change[i] = c->held[i] ? 0.0 : u1[i] - u0[i];
        end[i] = c->held[i] ? u0[i] : u1[i];
    }
    const Ramp ramp = {t0, h, u0, end, change};
    const double next_event = isinf(c->next_event) ? INFINITY : fraction(&ramp, c->next_event);
    if (next_event > 0.0 && next_event < 1.0)
        return COSIM_DECLINED;

    if (c->get_state && save_state(c) != COSIM_OK)
        return leave(c, COSIM_FAILED);
    if (set_inputs(c, &ramp, inputs) != COSIM_OK)
        return COSIM_DECLINED;
    if (cosim_fmu_do_step(c->fmu, &c->do_step, t0, h) != COSIM_OK || next_event <= 1.0)
        return leave(c, COSIM_STEPPED);
    keep_inputs(c, &ramp, inputs);
    int32_t status = cosim_fmu_get(c->fmu, &c->outputs_read, c->outputs);
    if (status != COSIM_OK)
        return leave(c, status == COSIM_CALL_FAILED ? COSIM_FAILED : COSIM_UNREAD);
    c->stepped = 1;
    c->inner_steps = cosim_inner_step_observe(c->inner_step, c->outputs, c->inputs);
    if (c->inner_steps || has_input_event(c, u1))
        return leave(c, COSIM_COMPLETED);
    status = corrected_outputs(c, u1, y);
    return status == COSIM_OK ? COSIM_OK : leave(c, COSIM_FAILED);
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
