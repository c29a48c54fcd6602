/* Model exchange FMUs with events, for FMI 2 and FMI 3 (-DFMI=2, 3), one per -DMODEL.
 *
 * BALL     x' = v, v' = -9.81 from x = 1; at the ground v -> -0.7 v, x -> 0+; below the speed p
 *          it rests
 * FRICTION v' = u - q p while it slips (q = -1, 1), v = 0 while it sticks (q = 0): Coulomb
 *          friction, force u, level p
 * SAW      x' = 1, and x -> 0 at the times k p; count of them
 * COUNTER  no states; count of the times k p, which are announced by adding p to the last one
 * TWO      x' = 1; indicators x - 0.53, x - 0.51, x - 0.53; q: number of the indicators that
 *          events saw positive, v: time at which it grew
 * SLIDE    x' = -1 above x = p, 1 below: a relay without hysteresis, which chatters
 * ENDLESS  x' = 1; above x = p discrete states always need an update
 * ENDS     x' = 1; asks for the end above x = p, and refuses to let time move after that
 * MEMORY   x' = q; q counts the changes of the discrete input d
 * SWITCH   x' = u - x below x = p, u - 4 x above
 * STEPS    x' = 1; asks for an event after the step in which x reaches the next k p: count of them,
 *          and x <- x + p / 4
 * TIRED    x' = 1; asks for the end after a step above x = p
 * SCALED   x' = u - x; at the times k p the nominal value of x changes; at 2 p it is none
 * REFUSES  x' = u; no derivatives above x = p: they are discarded
 * SAMPLE   x' = 1; q <- -u at the times k p, count of them; 0 before
 * RESET    x' = 1 + u, and x -> x - p at x = p
 * WINDOW   x'' = -x from x = 0, x' = 1; count of the changes of x > p */
#if FMI == 2
#include "fmi2Functions.h"
#define F(name) fmi2##name
#define VALUES(type) const fmi2ValueReference vr[], size_t n, type values[]
#else
#include "fmi3Functions.h"
#define F(name) fmi3##name
#define VALUES(type) const fmi3ValueReference vr[], size_t n, type values[], size_t n_values
#define fmi3Component fmi3Instance
#endif

#include <float.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

enum { BALL, FRICTION, SAW, COUNTER, TWO, SLIDE, ENDLESS, ENDS, MEMORY, SWITCH };
enum { STEPS = SWITCH + 1, TIRED, SCALED, REFUSES, SAMPLE, RESET, WINDOW };
enum { U, D, X, V, DER_X, DER_V, Q, COUNT, P, EVALUATIONS, COMPLETED, VARIABLES };

typedef struct {
    double t, next, last, v[VARIABLES];
    bool ended;
} Instance;

typedef struct {
    bool need_update, terminate, values_changed, nominals_changed;
} Answer;

static void begin(Instance *instance, double t)
{
    instance->t = t;
    const bool ticks = MODEL == SAW || MODEL == COUNTER || MODEL == SCALED || MODEL == SAMPLE;
    instance->next = ticks ? instance->v[P] : 0.0;
    instance->v[Q] = MODEL == FRICTION || MODEL == TWO || MODEL == MEMORY || MODEL == SAMPLE ? 0.0 : 1.0;
    if (MODEL == BALL)
        instance->v[X] = 1.0;
    if (MODEL == WINDOW)
        instance->v[V] = 1.0;
}

static void derive(Instance *instance)
{
    double *v = instance->v;
    v[DER_V] = MODEL == BALL                      ? -9.81 * v[Q]
               : MODEL == FRICTION && v[Q] != 0.0 ? v[U] - v[Q] * v[P]
                                                  : 0.0;
    v[DER_X] = MODEL == BALL || MODEL == FRICTION  ? v[V]
               : MODEL == SLIDE || MODEL == MEMORY ? v[Q]
                                                   : 1.0;
    if (MODEL == WINDOW) {
        v[DER_X] = v[V];
        v[DER_V] = -v[X];
    }
    if (MODEL == SWITCH)
        v[DER_X] = v[U] - (v[Q] > 0.0 ? 1.0 : 4.0) * v[X];
    if (MODEL == SCALED)
        v[DER_X] = v[U] - v[X];
    if (MODEL == REFUSES)
        v[DER_X] = v[U];
    if (MODEL == RESET)
        v[DER_X] = 1.0 + v[U];
}

static void indicate(const Instance *instance, double z[])
{
    const double *v = instance->v;
    z[0] = MODEL == BALL ? v[X] : v[X] - v[P];
    if (MODEL == FRICTION) {
        z[0] = v[Q] == 0.0 ? v[U] - v[P] : v[Q] * v[V] + DBL_MIN;
        z[1] = v[Q] == 0.0 ? v[U] + v[P] : 1.0;
    } else if (MODEL == TWO) {
        z[0] = z[2] = v[X] - 0.53;
        z[1] = v[X] - 0.51;
    }
}

static bool tick(Instance *instance)
{
    if (instance->next == 0.0 || instance->t < instance->next)
        return false;
    instance->v[COUNT] += 1.0;
    instance->next = MODEL == COUNTER ? instance->next + instance->v[P]
                                      : (instance->v[COUNT] + 1.0) * instance->v[P];
    return true;
}

static bool is_reached(const Instance *instance)
{
    return instance->v[X] >= (instance->v[COUNT] + 1.0) * instance->v[P];
}

static Answer update(Instance *instance)
{
    Answer found = {false, false, false, false};
    double *v = instance->v, z[3];
    if (MODEL == BALL && v[X] <= 0.0 && v[V] < 0.0) {
        v[X] = DBL_MIN;
        v[V] *= -0.7;
        v[COUNT] += 1.0;
        if (v[V] < v[P])
            v[V] = v[Q] = 0.0;
        found.values_changed = true;
    } else if (MODEL == FRICTION && v[Q] != 0.0 && v[Q] * v[V] <= 0.0) {
        v[Q] = v[V] = 0.0;
        found.values_changed = found.need_update = true;
    } else if (MODEL == FRICTION && v[Q] == 0.0) {
        v[Q] = v[U] > v[P] ? 1.0 : v[U] <= -v[P] ? -1.0 : 0.0;
    } else if (MODEL == SAW && tick(instance)) {
        v[X] = 0.0;
        found.values_changed = true;
    } else if (MODEL == COUNTER) {
        tick(instance);
    } else if (MODEL == SAMPLE && tick(instance)) {
        v[Q] = -v[U];
    } else if (MODEL == SCALED && tick(instance)) {
        found.nominals_changed = true;
    } else if (MODEL == STEPS && is_reached(instance)) {
        v[COUNT] += 1.0;
        v[X] += 0.25 * v[P];
        found.values_changed = true;
    } else if (MODEL == TWO) {
        indicate(instance, z);
        double positive = (z[0] > 0.0) + (z[1] > 0.0) + (z[2] > 0.0);
        v[V] = positive > v[Q] ? instance->t : v[V];
        v[Q] = positive;
    } else if (MODEL == SLIDE) {
        v[Q] = v[X] > v[P] ? -1.0 : 1.0;
    } else if (MODEL == ENDLESS) {
        found.need_update = v[X] > v[P];
    } else if (MODEL == ENDS) {
        found.terminate = instance->ended = v[X] > v[P];
    } else if (MODEL == MEMORY) {
        v[Q] += v[D] != instance->last;
        instance->last = v[D];
    } else if (MODEL == RESET && v[X] >= v[P]) {
        v[X] -= v[P];
        found.values_changed = true;
    } else if (MODEL == WINDOW && (v[X] > v[P]) != (instance->last > v[P])) {
        v[COUNT] += 1.0;
        instance->last = v[X];
    } else if (MODEL == SWITCH) {
        v[Q] = v[X] > v[P] ? -1.0 : 1.0;
    }
    return found;
}

/* --- the calls that both versions have --- */

typedef F(Component) Handle;
typedef F(Status) Status;

void F(FreeInstance)(Handle c) { free(c); }
Status F(Reset)(Handle c)
{
    memset(c, 0, sizeof(Instance));
    return F(OK);
}
Status F(Terminate)(Handle c)
{
    (void)c;
    return F(OK);
}
Status F(ExitInitializationMode)(Handle c)
{
    ((Instance *)c)->last = ((Instance *)c)->v[D];
    return F(OK);
}
Status F(EnterContinuousTimeMode)(Handle c) { return ((Instance *)c)->ended ? F(Error) : F(OK); }
Status F(SetTime)(Handle c, double t)
{
    ((Instance *)c)->t = t;
    return F(OK);
}
Status F(EnterEventMode)(Handle c)
{
    (void)c;
    return F(OK);
}
Status F(SetContinuousStates)(Handle c, const double x[], size_t n)
{
    memcpy(((Instance *)c)->v + X, x, n * sizeof *x);
    return F(OK);
}
Status F(GetContinuousStates)(Handle c, double x[], size_t n)
{
    memcpy(x, ((Instance *)c)->v + X, n * sizeof *x);
    return F(OK);
}
Status F(GetEventIndicators)(Handle c, double z[], size_t n)
{
    (void)n;
    indicate(c, z);
    return F(OK);
}

static Status get_derivatives(Handle c, double dx[], size_t n)
{
    derive(c);
    ((Instance *)c)->v[EVALUATIONS] += 1.0;
    memcpy(dx, ((Instance *)c)->v + DER_X, n * sizeof *dx);
    const Instance *instance = c;
    return MODEL == REFUSES && instance->v[X] > instance->v[P] ? F(Discard) : F(OK);
}

Status F(GetNominalsOfContinuousStates)(Handle c, double nominals[], size_t n)
{
    const double count = ((Instance *)c)->v[COUNT];
    for (size_t i = 0; i < n; ++i)
        nominals[i] = MODEL != SCALED ? NOMINAL : count == 2.0 ? 0.0 : 1.0 / (1.0 + 100.0 * count);
    return F(OK);
}

static Status get_values(Instance *instance, const unsigned vr[], size_t n, double values[])
{
    derive(instance);
    for (size_t i = 0; i < n; ++i)
        values[i] = instance->v[vr[i]];
    return F(OK);
}

static Status set_values(Instance *instance, const unsigned vr[], size_t n, const double values[])
{
    for (size_t i = 0; i < n; ++i)
        instance->v[vr[i]] = values[i];
    return F(OK);
}

static Status get_state(Handle c, void **state)
{
    if (*state == NULL)
        *state = malloc(sizeof(Instance));
    memcpy(*state, c, sizeof(Instance));
    return F(OK);
}

static Status set_state(Handle c, void *state)
{
    double evaluations = ((Instance *)c)->v[EVALUATIONS];
    memcpy(c, state, sizeof(Instance));
    ((Instance *)c)->v[EVALUATIONS] = evaluations;
    return F(OK);
}

static Status free_state(void **state)
{
    free(*state);
    *state = NULL;
    return F(OK);
}

/* --- where they differ --- */

#if FMI == 2
#define UNUSED(Get, type)                         \
    Status Get(Handle c, VALUES(type))            \
    {                                             \
        (void)c, (void)vr, (void)n, (void)values; \
        return F(Error);                          \
    }
UNUSED(fmi2GetInteger, fmi2Integer)
UNUSED(fmi2SetInteger, const fmi2Integer)
UNUSED(fmi2GetBoolean, fmi2Boolean)
UNUSED(fmi2SetBoolean, const fmi2Boolean)
UNUSED(fmi2GetString, fmi2String)
UNUSED(fmi2SetString, const fmi2String)

Handle fmi2Instantiate(fmi2String name, fmi2Type kind, fmi2String guid, fmi2String resources,
                       const fmi2CallbackFunctions *functions, fmi2Boolean visible,
                       fmi2Boolean logging)
{
    (void)name, (void)kind, (void)guid, (void)resources, (void)functions, (void)visible,
        (void)logging;
    return calloc(1, sizeof(Instance));
}

Status fmi2SetupExperiment(Handle c, fmi2Boolean has_tolerance, double tolerance, double start,
                           fmi2Boolean has_stop, double stop)
{
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    ((Instance *)c)->t = start;
    return fmi2OK;
}

Status fmi2EnterInitializationMode(Handle c)
{
    begin(c, ((Instance *)c)->t);
    return fmi2OK;
}
Status fmi2GetReal(Handle c, VALUES(double)) { return get_values(c, vr, n, values); }
Status fmi2SetReal(Handle c, VALUES(const double)) { return set_values(c, vr, n, values); }
Status fmi2GetDerivatives(Handle c, double dx[], size_t n) { return get_derivatives(c, dx, n); }
Status fmi2GetFMUstate(Handle c, fmi2FMUstate *state) { return get_state(c, state); }
Status fmi2SetFMUstate(Handle c, fmi2FMUstate state) { return set_state(c, state); }
Status fmi2FreeFMUstate(Handle c, fmi2FMUstate *state)
{
    (void)c;
    return free_state(state);
}

Status fmi2NewDiscreteStates(Handle c, fmi2EventInfo *info)
{
    Instance *instance = c;
    Answer found = update(instance);
    info->newDiscreteStatesNeeded = found.need_update;
    info->terminateSimulation = found.terminate;
    info->valuesOfContinuousStatesChanged = found.values_changed;
    info->nominalsOfContinuousStatesChanged = found.nominals_changed;
    info->nextEventTimeDefined = instance->next > 0.0;
    info->nextEventTime = instance->next;
    return fmi2OK;
}

Status fmi2CompletedIntegratorStep(Handle c, fmi2Boolean no_way_back, fmi2Boolean *event,
                                   fmi2Boolean *terminate)
{
    (void)no_way_back;
    Instance *instance = c;
    instance->v[COMPLETED] += 1.0;
    *event = MODEL == STEPS && is_reached(instance);
    *terminate = MODEL == TIRED && instance->v[X] > instance->v[P];
    return fmi2OK;
}
#else
#define UNUSED(type)                                              \
    Status fmi3Get##type(Handle c, VALUES(fmi3##type))            \
    {                                                             \
        (void)c, (void)vr, (void)n, (void)values, (void)n_values; \
        return fmi3Error;                                         \
    }                                                             \
    Status fmi3Set##type(Handle c, VALUES(const fmi3##type))      \
    {                                                             \
        (void)c, (void)vr, (void)n, (void)values, (void)n_values; \
        return fmi3Error;                                         \
    }
UNUSED(Float32)
UNUSED(Int8)
UNUSED(UInt8)
UNUSED(Int16)
UNUSED(UInt16)
UNUSED(Int32)
UNUSED(UInt32)
UNUSED(Int64)
UNUSED(UInt64)
UNUSED(Boolean)
UNUSED(String)
Status fmi3GetBinary(Handle c, const fmi3ValueReference vr[], size_t n, size_t sizes[],
                     fmi3Binary values[], size_t n_values)
{
    (void)c, (void)vr, (void)n, (void)sizes, (void)values, (void)n_values;
    return fmi3Error;
}
Status fmi3SetBinary(Handle c, const fmi3ValueReference vr[], size_t n, const size_t sizes[],
                     const fmi3Binary values[], size_t n_values)
{
    (void)c, (void)vr, (void)n, (void)sizes, (void)values, (void)n_values;
    return fmi3Error;
}

Handle fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                    fmi3Boolean visible, fmi3Boolean logging,
                                    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment,
        (void)log;
    return calloc(1, sizeof(Instance));
}

Status fmi3EnterInitializationMode(Handle c, bool has_tolerance, double tolerance, double start,
                                   bool has_stop, double stop)
{
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    begin(c, start);
    return fmi3OK;
}

Status fmi3EnterConfigurationMode(Handle c)
{
    (void)c;
    return fmi3OK;
}
Status fmi3ExitConfigurationMode(Handle c)
{
    (void)c;
    return fmi3OK;
}
Status fmi3GetFloat64(Handle c, VALUES(double))
{
    (void)n_values;
    return get_values(c, vr, n, values);
}
Status fmi3SetFloat64(Handle c, VALUES(const double))
{
    (void)n_values;
    return set_values(c, vr, n, values);
}
Status fmi3GetContinuousStateDerivatives(Handle c, double dx[], size_t n)
{
    return get_derivatives(c, dx, n);
}
Status fmi3GetFMUState(Handle c, fmi3FMUState *state) { return get_state(c, state); }
Status fmi3SetFMUState(Handle c, fmi3FMUState state) { return set_state(c, state); }
Status fmi3FreeFMUState(Handle c, fmi3FMUState *state)
{
    (void)c;
    return free_state(state);
}

Status fmi3UpdateDiscreteStates(Handle c, bool *need_update, bool *terminate, bool *nominals,
                                bool *values, bool *has_next, double *next)
{
    Instance *instance = c;
    Answer found = update(instance);
    *need_update = found.need_update;
    *terminate = found.terminate;
    *values = found.values_changed;
    *nominals = found.nominals_changed;
    *has_next = instance->next > 0.0;
    *next = instance->next;
    return fmi3OK;
}

Status fmi3CompletedIntegratorStep(Handle c, bool no_way_back, bool *event, bool *terminate)
{
    (void)no_way_back;
    Instance *instance = c;
    instance->v[COMPLETED] += 1.0;
    *event = MODEL == STEPS && is_reached(instance);
    *terminate = MODEL == TIRED && instance->v[X] > instance->v[P];
    return fmi3OK;
}
#endif
