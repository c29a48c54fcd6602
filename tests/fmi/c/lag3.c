/* lag.h as FMI 3.0. A step that is discarded leaves the state as it was. */
#include "fmi3Functions.h"
#include "lag.h"

typedef struct {
    Lag lag;
    int event_mode_used;
    fmi3LogMessageCallback log;
    fmi3IntermediateUpdateCallback update;
    fmi3InstanceEnvironment environment;
} Instance;

static fmi3Status complain(Instance *instance, const char *text)
{
    instance->log(instance->environment, fmi3Error, "error", text);
    return fmi3Error;
}

fmi3Instance
fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources,
                            fmi3Boolean visible, fmi3Boolean logging, fmi3Boolean event_mode_used,
                            fmi3Boolean early_return_allowed, const fmi3ValueReference required[],
                            size_t n, fmi3InstanceEnvironment environment,
                            fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging,
        (void)early_return_allowed, (void)required, (void)n;
    Instance *instance = calloc(1, sizeof(Instance));
    lag_reset(&instance->lag);
    instance->event_mode_used = event_mode_used;
    instance->log = log;
    instance->update = update;
    instance->environment = environment;
    return instance;
}

void fmi3FreeInstance(fmi3Instance c) { free(c); }
fmi3Status fmi3Reset(fmi3Instance c)
{
    lag_reset(&((Instance *)c)->lag);
    return fmi3OK;
}
fmi3Status fmi3Terminate(fmi3Instance c)
{
    (void)c;
    return fmi3OK;
}
fmi3Status fmi3EnterConfigurationMode(fmi3Instance c)
{
    (void)c;
    return fmi3OK;
}
fmi3Status fmi3ExitConfigurationMode(fmi3Instance c)
{
    (void)c;
    return fmi3OK;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean tolerant, fmi3Float64 tolerance,
                                       fmi3Float64 t, fmi3Boolean stops, fmi3Float64 stop)
{
    (void)tolerant, (void)tolerance, (void)stops, (void)stop;
    ((Instance *)c)->lag.t = t;
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance c)
{
    lag_show(c);
    ((Instance *)c)->lag.mode = ((Instance *)c)->event_mode_used ? EVENT_MODE : STEP;
    ((Instance *)c)->lag.due = ((Instance *)c)->lag.value[ANNOUNCES] == 2.0;
    return fmi3OK;
}

fmi3Status fmi3EnterEventMode(fmi3Instance c)
{
    Instance *instance = c;
    if (!instance->event_mode_used || instance->lag.mode != STEP)
        return complain(c, "no event mode here");
    instance->lag.mode = EVENT_MODE;
    return fmi3OK;
}

fmi3Status fmi3EnterStepMode(fmi3Instance c)
{
    if (((Instance *)c)->lag.mode != EVENT_MODE)
        return complain(c, "not in event mode");
    lag_show(c);
    ((Instance *)c)->lag.mode = STEP;
    return fmi3OK;
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *need_update,
                                    fmi3Boolean *terminate, fmi3Boolean *nominals,
                                    fmi3Boolean *values, fmi3Boolean *has_time, fmi3Float64 *time)
{
    Lag *lag = c;
    double period = lag->value[EVENT];
    if (lag->due > 0.0) {
        lag->value[X] += 1.0;
        lag->due = 0.0;
    }
    lag->iteration += 1.0;
    *need_update = lag->iteration < lag->value[ITERATIONS];
    lag->iteration = *need_update ? lag->iteration : 0.0;
    *terminate = lag->value[STATUS] == -1.0 &&
                 lag->t > lag->value[END] - 1e-9; /* the wish to end, in an event */
    *nominals = *values = 0;
    *has_time = period > 0.0 && lag->value[ANNOUNCES] > 0.0;
    *time = *has_time ? lag_next(period, lag->t) : 0.0;
    return fmi3OK;
}

fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                          const fmi3Float64 values[], size_t m)
{
    (void)m;
    for (size_t i = 0; i < n; ++i)
        if (!lag_set(c, vr[i], values[i], ((Instance *)c)->event_mode_used))
            return complain(c, "a discrete input was set outside event mode");
    return fmi3OK;
}

fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                          fmi3Float64 values[], size_t m)
{
    (void)m;
    for (size_t i = 0; i < n; ++i)
        if (!lag_get(c, vr[i], &values[i]))
            return complain(c, "read after setting inputs without a step between");
    return fmi3OK;
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference unknowns[],
                                        size_t n, const fmi3ValueReference knowns[], size_t m,
                                        const fmi3Float64 seed[], size_t k, fmi3Float64 result[],
                                        size_t l)
{
    if (n != 1 || m != 1 || k != 1 || l != 1 || unknowns[0] != Y || knowns[0] != U)
        return complain(c, "only y depends on an input");
    result[0] = seed[0];
    return fmi3OK;
}

/* Ask for the inputs at t. */
static double ask(Instance *instance, double t)
{
    fmi3Boolean early;
    fmi3Float64 when;
    if (instance->update != NULL)
        instance->update(instance->environment, t, 1, 0, 0, 0, &early, &when);
    return instance->lag.value[U];
}

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean no_way_back,
                      fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early,
                      fmi3Float64 *reached)
{
    Instance *instance = c;
    Lag *lag = &instance->lag;
    double end = t + h;
    (void)no_way_back;
    Outcome outcome = lag_outcome(lag, t, &end);
    *terminate = outcome == ENDED;
    *event = outcome == MET_EVENT;
    *early = end < t + h - 1e-9 || outcome == ENDED;
    *reached = outcome == ENDED ? t : end;
    if (outcome == FAILED) {
        complain(c, "out of petrol");
        return (fmi3Status)lag->value[STATUS];
    }
    if (outcome == DISCARDED || outcome == ENDED)
        return outcome == DISCARDED ? fmi3Discard : fmi3OK;
    double u = lag->value[ASKS] > 0.0 ? ask(instance, t) : lag->value[U];
    lag->slope = lag->value[ASKS] > 1.0 ? (ask(instance, end) - u) / (end - t) : 0.0;
    lag->value[U] = u;
    lag_advance(lag, t, end);
    *terminate = lag->value[STATUS] < -1.0 &&
                 end > lag->value[END] - 1e-9; /* the wish to end, after the step */
    return fmi3OK;
}

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state)
{
    if (*state == NULL)
        *state = malloc(sizeof(Instance));
    memcpy(*state, c, sizeof(Instance));
    return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state)
{
    memcpy(c, state, sizeof(Instance));
    return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *state)
{
    (void)c;
    free(*state);
    *state = NULL;
    return fmi3OK;
}

/* The lag has no variables of other types. */
#define NONE(name)                                                                    \
    fmi3Status fmi3Set##name(fmi3Instance c, const fmi3ValueReference vr[], size_t n, \
                             const fmi3##name values[], size_t m)                     \
    {                                                                                 \
        (void)vr, (void)n, (void)values, (void)m;                                     \
        return complain(c, "no variables of this type");                              \
    }                                                                                 \
    fmi3Status fmi3Get##name(fmi3Instance c, const fmi3ValueReference vr[], size_t n, \
                             fmi3##name values[], size_t m)                           \
    {                                                                                 \
        (void)vr, (void)n, (void)values, (void)m;                                     \
        return complain(c, "no variables of this type");                              \
    }
NONE(Float32)
NONE(Int8)
NONE(UInt8)
NONE(Int16)
NONE(UInt16)
NONE(Int32)
NONE(UInt32)
NONE(Int64)
NONE(UInt64)
NONE(Boolean)
NONE(String)

fmi3Status fmi3SetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                         const size_t sizes[], const fmi3Binary values[], size_t m)
{
    (void)vr, (void)n, (void)sizes, (void)values, (void)m;
    return complain(c, "no variables of this type");
}

fmi3Status fmi3GetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t n, size_t sizes[],
                         fmi3Binary values[], size_t m)
{
    (void)vr, (void)n, (void)sizes, (void)values, (void)m;
    return complain(c, "no variables of this type");
}
