/* lag.h as FMI 2.0. A step that is discarded leaves the state spoiled: only a saved one helps. */
#include "fmi2Functions.h"
#include "lag.h"

typedef struct {
    Lag lag;
    Outcome last;
    const fmi2CallbackFunctions *functions;
} Instance;

static fmi2Status complain(Instance *instance, const char *text)
{
    instance->functions->logger(instance->functions->componentEnvironment, "lag", fmi2Error,
                                "error", text);
    return fmi2Error;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type kind, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible,
                              fmi2Boolean logging)
{
    (void)name, (void)kind, (void)guid, (void)resources, (void)visible, (void)logging;
    Instance *instance = calloc(1, sizeof(Instance));
    lag_reset(&instance->lag);
    instance->functions = functions;
    return instance;
}

void fmi2FreeInstance(fmi2Component c) { free(c); }
fmi2Status fmi2Reset(fmi2Component c)
{
    lag_reset(&((Instance *)c)->lag);
    return fmi2OK;
}
fmi2Status fmi2Terminate(fmi2Component c)
{
    (void)c;
    return fmi2OK;
}
fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    (void)c;
    return fmi2OK;
}
fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    lag_show(c);
    ((Instance *)c)->lag.mode = STEP;
    return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean tolerant, fmi2Real tolerance,
                               fmi2Real t, fmi2Boolean stops, fmi2Real stop)
{
    (void)tolerant, (void)tolerance, (void)stops, (void)stop;
    ((Instance *)c)->lag.t = t;
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                       const fmi2Real values[])
{
    for (size_t i = 0; i < n; ++i)
        lag_set(c, vr[i], values[i], 0);
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real values[])
{
    for (size_t i = 0; i < n; ++i)
        if (!lag_get(c, vr[i], &values[i]))
            return complain(c, "read after setting inputs without a step between");
    return fmi2OK;
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                       const fmi2Integer order[], const fmi2Real values[])
{
    if (n != 1 || vr[0] != U || order[0] != 1)
        return complain(c, "needed the first derivative of u, which alone is continuous");
    if (!lag_set_slope(c, values[0]))
        return complain(c, "slopes are too steep");
    return fmi2OK;
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknowns[],
                                        size_t n, const fmi2ValueReference knowns[], size_t m,
                                        const fmi2Real seed[], fmi2Real result[])
{
    if (n != 1 || m != 1 || unknowns[0] != Y || knowns[0] != U)
        return complain(c, "only y depends on an input");
    result[0] = seed[0];
    return fmi2OK;
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no_way_back)
{
    Instance *instance = c;
    double end = t + h;
    (void)no_way_back;
    instance->last = lag_outcome(&instance->lag, t, &end);
    switch (instance->last) {
    case FAILED: complain(c, "out of petrol"); return (fmi2Status)instance->lag.value[STATUS];
    case DISCARDED: instance->lag.value[X] = 1e6; return fmi2Discard;
    case ENDED: return fmi2Discard;
    default: lag_advance(&instance->lag, t, t + h); return fmi2OK;
    }
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value)
{
    *value = ((Instance *)c)->last == ENDED;
    return kind == fmi2Terminated ? fmi2OK : fmi2Discard;
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    if (*state == NULL)
        *state = malloc(sizeof(Instance));
    memcpy(*state, c, sizeof(Instance));
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state)
{
    memcpy(c, state, sizeof(Instance));
    return fmi2OK;
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    (void)c;
    free(*state);
    *state = NULL;
    return fmi2OK;
}

/* The lag has no variables of other types. */
#define NONE(name, type)                                                               \
    fmi2Status fmi2Set##name(fmi2Component c, const fmi2ValueReference vr[], size_t n, \
                             const type values[])                                      \
    {                                                                                  \
        (void)vr, (void)n, (void)values;                                               \
        return complain(c, "no variables of this type");                               \
    }                                                                                  \
    fmi2Status fmi2Get##name(fmi2Component c, const fmi2ValueReference vr[], size_t n, \
                             type values[])                                            \
    {                                                                                  \
        (void)vr, (void)n, (void)values;                                               \
        return complain(c, "no variables of this type");                               \
    }
NONE(Integer, fmi2Integer)
NONE(Boolean, fmi2Boolean)
NONE(String, fmi2String)
