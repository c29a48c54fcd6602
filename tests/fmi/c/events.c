/* Model exchange FMUs with events, for FMI 2 and FMI 3 (-DFMI=2, 3), one per -DMODEL.
 *
 * BALL     x' = v, v' = -9.81 from x = 1; at the ground v -> -0.7 v, x -> 0+; below the speed p it rests
 * FRICTION v' = u - q p while it slips (q = -1, 1), v = 0 while it sticks (q = 0): Coulomb friction, force u, level p
 * SAW      x' = 1, and x -> 0 at the times k p; count of them
 * COUNTER  no states; count of the times k p, which are announced by adding p to the last one
 * TWO      x' = 1; indicators x - 0.53, x - 0.51, x - 0.53; q: number of the indicators that events saw positive, v: time at which it grew
 * SLIDE    x' = -1 above x = p, 1 below: a relay without hysteresis, which chatters
 * ENDLESS  x' = 1; above x = p discrete states always need an update
 * ENDS     x' = 1; asks for the end above x = p, and refuses to let time move after that
 * MEMORY   x' = q; q counts the changes of the discrete input d
 * SWITCH   x' = u - x below x = p, u - 4 x above */
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
enum { U, D, X, V, DER_X, DER_V, Q, COUNT, P, EVALUATIONS, COMPLETED, VARIABLES };

typedef struct {
    double t, next, last, v[VARIABLES];
    bool ended;
} Unit;

typedef struct {
    bool need_update, terminate, values_changed;
} Answer;

static void begin(Unit *unit, double t)
{
    unit->t = t;
    unit->next = MODEL == SAW || MODEL == COUNTER ? unit->v[P] : 0.0;
    unit->v[Q] = MODEL == FRICTION || MODEL == TWO || MODEL == MEMORY ? 0.0 : 1.0;
    if (MODEL == BALL)
        unit->v[X] = 1.0;
}

static void derive(Unit *unit)
{
    double *v = unit->v;
    v[DER_V] = MODEL == BALL ? -9.81 * v[Q] : MODEL == FRICTION && v[Q] != 0.0 ? v[U] - v[Q] * v[P] : 0.0;
    v[DER_X] = MODEL == BALL || MODEL == FRICTION ? v[V] : MODEL == SLIDE || MODEL == MEMORY ? v[Q] : 1.0;
    if (MODEL == SWITCH)
        v[DER_X] = v[U] - (v[Q] > 0.0 ? 1.0 : 4.0) * v[X];
}

static void indicate(const Unit *unit, double z[])
{
    const double *v = unit->v;
    z[0] = MODEL == BALL ? v[X] : v[X] - v[P];
    if (MODEL == FRICTION) {
        z[0] = v[Q] == 0.0 ? v[U] - v[P] : v[Q] * v[V] + DBL_MIN;
        z[1] = v[Q] == 0.0 ? v[U] + v[P] : 1.0;
    } else if (MODEL == TWO) {
        z[0] = z[2] = v[X] - 0.53;
        z[1] = v[X] - 0.51;
    }
}

static bool tick(Unit *unit)
{
    if (unit->next == 0.0 || unit->t < unit->next)
        return false;
    unit->v[COUNT] += 1.0;
    unit->next = MODEL == COUNTER ? unit->next + unit->v[P] : (unit->v[COUNT] + 1.0) * unit->v[P];
    return true;
}

static Answer update(Unit *unit)
{
    Answer found = {false, false, false};
    double *v = unit->v, z[3];
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
    } else if (MODEL == SAW && tick(unit)) {
        v[X] = 0.0;
        found.values_changed = true;
    } else if (MODEL == COUNTER) {
        tick(unit);
    } else if (MODEL == TWO) {
        indicate(unit, z);
        double positive = (z[0] > 0.0) + (z[1] > 0.0) + (z[2] > 0.0);
        v[V] = positive > v[Q] ? unit->t : v[V];
        v[Q] = positive;
    } else if (MODEL == SLIDE) {
        v[Q] = v[X] > v[P] ? -1.0 : 1.0;
    } else if (MODEL == ENDLESS) {
        found.need_update = v[X] > v[P];
    } else if (MODEL == ENDS) {
        found.terminate = unit->ended = v[X] > v[P];
    } else if (MODEL == MEMORY) {
        v[Q] += v[D] != unit->last;
        unit->last = v[D];
    } else if (MODEL == SWITCH) {
        v[Q] = v[X] > v[P] ? -1.0 : 1.0;
    }
    return found;
}

/* --- the calls that both versions have --- */

typedef F(Component) Instance;
typedef F(Status) Status;

void F(FreeInstance)(Instance c) { free(c); }
Status F(Reset)(Instance c) { memset(c, 0, sizeof(Unit)); return F(OK); }
Status F(Terminate)(Instance c) { (void)c; return F(OK); }
Status F(ExitInitializationMode)(Instance c) { ((Unit *)c)->last = ((Unit *)c)->v[D]; return F(OK); }
Status F(EnterContinuousTimeMode)(Instance c) { return ((Unit *)c)->ended ? F(Error) : F(OK); }
Status F(SetTime)(Instance c, double t) { ((Unit *)c)->t = t; return F(OK); }
Status F(EnterEventMode)(Instance c) { (void)c; return F(OK); }
Status F(SetContinuousStates)(Instance c, const double x[], size_t n) { memcpy(((Unit *)c)->v + X, x, n * sizeof *x); return F(OK); }
Status F(GetContinuousStates)(Instance c, double x[], size_t n) { memcpy(x, ((Unit *)c)->v + X, n * sizeof *x); return F(OK); }
Status F(GetEventIndicators)(Instance c, double z[], size_t n) { (void)n; indicate(c, z); return F(OK); }

static Status get_derivatives(Instance c, double dx[], size_t n)
{
    derive(c);
    ((Unit *)c)->v[EVALUATIONS] += 1.0;
    memcpy(dx, ((Unit *)c)->v + DER_X, n * sizeof *dx);
    return F(OK);
}

Status F(GetNominalsOfContinuousStates)(Instance c, double nominals[], size_t n)
{
    (void)c;
    for (size_t i = 0; i < n; ++i)
        nominals[i] = NOMINAL;
    return F(OK);
}

static Status get_values(Unit *unit, const unsigned vr[], size_t n, double values[])
{
    derive(unit);
    for (size_t i = 0; i < n; ++i)
        values[i] = unit->v[vr[i]];
    return F(OK);
}

static Status set_values(Unit *unit, const unsigned vr[], size_t n, const double values[])
{
    for (size_t i = 0; i < n; ++i)
        unit->v[vr[i]] = values[i];
    return F(OK);
}

static Status get_state(Instance c, void **state)
{
    if (*state == NULL)
        *state = malloc(sizeof(Unit));
    memcpy(*state, c, sizeof(Unit));
    return F(OK);
}

static Status set_state(Instance c, void *state)
{
    double evaluations = ((Unit *)c)->v[EVALUATIONS];
    memcpy(c, state, sizeof(Unit));
    ((Unit *)c)->v[EVALUATIONS] = evaluations;
    return F(OK);
}

static Status free_state(void **state) { free(*state); *state = NULL; return F(OK); }

/* --- where they differ --- */

#if FMI == 2
#define UNUSED(Get, type) Status Get(Instance c, VALUES(type)) { (void)c, (void)vr, (void)n, (void)values; return F(Error); }
UNUSED(fmi2GetInteger, fmi2Integer) UNUSED(fmi2SetInteger, const fmi2Integer) UNUSED(fmi2GetBoolean, fmi2Boolean)
UNUSED(fmi2SetBoolean, const fmi2Boolean) UNUSED(fmi2GetString, fmi2String) UNUSED(fmi2SetString, const fmi2String)

Instance fmi2Instantiate(fmi2String name, fmi2Type kind, fmi2String guid, fmi2String resources, const fmi2CallbackFunctions *functions,
                         fmi2Boolean visible, fmi2Boolean logging)
{
    (void)name, (void)kind, (void)guid, (void)resources, (void)functions, (void)visible, (void)logging;
    return calloc(1, sizeof(Unit));
}

Status fmi2SetupExperiment(Instance c, fmi2Boolean has_tolerance, double tolerance, double start, fmi2Boolean has_stop, double stop)
{
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    ((Unit *)c)->t = start;
    return fmi2OK;
}

Status fmi2EnterInitializationMode(Instance c) { begin(c, ((Unit *)c)->t); return fmi2OK; }
Status fmi2GetReal(Instance c, VALUES(double)) { return get_values(c, vr, n, values); }
Status fmi2SetReal(Instance c, VALUES(const double)) { return set_values(c, vr, n, values); }
Status fmi2GetDerivatives(Instance c, double dx[], size_t n) { return get_derivatives(c, dx, n); }
Status fmi2GetFMUstate(Instance c, fmi2FMUstate *state) { return get_state(c, state); }
Status fmi2SetFMUstate(Instance c, fmi2FMUstate state) { return set_state(c, state); }
Status fmi2FreeFMUstate(Instance c, fmi2FMUstate *state) { (void)c; return free_state(state); }

Status fmi2NewDiscreteStates(Instance c, fmi2EventInfo *info)
{
    Unit *unit = c;
    Answer found = update(unit);
    info->newDiscreteStatesNeeded = found.need_update;
    info->terminateSimulation = found.terminate;
    info->valuesOfContinuousStatesChanged = found.values_changed;
    info->nominalsOfContinuousStatesChanged = fmi2False;
    info->nextEventTimeDefined = unit->next > 0.0;
    info->nextEventTime = unit->next;
    return fmi2OK;
}

Status fmi2CompletedIntegratorStep(Instance c, fmi2Boolean no_way_back, fmi2Boolean *event, fmi2Boolean *terminate)
{
    (void)no_way_back;
    ((Unit *)c)->v[COMPLETED] += 1.0;
    *event = *terminate = fmi2False;
    return fmi2OK;
}
#else
#define UNUSED(type)                                                                                                                   \
    Status fmi3Get##type(Instance c, VALUES(fmi3##type)) { (void)c, (void)vr, (void)n, (void)values, (void)n_values; return fmi3Error; } \
    Status fmi3Set##type(Instance c, VALUES(const fmi3##type)) { (void)c, (void)vr, (void)n, (void)values, (void)n_values; return fmi3Error; }
UNUSED(Float32) UNUSED(Int8) UNUSED(UInt8) UNUSED(Int16) UNUSED(UInt16) UNUSED(Int32) UNUSED(UInt32) UNUSED(Int64) UNUSED(UInt64)
UNUSED(Boolean) UNUSED(String)
Status fmi3GetBinary(Instance c, const fmi3ValueReference vr[], size_t n, size_t sizes[], fmi3Binary values[], size_t n_values)
{
    (void)c, (void)vr, (void)n, (void)sizes, (void)values, (void)n_values;
    return fmi3Error;
}
Status fmi3SetBinary(Instance c, const fmi3ValueReference vr[], size_t n, const size_t sizes[], const fmi3Binary values[], size_t n_values)
{
    (void)c, (void)vr, (void)n, (void)sizes, (void)values, (void)n_values;
    return fmi3Error;
}

Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging,
                                      fmi3InstanceEnvironment environment, fmi3LogMessageCallback log)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment, (void)log;
    return calloc(1, sizeof(Unit));
}

Status fmi3EnterInitializationMode(Instance c, bool has_tolerance, double tolerance, double start, bool has_stop, double stop)
{
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    begin(c, start);
    return fmi3OK;
}

Status fmi3EnterConfigurationMode(Instance c) { (void)c; return fmi3OK; }
Status fmi3ExitConfigurationMode(Instance c) { (void)c; return fmi3OK; }
Status fmi3GetFloat64(Instance c, VALUES(double)) { (void)n_values; return get_values(c, vr, n, values); }
Status fmi3SetFloat64(Instance c, VALUES(const double)) { (void)n_values; return set_values(c, vr, n, values); }
Status fmi3GetContinuousStateDerivatives(Instance c, double dx[], size_t n) { return get_derivatives(c, dx, n); }
Status fmi3GetFMUState(Instance c, fmi3FMUState *state) { return get_state(c, state); }
Status fmi3SetFMUState(Instance c, fmi3FMUState state) { return set_state(c, state); }
Status fmi3FreeFMUState(Instance c, fmi3FMUState *state) { (void)c; return free_state(state); }

Status fmi3UpdateDiscreteStates(Instance c, bool *need_update, bool *terminate, bool *nominals, bool *values, bool *has_next, double *next)
{
    Unit *unit = c;
    Answer found = update(unit);
    *need_update = found.need_update;
    *terminate = found.terminate;
    *values = found.values_changed;
    *nominals = false;
    *has_next = unit->next > 0.0;
    *next = unit->next;
    return fmi3OK;
}

Status fmi3CompletedIntegratorStep(Instance c, bool no_way_back, bool *event, bool *terminate)
{
    (void)no_way_back;
    ((Unit *)c)->v[COMPLETED] += 1.0;
    *event = *terminate = false;
    return fmi3OK;
}
#endif
