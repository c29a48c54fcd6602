#include "model_exchange.h"

#include <math.h>
#include <string.h>

typedef cosim_model_exchange Model;

enum {
    UPDATES = 100,       /* of the discrete states in one event */
    EVENTS = 900,        /* in one communication step: then the caller goes on, as below; it names
                            the causes of the last 100 of 1000 that do not advance time */
    LISTED = 100,        /* events of one communication step that are listed */
    SOLVER_STEPS = 20000 /* to one event: then the caller goes on, who may be interrupted */
};

/* The rest is left to the caller. */
enum { LEFT = COSIM_NO_VALUE };

static int32_t fail(Model *s, int32_t failure)
{
    s->failure = failure;
    return LEFT;
}

/* --- calls --- */

typedef int (*no_arguments)(void *);
typedef int (*with_number)(void *, double);
typedef int (*with_values)(void *, const double *, size_t);
typedef int (*for_values)(void *, double *, size_t);

static int32_t check(Model *s, cosim_fmu_call *call, int status)
{
    const int32_t checked = cosim_fmu_check(s->fmu, call, status);
    return checked == COSIM_OK ? COSIM_OK : fail(s, COSIM_FAILED_CALL);
}

static int32_t change_mode(Model *s, cosim_fmu_call *call)
{
    if (!call) /* FMI 1.0 has no modes */
        return COSIM_OK;
    return check(s, call, ((no_arguments)call->function)(s->fmu->instance));
}

static int32_t set_time(Model *s, double t)
{
    s->fmu->messages->now = t;
    return check(s, s->set_time, ((with_number)s->set_time->function)(s->fmu->instance, t));
}

static int32_t set_states(Model *s, const double *x)
{
    cosim_fmu_call *call = s->set_states;
    const with_values function = (with_values)call->function;
    return check(s, call, function(s->fmu->instance, x, (size_t)s->n_x));
}

static int32_t get_values(Model *s, cosim_fmu_call *call, double *values, int32_t n)
{
    return check(s, call, ((for_values)call->function)(s->fmu->instance, values, (size_t)n));
}

static int32_t get_indicators(Model *s, double *z)
{
    return get_values(s, s->get_indicators, z, s->n_z);
}

static int32_t set_variables(Model *s, const cosim_fmu_variables *variables, const double *u)
{
    const int32_t status = cosim_fmu_set(s->fmu, variables, u);
    if (status == COSIM_OK)
        return COSIM_OK;
    return fail(s, status == COSIM_DECLINED ? COSIM_FAILED_INPUTS : COSIM_FAILED_CALL);
}

static int32_t set_continuous_inputs(Model *s, const double *u)
{
    return s->continuous_variables.count ? set_variables(s, &s->continuous_variables, u) : COSIM_OK;
}

/* Integers that are no float64 are read again by the caller. */
static int32_t get_outputs(Model *s, double *y)
{
    const int32_t status = cosim_fmu_get(s->fmu, &s->output_variables, y);
    if (status == COSIM_OK)
        return COSIM_OK;
    return status == COSIM_DECLINED ? LEFT : fail(s, COSIM_FAILED_CALL);
}

static int32_t complete_step(Model *s)
{
    cosim_fmu_call *call = s->completed_step;
    void *instance = s->fmu->instance;
    int status;
    if (s->fmu->version == 1) {
        char event = 0;
        status = ((int (*)(void *, char *))call->function)(instance, &event);
        s->due |= event ? COSIM_STEP_EVENT : 0;
        s->ended = 0;
    } else if (s->fmu->version == 2) {
        int event = 0, end = 0;
        typedef int (*completed)(void *, int, int *, int *);
        status = ((completed)call->function)(instance, !s->fmu->may_go_back, &event, &end);
        s->due |= event ? COSIM_STEP_EVENT : 0;
        s->ended = end != 0;
    } else {
        bool event = false, end = false;
        typedef int (*completed)(void *, bool, bool *, bool *);
        status = ((completed)call->function)(instance, !s->fmu->may_go_back, &event, &end);
        s->due |= event ? COSIM_STEP_EVENT : 0;
        s->ended = end;
    }
    return check(s, call, status);
}

/* What an update of the discrete states may return. */
typedef struct {
    bool again, end, nominals_changed;
    double next_event; /* infinity: none is announced */
} Discrete;

static int32_t update_1(Model *s, Discrete *found)
{
    struct {
        char converged, references_changed, values_changed, end, has_next;
        double next;
    } info = {0};
    typedef int (*update)(void *, char, void *);
    const int status = ((update)s->update->function)(s->fmu->instance, 0, &info);
    *found = (Discrete){!info.converged, info.end, info.references_changed,
                        info.has_next ? info.next : INFINITY};
    return check(s, s->update, status);
}

static int32_t update_2(Model *s, Discrete *found)
{
    struct {
        int again, end, nominals_changed, values_changed, has_next;
        double next;
    } info = {0};
    const int status = ((int (*)(void *, void *))s->update->function)(s->fmu->instance, &info);
    *found = (Discrete){info.again, info.end, info.nominals_changed,
                        info.has_next ? info.next : INFINITY};
    return check(s, s->update, status);
}

static int32_t update_3(Model *s, Discrete *found)
{
    bool values_changed = false, has_next = false;
    double next = 0.0;
    typedef int (*update)(void *, bool *, bool *, bool *, bool *, bool *, double *);
    *found = (Discrete){false, false, false, INFINITY};
    const int status =
        ((update)s->update->function)(s->fmu->instance, &found->again, &found->end,
                                      &found->nominals_changed, &values_changed, &has_next, &next);
    if (has_next)
        found->next_event = next;
    return check(s, s->update, status);
}

/* Iterate the discrete states until the FMU needs no further update. */
static int32_t iterate(Model *s, Discrete *found)
{
    bool nominals_changed = false;
    for (int32_t i = 0; i < UPDATES; ++i) {
        int32_t status;
        if (s->fmu->version == 1)
            status = update_1(s, found);
        else
            status = s->fmu->version == 2 ? update_2(s, found) : update_3(s, found);
        if (status != COSIM_OK)
            return status;
        /* each call reports its own changes only */
        nominals_changed = found->nominals_changed = nominals_changed || found->nominals_changed;
        if (found->end || !found->again)
            return COSIM_OK;
    }
    return fail(s, COSIM_ENDLESS_UPDATE);
}

/* --- times and domains --- */

/* The distance below which two times near t are one: 4 units in the last place. */
static double closeness(double t)
{
    union {
        double value;
        uint64_t bits;
    } size = {fabs(t)}, next = size;
    ++next.bits;
    return 4.0 * (next.value - size.value);
}

/* Whether the next time event is at t or before it. */
static inline bool is_time_event_due(const Model *s)
{
    return s->next_event != INFINITY && s->next_event - s->t <= closeness(s->t);
}

/* Whether it comes before the end of the communication step. */
static inline bool event_comes_first(const Model *s)
{
    return s->next_event != INFINITY && s->t1 - s->next_event > closeness(s->t1);
}

/* `stop`, where t is close to it. */
static inline double end_at(double t, double stop)
{
    return t != stop && stop - t <= closeness(stop) ? stop : t;
}

static bool domains_differ(const Model *s, const double *before, const double *after)
{
    for (int32_t i = 0; i < s->n_z; ++i)
        if ((before[i] > 0.0) != (after[i] > 0.0))
            return true;
    return false;
}

/* --- the point that the FMU is at --- */

static const double *inputs_at(const Model *s, double t)
{
    if (t >= s->t1)
        return s->u1;
    if (t <= s->t0)
        return s->u0;
    const double fraction = (t - s->t0) / (s->t1 - s->t0);
    for (int32_t i = 0; i < s->n_u; ++i)
        s->u[i] = s->u0[i] + fraction * (s->u1[i] - s->u0[i]);
    return s->u;
}

static int32_t set_point(Model *s, double t, const double *x)
{
    if (t != s->inputs_time) {
        int32_t status = set_time(s, t);
        if (status == COSIM_OK && s->continuous_variables.count)
            status = set_variables(s, &s->continuous_variables, inputs_at(s, t));
        if (status != COSIM_OK)
            return status;
        s->inputs_time = t;
    }
    return s->n_x ? set_states(s, x) : COSIM_OK;
}

int32_t cosim_model_exchange_derivatives(void *model, double t, const double *x, double *dx)
{
    Model *s = model;
    int32_t status = set_point(s, t, x);
    if (status == COSIM_OK)
        status = get_values(s, s->get_derivatives, dx, s->n_x);
    return status == COSIM_OK ? COSIM_OK : -1;
}

/* The solution at t, in the last step of the solver. */
static int32_t solution(Model *s, double t, double *x)
{
    if (!s->solver)
        return COSIM_OK;
    return cosim_runge_kutta_at(s->solver, t, x) == COSIM_OK ? COSIM_OK : LEFT;
}

/* Set the FMU to the solution at *t, or at `stop` where that is one time. */
static int32_t set_solution(Model *s, double *t, double stop, double *x)
{
    int32_t status = solution(s, *t, x);
    *t = end_at(*t, stop);
    if (status == COSIM_OK)
        status = set_point(s, *t, x);
    return status;
}

static void restart_solver(Model *s)
{
    if (s->solver)
        cosim_runge_kutta_start(s->solver, s->t, s->x, s->nominals);
}

/* --- location of state events: the ITP method, as in events.py --- */

static double root(double za, double zb)
{
    const double difference = za - zb;
    if (!isfinite(difference))
        return 0.5;
    const double fraction = za / difference;
    return fraction < 0.0 ? 0.0 : fraction > 1.0 ? 1.0 : fraction;
}

static double first_root(const Model *s, double a, const double *za, const double *zb,
                         double width, double middle)
{
    double first = 0.0;
    bool found = false;
    for (int32_t j = 0; j < s->n_z; ++j) {
        if ((za[j] > 0.0) == (zb[j] > 0.0))
            continue;
        const double t = a + width * root(za[j], zb[j]);
        if (!found || t < first)
            first = t;
        found = true;
    }
    return found ? first : middle;
}

static int32_t indicators_at(Model *s, double t, double *x, double *z)
{
    int32_t status = solution(s, t, x);
    if (status == COSIM_OK)
        status = set_point(s, t, x);
    return status == COSIM_OK ? get_indicators(s, z) : status;
}

/* *b <- the time in (a, *b] at which the domains of za are left for the first time. `work` takes x
 * and three vectors of indicators. */
static int32_t locate(Model *s, double a, const double *za, double *end, const double *zb,
                      double *work)
{
    double *x = work, *zc = x + s->n_x, *zd = zc + s->n_z, *spare = zd + s->n_z;
    double b = *end;
    const double resolution = closeness(fabs(a) > fabs(b) ? fabs(a) : fabs(b));
    double ratio = (b - a) / resolution;
    if (!(ratio > 1.0))
        ratio = 1.0;
    int exponent;
    const double mantissa = frexp(ratio, &exponent);
    const int bisections = mantissa > 0.5 ? exponent : exponent - 1;
    double largest = ldexp(resolution, bisections + 1);
    const double scale = 0.2 / (b - a);
    while (b - a > resolution) {
        const double width = b - a, middle = 0.5 * (a + b);
        const double secant = first_root(s, a, za, zb, width, middle);
        double truncation = scale * width * width;
        if (0.5 * resolution > truncation)
            truncation = 0.5 * resolution;
        const double toward = copysign(1.0, middle - secant);
        double t = middle;
        if (truncation <= fabs(middle - secant))
            t = secant + toward * truncation;
        double radius = 0.5 * (largest - width);
        if (0.0 > radius)
            radius = 0.0;
        if (fabs(t - middle) > radius)
            t = middle - toward * radius;
        largest *= 0.5;
        double *z = za != zc && zb != zc ? zc : za != zd && zb != zd ? zd : spare;
        const int32_t status = indicators_at(s, t, x, z);
        if (status != COSIM_OK)
            return status;
        if (domains_differ(s, za, z)) {
            b = t;
            zb = z;
        } else {
            a = t;
            za = z;
        }
    }
    *end = b;
    return COSIM_OK;
}

/* --- the list of events --- */

static void push(Model *s, double t, int32_t kind, int32_t count)
{
    s->events[s->n_events++] = (cosim_event){t, kind, count};
}

static void list_event(Model *s, int32_t kind)
{
    s->latest = s->t;
    if (!s->in_step)
        s->first = s->t;
    if (++s->in_step <= LISTED)
        push(s, s->t, kind, 0);
}

static void list_events(Model *s, int32_t kinds)
{
    for (int32_t kind = COSIM_STATE_EVENT; kind <= COSIM_INPUT_EVENT; kind *= 2)
        if (kinds & kind)
            list_event(s, kind);
}

static void begin_step(Model *s)
{
    if (s->in_step > LISTED)
        push(s, s->latest, COSIM_NOT_LISTED, s->in_step - LISTED);
    s->in_step = 0;
    s->first = INFINITY;
}

/* Whether the events of one more step find room. */
static bool has_room(const Model *s) { return s->n_events + 2 * LISTED + 2 <= s->room; }

/* --- events --- */

static bool jumps(const Model *s, const double *u)
{
    for (int32_t i = 0; i < s->n_in_events; ++i)
        if (u[s->in_events[i]] != s->inputs[s->in_events[i]])
            return true;
    return false;
}

/* One by one: there are few of them, and the compiler makes it one instruction each. */
static bool are_the_inputs(const Model *s, const double *u)
{
    for (int32_t i = 0; i < s->n_u; ++i)
        if (memcmp(u + i, s->inputs + i, sizeof *u) != 0)
            return false;
    return true;
}

static void keep_inputs(Model *s, const double *u)
{
    for (int32_t i = 0; i < s->n_u; ++i)
        if (memcmp(u + i, s->inputs + i, sizeof *u) != 0)
            s->inputs[i] = u[i];
}

/* Leave event mode, and read what changed. */
static int32_t leave_event_mode(Model *s, const Discrete *found)
{
    s->next_event = found->next_event;
    if (!(s->next_event >= s->t - closeness(s->t)))
        return fail(s, COSIM_EVENT_IS_OVER);
    int32_t status = change_mode(s, s->enter_continuous_time_mode);
    if (status == COSIM_OK && s->n_x)
        status = get_values(s, s->get_states, s->x, s->n_x);
    if (status == COSIM_OK && s->n_z)
        status = get_indicators(s, s->indicators);
    s->nominals_changed |= found->nominals_changed;
    return status;
}

/* Do one event, with all inputs. */
static int32_t handle_event(Model *s, const double *u)
{
    Discrete found;
    int32_t status = change_mode(s, s->enter_event_mode);
    if (status != COSIM_OK)
        return status;
    keep_inputs(s, u); /* also where they cannot be set, so that the caller can see it */
    status = set_variables(s, &s->input_variables, u);
    if (status == COSIM_OK)
        status = iterate(s, &found);
    if (status != COSIM_OK)
        return status;
    s->due = 0;
    s->inputs_time = NAN;
    s->ended |= found.end;
    return s->ended ? COSIM_OK : leave_event_mode(s, &found);
}

static int32_t handle_events(Model *s, const double *u);

static int32_t set_jumped_inputs(Model *s, const double *u)
{
    int32_t status = set_continuous_inputs(s, u);
    if (status != COSIM_OK)
        return status;
    s->inputs_time = NAN;
    keep_inputs(s, u);
    restart_solver(s);
    if (!s->n_z)
        return COSIM_OK;
    double *before = s->scratch;
    memcpy(before, s->indicators, (size_t)s->n_z * sizeof *before);
    status = get_indicators(s, s->indicators);
    if (status != COSIM_OK || !domains_differ(s, before, s->indicators))
        return status;
    s->due = COSIM_STATE_EVENT;
    return handle_events(s, u);
}

/* Handle what is due at the time reached, with u, the inputs from here on. */
static int32_t handle_events(Model *s, const double *u)
{
    if (s->due || jumps(s, u)) {
        list_events(s, s->due ? s->due : COSIM_INPUT_EVENT);
        const int32_t status = handle_event(s, u);
        if (status != COSIM_OK)
            return status;
        restart_solver(s);
        return s->nominals_changed ? LEFT : COSIM_OK;
    }
    return are_the_inputs(s, u) ? COSIM_OK : set_jumped_inputs(s, u);
}

/* --- integration --- */

/* Add the time event where it is due; the FMU then has a time not before it. */
static int32_t add_time_event(Model *s)
{
    if (!is_time_event_due(s))
        return COSIM_OK;
    s->due |= COSIM_TIME_EVENT;
    if (!(s->next_event > s->t))
        return COSIM_OK;
    s->t = s->next_event;
    return set_point(s, s->t, s->x);
}

/* Set the FMU to the first part of a step of the solver, to *t, after which a domain has changed;
 * then *t is there. */
static int32_t look_between(Model *s, double *t, bool *found)
{
    double *x = s->scratch, *z = x + s->n_x;
    const double share = (*t - s->t) / cosim_runge_kutta_proposed(s->solver);
    const int32_t parts = share < 1.0 ? (int32_t)ceil(s->parts * share) : s->parts;
    for (int32_t i = 1; i < parts; ++i) {
        const double between = s->t + (*t - s->t) * i / parts;
        const int32_t status = indicators_at(s, between, x, z);
        if (status != COSIM_OK)
            return status;
        *found = domains_differ(s, s->indicators, z);
        if (*found) {
            *t = between;
            return COSIM_OK;
        }
    }
    return COSIM_OK;
}

/* Whether a domain has changed at *t, the end of a step of the solver; then *t is where it did. */
static int32_t look_for_event(Model *s, double *t, double stop)
{
    double *x = s->scratch, *z = x + s->n_x, *work = z + s->n_z;
    int32_t status = get_indicators(s, z);
    if (status == COSIM_OK && domains_differ(s, s->indicators, z)) {
        status = locate(s, s->t, s->indicators, t, z, work);
        if (status == COSIM_OK)
            status = set_solution(s, t, stop, x);
        if (status == COSIM_OK)
            memcpy(s->x, x, (size_t)s->n_x * sizeof *x);
        s->due |= COSIM_STATE_EVENT;
    }
    memcpy(s->indicators, z, (size_t)s->n_z * sizeof *z);
    return status;
}

/* Take a step of the solver, to the first state event in it at most. */
static int32_t solver_step(Model *s, double stop)
{
    double t = stop;
    int32_t status = COSIM_OK;
    if (s->solver) {
        status = cosim_runge_kutta_step(s->solver, stop, &t);
        if (status == COSIM_STEP_TOO_SMALL)
            return fail(s, COSIM_FAILED_SOLVER);
        if (status != COSIM_OK)
            return LEFT;
    }
    t = end_at(t, stop);
    bool found = false;
    if (s->parts > 1 && s->n_z && s->solver)
        status = look_between(s, &t, &found);
    if (status == COSIM_OK && !found)
        status = set_point(s, t, s->x); /* the solver's own, at the end of its step */
    if (status == COSIM_OK && s->n_z)
        status = look_for_event(s, &t, stop);
    if (status == COSIM_OK)
        s->t = t;
    return status;
}

/* Integrate to the next event, or to t1 at most. */
static int32_t integrate_to_event(Model *s)
{
    s->due = 0;
    for (int32_t i = 0; i < SOLVER_STEPS; ++i) {
        if (is_time_event_due(s))
            return add_time_event(s);
        const double stop = event_comes_first(s) ? s->next_event : s->t1;
        const double least = closeness(s->t);
        const double bound = s->t + (s->longest_step > least ? s->longest_step : least);
        int32_t status = solver_step(s, end_at(bound, stop) < stop ? bound : stop);
        if (status == COSIM_OK && s->completed_step)
            status = complete_step(s);
        if (status == COSIM_OK)
            status = add_time_event(s);
        if (status != COSIM_OK || s->due || s->ended || s->t >= s->t1)
            return status;
    }
    return LEFT;
}

/* Count an event, as Standstill does. */
static void count_event(Model *s)
{
    const double roundings = 4000.0 * closeness(s->t);
    if (s->t - s->since > (roundings > 1e-9 ? roundings : 1e-9)) {
        s->since = s->t;
        s->handled = 0;
    }
    ++s->handled;
}

/* Integrate over the communication step and handle the events before its end. */
static int32_t integrate(Model *s)
{
    begin_step(s);
    s->reached = COSIM_INTEGRATING;
    s->handled = 0;
    s->since = s->t0;
    for (int32_t i = 0; i < EVENTS; ++i) {
        int32_t status = integrate_to_event(s);
        if (status != COSIM_OK)
            return status;
        if (s->t >= s->t1) {
            keep_inputs(s, s->u1);
            s->reached = COSIM_AT_END;
            return COSIM_OK;
        }
        if (s->ended)
            return LEFT;
        count_event(s);
        status = handle_events(s, inputs_at(s, s->t));
        if (status == COSIM_OK && s->ended)
            status = LEFT;
        if (status != COSIM_OK)
            return status;
    }
    return LEFT;
}

/* --- outputs --- */

/* Set continuous inputs for the outputs alone; the state stays what it is. */
static int32_t correct_inputs(Model *s, const double *u)
{
    if (are_the_inputs(s, u) && s->inputs_time == s->inputs_time)
        return COSIM_OK;
    s->inputs_time = NAN;
    return set_continuous_inputs(s, u);
}

typedef int (*copies_state)(void *, void **);
typedef int (*sets_state)(void *, void *);

/* Read the outputs behind the event that is due; then go back. */
static int32_t outputs_after_event(Model *s, const double *u, double *y)
{
    void *instance = s->fmu->instance;
    double *x = s->scratch, *z = x + s->n_x, *inputs = z + s->n_z;
    const int32_t due = s->due, nominals_changed = s->nominals_changed;
    const double next_event = s->next_event;
    memcpy(x, s->x, (size_t)s->n_x * sizeof *x);
    memcpy(z, s->indicators, (size_t)s->n_z * sizeof *z);
    memcpy(inputs, s->inputs, (size_t)s->n_u * sizeof *inputs);
    copies_state copy = (copies_state)s->get_state->function;
    int32_t status = check(s, s->get_state, copy(instance, s->fmu_state));
    if (status == COSIM_OK)
        status = handle_event(s, u);
    if (status == COSIM_OK)
        status = get_outputs(s, y);
    if (status != COSIM_OK || s->ended)
        return status;
    sets_state set = (sets_state)s->set_state->function;
    status = check(s, s->set_state, set(instance, *s->fmu_state));
    memcpy(s->x, x, (size_t)s->n_x * sizeof *x);
    memcpy(s->indicators, z, (size_t)s->n_z * sizeof *z);
    memcpy(s->inputs, inputs, (size_t)s->n_u * sizeof *inputs);
    s->due = due;
    s->nominals_changed = nominals_changed;
    s->next_event = next_event;
    return status;
}

/* Read the outputs before the event that is due. */
static int32_t read_left(Model *s, const double *u)
{
    if (!s->left || !s->due || s->ended)
        return COSIM_OK;
    int32_t status = correct_inputs(s, u);
    if (status == COSIM_OK)
        status = get_outputs(s, s->left);
    s->has_left = status == COSIM_OK;
    return status;
}

static int32_t outputs(Model *s, const double *u, double *y)
{
    int32_t status = COSIM_OK;
    if (s->ended)
        return get_outputs(s, y);
    status = read_left(s, u);
    if (status != COSIM_OK)
        return status;
    if (!(s->due || jumps(s, u)))
        status = correct_inputs(s, u);
    else if (s->rolls_back)
        return s->fmu_state ? outputs_after_event(s, u, y) : LEFT;
    else
        status = handle_events(s, u);
    return status == COSIM_OK ? get_outputs(s, y) : status;
}

/* --- steps --- */

static bool is_allowed(const Model *s)
{
    return s->allowed && !s->ended && cosim_fmu_is_open(s->fmu) && has_room(s);
}

static void begin_inputs(Model *s, double t0, double t1, const double *u0, const double *u1)
{
    s->t0 = t0;
    s->t1 = t1;
    s->u0 = u0;
    s->u1 = u1;
    if (!s->n_in_events)
        return;
    /* inputs that change in events only keep their value to the end of the step */
    memcpy(s->end_inputs, u1, (size_t)s->n_u * sizeof *u1);
    for (int32_t i = 0; i < s->n_in_events; ++i)
        s->end_inputs[s->in_events[i]] = u0[s->in_events[i]];
    s->u1 = s->end_inputs;
}

int32_t cosim_model_exchange_step(void *self, double t0, double t1, double h, const double *u0,
                                  const double *u1, double *y)
{
    (void)h;
    Model *s = self;
    if (!is_allowed(s))
        return LEFT;
    s->moved = 1;
    s->has_left = 0;
    s->allowed = 0; /* until the step is done: what is left of it is the caller's */
    int32_t status = handle_events(s, u0);
    if (status == COSIM_OK && s->ended)
        status = LEFT;
    if (status == COSIM_OK) {
        begin_inputs(s, t0, t1, u0, u1);
        status = integrate(s);
    }
    if (status == COSIM_OK)
        status = outputs(s, u1, y);
    if (status != COSIM_OK || s->ended) /* the end comes with the row of its step */
        return LEFT;
    s->reached = COSIM_AT_BEGIN;
    s->allowed = 1;
    return COSIM_OK;
}

int32_t cosim_model_exchange_outputs(void *self, double t, const double *u, double *y)
{
    (void)t;
    Model *s = self;
    if (!is_allowed(s))
        return LEFT;
    s->moved = 1;
    s->allowed = 0;
    const int32_t status = outputs(s, u, y);
    s->allowed = status == COSIM_OK;
    return status == COSIM_OK ? COSIM_OK : LEFT;
}
