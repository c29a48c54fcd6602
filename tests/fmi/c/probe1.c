/* An FMU of FMI 1.0, both kinds: x' = u, y = 2 x + u, event indicator x - 1. At the initialization
 * x = x0 + u.
 *
 * behavior (Integer 10): 1 the step is discarded after a quarter, 2 a time event is announced at
 * the start; count (Integer 11): the instances before this one. */
#define FUNCTION(name) model_fmi##name
#include <stddef.h>

#include "fmi1Functions.h"

#include <string.h>

enum { U, X0, X, DER_X, Y, SLOPE, REALS, BEHAVIOR = 10, COUNT = 11, FLAG = 12, TEXT = 13 };

typedef struct {
    fmi1CallbackFunctions functions;
    double real[REALS], t, reached;
    int behavior, count, initialized;
    char flag, text[100];
} Instance;

static int count = 0;

static Instance *create(fmi1String guid, fmi1CallbackFunctions functions)
{
    functions.logger(NULL, "probe", fmi1OK, "probe", "hello %s", "world");
    if (strcmp(guid, "probe") != 0)
        return NULL;
    Instance *instance = functions.allocateMemory(1, sizeof(Instance));
    instance->functions = functions;
    instance->count = count++;
    return instance;
}

static fmi1Status initialize(Instance *instance)
{
    if (instance->initialized)
        return fmi1Error;
    instance->initialized = 1;
    instance->real[X] = instance->real[X0] + instance->real[U];
    instance->functions.logger(instance, "probe", fmi1OK, "probe", "x = %g", instance->real[X]);
    return fmi1OK;
}

static void destroy(Instance *instance) { instance->functions.freeMemory(instance); }

fmi1Status FUNCTION(GetReal)(fmi1Component c, const fmi1ValueReference vr[], size_t n,
                             fmi1Real values[])
{
    Instance *instance = c;
    if (!instance->initialized)
        return fmi1Error;
    instance->real[DER_X] = instance->real[U];
    instance->real[Y] = 2.0 * instance->real[X] + instance->real[U];
    for (size_t i = 0; i < n; ++i)
        values[i] = instance->real[vr[i]];
    return fmi1OK;
}

fmi1Status FUNCTION(SetReal)(fmi1Component c, const fmi1ValueReference vr[], size_t n,
                             const fmi1Real values[])
{
    for (size_t i = 0; i < n; ++i)
        ((Instance *)c)->real[vr[i]] = values[i];
    return fmi1OK;
}

fmi1Status FUNCTION(GetInteger)(fmi1Component c, const fmi1ValueReference vr[], size_t n,
                                fmi1Integer values[])
{
    for (size_t i = 0; i < n; ++i)
        values[i] = vr[i] == COUNT ? ((Instance *)c)->count : ((Instance *)c)->behavior;
    return fmi1OK;
}

fmi1Status FUNCTION(SetInteger)(fmi1Component c, const fmi1ValueReference vr[], size_t n,
                                const fmi1Integer values[])
{
    (void)vr, (void)n;
    ((Instance *)c)->behavior = values[0];
    return fmi1OK;
}

fmi1Status FUNCTION(GetBoolean)(fmi1Component c, const fmi1ValueReference vr[], size_t n,
                                fmi1Boolean values[])
{
    (void)vr;
    for (size_t i = 0; i < n; ++i)
        values[i] = ((Instance *)c)->flag;
    return fmi1OK;
}

fmi1Status FUNCTION(SetBoolean)(fmi1Component c, const fmi1ValueReference vr[], size_t n,
                                const fmi1Boolean values[])
{
    (void)vr, (void)n;
    ((Instance *)c)->flag = values[0];
    return fmi1OK;
}

fmi1Status FUNCTION(GetString)(fmi1Component c, const fmi1ValueReference vr[], size_t n,
                               fmi1String values[])
{
    (void)vr, (void)n;
    values[0] = ((Instance *)c)->text;
    return fmi1OK;
}

fmi1Status FUNCTION(SetString)(fmi1Component c, const fmi1ValueReference vr[], size_t n,
                               const fmi1String values[])
{
    (void)vr, (void)n;
    strncpy(((Instance *)c)->text, values[0], 99);
    return fmi1OK;
}

/* --- model exchange --- */

fmi1Component FUNCTION(InstantiateModel)(fmi1String name, fmi1String guid,
                                         fmi1CallbackFunctions functions, fmi1Boolean logging)
{
    (void)name;
    return logging ? NULL : create(guid, functions);
}

void FUNCTION(FreeModelInstance)(fmi1Component c) { destroy(c); }
fmi1Status FUNCTION(Terminate)(fmi1Component c)
{
    (void)c;
    return fmi1OK;
}
fmi1Status FUNCTION(SetTime)(fmi1Component c, fmi1Real t)
{
    ((Instance *)c)->t = t;
    return fmi1OK;
}
fmi1Status FUNCTION(SetContinuousStates)(fmi1Component c, const fmi1Real x[], size_t n)
{
    (void)n;
    ((Instance *)c)->real[X] = x[0];
    return fmi1OK;
}
fmi1Status FUNCTION(GetContinuousStates)(fmi1Component c, fmi1Real x[], size_t n)
{
    (void)n;
    x[0] = ((Instance *)c)->real[X];
    return fmi1OK;
}
fmi1Status FUNCTION(GetNominalContinuousStates)(fmi1Component c, fmi1Real x[], size_t n)
{
    (void)c, (void)n;
    x[0] = 7.0;
    return fmi1OK;
}
fmi1Status FUNCTION(GetDerivatives)(fmi1Component c, fmi1Real dx[], size_t n)
{
    (void)n;
    dx[0] = ((Instance *)c)->real[U];
    return fmi1OK;
}
fmi1Status FUNCTION(GetEventIndicators)(fmi1Component c, fmi1Real z[], size_t n)
{
    (void)n;
    z[0] = ((Instance *)c)->real[X] - 1.0;
    return fmi1OK;
}

fmi1Status FUNCTION(CompletedIntegratorStep)(fmi1Component c, fmi1Boolean *event)
{
    *event = ((Instance *)c)->flag;
    return fmi1OK;
}

fmi1Status FUNCTION(Initialize)(fmi1Component c, fmi1Boolean has_tolerance, fmi1Real tolerance,
                                fmi1EventInfo *info)
{
    Instance *instance = c;
    (void)has_tolerance, (void)tolerance;
    memset(info, 0, sizeof *info);
    info->iterationConverged = fmi1True;
    info->upcomingTimeEvent = instance->behavior == 2;
    info->nextEventTime = instance->t + 1.0;
    return initialize(instance);
}

fmi1Status FUNCTION(EventUpdate)(fmi1Component c, fmi1Boolean intermediate, fmi1EventInfo *info)
{
    (void)c, (void)intermediate;
    memset(info, 0, sizeof *info);
    info->iterationConverged = info->stateValuesChanged = fmi1True;
    return fmi1OK;
}

/* --- co-simulation --- */

fmi1Component FUNCTION(InstantiateSlave)(fmi1String name, fmi1String guid, fmi1String location,
                                         fmi1String mime, fmi1Real timeout, fmi1Boolean visible,
                                         fmi1Boolean interactive, fmi1CallbackFunctions functions,
                                         fmi1Boolean logging)
{
    (void)name, (void)mime, (void)timeout;
    return visible || interactive || logging || strncmp(location, "file:///", 8)
               ? NULL
               : create(guid, functions);
}

void FUNCTION(FreeSlaveInstance)(fmi1Component c) { destroy(c); }
fmi1Status FUNCTION(TerminateSlave)(fmi1Component c)
{
    (void)c;
    return fmi1OK;
}

fmi1Status FUNCTION(ResetSlave)(fmi1Component c)
{
    (void)c;
    abort(); /* no master needs it */
}

fmi1Status FUNCTION(InitializeSlave)(fmi1Component c, fmi1Real t, fmi1Boolean has_stop,
                                     fmi1Real stop)
{
    (void)has_stop, (void)stop;
    ((Instance *)c)->t = t;
    return initialize(c);
}

fmi1Status FUNCTION(SetRealInputDerivatives)(fmi1Component c, const fmi1ValueReference vr[],
                                             size_t n, const fmi1Integer order[],
                                             const fmi1Real value[])
{
    (void)vr, (void)n;
    ((Instance *)c)->real[SLOPE] = order[0] * value[0];
    return fmi1OK;
}

fmi1Status FUNCTION(DoStep)(fmi1Component c, fmi1Real t, fmi1Real h, fmi1Boolean fresh)
{
    Instance *instance = c;
    if (!fresh)
        return fmi1Error;
    if (instance->behavior == 1)
        h *= 0.25;
    instance->reached = t + h;
    instance->real[X] += h * (instance->real[U] + 0.5 * h * instance->real[SLOPE]);
    return instance->behavior == 1 ? fmi1Discard : fmi1OK;
}

fmi1Status FUNCTION(GetRealStatus)(fmi1Component c, const fmi1StatusKind kind, fmi1Real *value)
{
    *value = ((Instance *)c)->reached;
    return kind == fmi1LastSuccessfulTime ? fmi1OK : fmi1Discard;
}
