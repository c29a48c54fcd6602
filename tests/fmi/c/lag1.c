/* lag.h as FMI 1.0, co-simulation alone: no initialization mode, no saved states, no directional
 * derivatives. */
#define FUNCTION(name) model_fmi##name
#include <stddef.h>

#include "fmi1Functions.h"
#include "lag.h"

typedef struct {
    Lag lag;
    fmi1CallbackFunctions functions;
} Instance;

static fmi1Status complain(Instance *instance, const char *text)
{
    instance->functions.logger(instance, "lag", fmi1Error, "error", text);
    return fmi1Error;
}

fmi1Component FUNCTION(InstantiateSlave)(fmi1String name, fmi1String guid, fmi1String location,
                                         fmi1String mime, fmi1Real timeout, fmi1Boolean visible,
                                         fmi1Boolean interactive, fmi1CallbackFunctions functions,
                                         fmi1Boolean logging)
{
    (void)name, (void)guid, (void)location, (void)mime, (void)timeout, (void)visible,
        (void)interactive, (void)logging;
    Instance *instance = calloc(1, sizeof(Instance));
    lag_reset(&instance->lag);
    instance->functions = functions;
    return instance;
}

void FUNCTION(FreeSlaveInstance)(fmi1Component c) { free(c); }
fmi1Status FUNCTION(TerminateSlave)(fmi1Component c)
{
    (void)c;
    return fmi1OK;
}
/* Like those of many tools: it was never tried. */
fmi1Status FUNCTION(ResetSlave)(fmi1Component c)
{
    memset(&((Instance *)c)->lag, 0, sizeof(Lag));
    return fmi1OK;
}

fmi1Status FUNCTION(InitializeSlave)(fmi1Component c, fmi1Real t, fmi1Boolean stops, fmi1Real stop)
{
    (void)stops, (void)stop;
    Lag *lag = &((Instance *)c)->lag;
    lag->t = t;
    lag_show(lag);
    lag->mode = STEP;
    return fmi1OK;
}

fmi1Status FUNCTION(SetReal)(fmi1Component c, const fmi1ValueReference vr[], size_t n,
                             const fmi1Real values[])
{
    for (size_t i = 0; i < n; ++i)
        lag_set(c, vr[i], values[i], 0);
    return fmi1OK;
}

fmi1Status FUNCTION(GetReal)(fmi1Component c, const fmi1ValueReference vr[], size_t n,
                             fmi1Real values[])
{
    for (size_t i = 0; i < n; ++i)
        if (((Instance *)c)->lag.mode == START || !lag_get(c, vr[i], &values[i]))
            return complain(
                c,
                "read before the initialization, or after setting inputs without a step between");
    return fmi1OK;
}

fmi1Status FUNCTION(SetRealInputDerivatives)(fmi1Component c, const fmi1ValueReference vr[],
                                             size_t n, const fmi1Integer order[],
                                             const fmi1Real values[])
{
    if (n != 1 || vr[0] != U || order[0] != 1)
        return complain(c, "needed the first derivative of u, which alone is continuous");
    if (!lag_set_slope(c, values[0]))
        return complain(c, "slopes are too steep");
    return fmi1OK;
}

fmi1Status FUNCTION(DoStep)(fmi1Component c, fmi1Real t, fmi1Real h, fmi1Boolean fresh)
{
    Lag *lag = &((Instance *)c)->lag;
    double end = t + h;
    (void)fresh;
    switch (lag_outcome(lag, t, &end)) {
    case FAILED: complain(c, "out of petrol"); return (fmi1Status)lag->value[STATUS];
    case DISCARDED: return fmi1Discard;
    default: lag_advance(lag, t, t + h); return fmi1OK;
    }
}

fmi1Status FUNCTION(GetRealStatus)(fmi1Component c, const fmi1StatusKind kind, fmi1Real *value)
{
    (void)c, (void)kind, (void)value;
    return fmi1Discard;
}

/* The lag has no variables of other types. */
#define NONE(name, type)                                                                     \
    fmi1Status FUNCTION(Set##name)(fmi1Component c, const fmi1ValueReference vr[], size_t n, \
                                   const type values[])                                      \
    {                                                                                        \
        (void)vr, (void)n, (void)values;                                                     \
        return complain(c, "no variables of this type");                                     \
    }                                                                                        \
    fmi1Status FUNCTION(Get##name)(fmi1Component c, const fmi1ValueReference vr[], size_t n, \
                                   type values[])                                            \
    {                                                                                        \
        (void)vr, (void)n, (void)values;                                                     \
        return complain(c, "no variables of this type");                                     \
    }
NONE(Integer, fmi1Integer)
NONE(Boolean, fmi1Boolean)
NONE(String, fmi1String)
