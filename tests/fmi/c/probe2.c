/* An FMU of FMI 2 that shows what it was called with: x' = u, z = x - 1 (event indicator), y = x.
 *
 * answer (Integer 10): the status of the next fmi2Reset or fmi2DoStep. mirror (String 20) gives
 * back what was set. With SAYS it logs the begin of every step. */
#include "fmi2Functions.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifdef LACKS_RESET
#define fmi2Reset not_fmi2Reset
#endif
#ifdef LACKS_STATES
#define fmi2SetContinuousStates not_fmi2SetContinuousStates
#endif

enum { U, X, DER_X, Y, SLOPE, NO_WAY_BACK, REALS, ANSWER = 10, FLAG = 11, TEXT = 20 };

typedef struct {
    const fmi2CallbackFunctions *functions;
    double real[REALS], t, reached;
    int answer, flag;
    char text[100];
} Instance;

static void say(Instance *instance, fmi2Status status, const char *text)
{
    instance->functions->logger(instance->functions->componentEnvironment, "probe", status, "probe",
                                text);
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type kind, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible,
                              fmi2Boolean logging)
{
    (void)name, (void)kind, (void)resources, (void)visible, (void)logging;
    if (strcmp(guid, "probe") != 0) {
        functions->logger(functions->componentEnvironment, "probe", fmi2Error, "probe",
                          "wrong guid %s", guid);
        return NULL;
    }
    Instance *instance = functions->allocateMemory(1, sizeof(Instance));
    instance->functions = functions;
    return instance;
}

void fmi2FreeInstance(fmi2Component c)
{
    say(c, fmi2OK, "freed");
    ((Instance *)c)->functions->freeMemory(c);
}

fmi2Status fmi2Reset(fmi2Component c) { return (fmi2Status)((Instance *)c)->answer; }
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
    (void)c;
    return fmi2OK;
}
fmi2Status fmi2EnterEventMode(fmi2Component c)
{
    (void)c;
    return fmi2OK;
}
fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c)
{
    (void)c;
    return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean has_tolerance, fmi2Real tolerance,
                               fmi2Real start, fmi2Boolean has_stop, fmi2Real stop)
{
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    ((Instance *)c)->t = start;
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real values[])
{
    Instance *instance = c;
    instance->real[DER_X] = instance->real[U];
    instance->real[Y] = instance->real[X];
    for (size_t i = 0; i < n; ++i)
        values[i] = instance->real[vr[i]];
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                       const fmi2Real values[])
{
    for (size_t i = 0; i < n; ++i)
        ((Instance *)c)->real[vr[i]] = values[i];
    return fmi2OK;
}

fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                          fmi2Integer values[])
{
    (void)vr, (void)n;
    values[0] = ((Instance *)c)->answer;
    return fmi2OK;
}

fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                          const fmi2Integer values[])
{
    (void)vr, (void)n;
    ((Instance *)c)->answer = values[0];
    return fmi2OK;
}

fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                          fmi2Boolean values[])
{
    (void)vr, (void)n;
    values[0] = ((Instance *)c)->flag;
    return fmi2OK;
}

fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                          const fmi2Boolean values[])
{
    (void)vr, (void)n;
    ((Instance *)c)->flag = values[0];
    return fmi2OK;
}

fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                         fmi2String values[])
{
    (void)vr, (void)n;
    values[0] = ((Instance *)c)->text;
    return fmi2OK;
}

fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                         const fmi2String values[])
{
    (void)vr, (void)n;
    snprintf(((Instance *)c)->text, sizeof((Instance *)c)->text, "%s", values[0]);
    return fmi2OK;
}

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    if (*state == NULL) {
        say(c, fmi2OK, "allocated a state");
        *state = malloc(sizeof(Instance));
    }
    memcpy(*state, c, sizeof(Instance));
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state)
{
#ifdef LIES
    (void)c, (void)state;
#else
    memcpy(c, state, sizeof(Instance));
#endif
    return fmi2OK;
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    (void)c;
    free(*state);
    *state = NULL;
    return fmi2OK;
}

/* --- model exchange --- */

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real t)
{
    ((Instance *)c)->t = t;
    return fmi2OK;
}
fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t n)
{
    (void)n;
    ((Instance *)c)->real[X] = x[0];
    return fmi2OK;
}
fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t n)
{
    (void)n;
    x[0] = ((Instance *)c)->real[X];
    return fmi2OK;
}
fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real dx[], size_t n)
{
    (void)n;
    dx[0] = ((Instance *)c)->real[U];
    return fmi2OK;
}
fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real z[], size_t n)
{
    (void)n;
    z[0] = ((Instance *)c)->real[X] - 1.0;
    return fmi2OK;
}
fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x[], size_t n)
{
    (void)c, (void)n;
    x[0] = 7.0;
    return fmi2OK;
}

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info)
{
    Instance *instance = c;
    memset(info, 0, sizeof *info);
    info->valuesOfContinuousStatesChanged = instance->flag;
    info->nominalsOfContinuousStatesChanged = !instance->flag;
    info->nextEventTimeDefined = instance->flag;
    info->nextEventTime = instance->t + 0.5;
    return fmi2OK;
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean no_way_back, fmi2Boolean *event,
                                       fmi2Boolean *terminate)
{
    ((Instance *)c)->real[NO_WAY_BACK] = no_way_back;
    *event = ((Instance *)c)->flag;
    *terminate = fmi2False;
    return fmi2OK;
}

/* --- co-simulation --- */

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                       const fmi2Integer order[], const fmi2Real value[])
{
    (void)vr, (void)n;
    ((Instance *)c)->real[SLOPE] = order[0] * value[0];
    return fmi2OK;
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no_way_back)
{
    Instance *instance = c;
    double *real = instance->real;
    real[NO_WAY_BACK] = no_way_back;
#ifdef SAYS
    instance->functions->logger(instance->functions->componentEnvironment, "probe", fmi2OK, "step",
                                "%.17g", t);
#endif
    instance->reached = instance->answer == fmi2OK ? t + h : t + 0.25 * h;
    real[X] += real[U] * (instance->reached - t);
    return (fmi2Status)instance->answer;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value)
{
    *value = ((Instance *)c)->flag;
    return kind == fmi2Terminated ? fmi2OK : fmi2Discard;
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value)
{
    *value = ((Instance *)c)->reached;
    return kind == fmi2LastSuccessfulTime ? fmi2OK : fmi2Discard;
}
