/* An FMI 2 co-simulation FMU with inputs and outputs of all types: x' = u + n - x by Euler's method,
 * y = x + u, m = n + number of steps, c = not b. From the time AT on the function CALL returns
 * STATUS, and says so. */
#include "fmi2Functions.h"

#include <stdlib.h>
#include <string.h>

enum { U, X, Y, N, M, B, C };
enum { NEVER, SET_REAL, SET_INTEGER, SET_SLOPES, DO_STEP, GET_REAL, GET_BOOLEAN, SAVE, DERIVE };

typedef struct {
    double u, x, t;
    int n, b, steps;
    const fmi2CallbackFunctions *functions;
} Instance;

static fmi2Status judge(Instance *instance, int call)
{
    if (call != CALL || instance->t < AT - 1e-9)
        return fmi2OK;
    instance->functions->logger(instance->functions->componentEnvironment, "typed", STATUS, "call",
                                "call %d", call);
    return STATUS;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type kind, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible,
                              fmi2Boolean logging)
{
    (void)name, (void)kind, (void)guid, (void)resources, (void)visible, (void)logging;
    Instance *instance = calloc(1, sizeof(Instance));
    instance->functions = functions;
    instance->t = -1.0;
    return instance;
}
void fmi2FreeInstance(fmi2Component c) { free(c); }
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean a, fmi2Real b, fmi2Real t,
                               fmi2Boolean d, fmi2Real e)
{
    (void)c, (void)a, (void)b, (void)t, (void)d, (void)e;
    return fmi2OK;
}
#define ONLY_CALLED(name)              \
    fmi2Status fmi2##name(fmi2Component c) \
    {                                  \
        (void)c;                       \
        return fmi2OK;                 \
    }
ONLY_CALLED(EnterInitializationMode)
ONLY_CALLED(ExitInitializationMode)
ONLY_CALLED(Terminate)
ONLY_CALLED(Reset)

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                       const fmi2Real values[])
{
    (void)vr;
    for (size_t i = 0; i < n; ++i)
        ((Instance *)c)->u = values[i];
    return judge(c, SET_REAL);
}
fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                          const fmi2Integer values[])
{
    (void)vr;
    for (size_t i = 0; i < n; ++i)
        ((Instance *)c)->n = values[i];
    return judge(c, SET_INTEGER);
}
fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                          const fmi2Boolean values[])
{
    (void)vr;
    for (size_t i = 0; i < n; ++i)
        ((Instance *)c)->b = values[i];
    return fmi2OK;
}
fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                       const fmi2Integer order[], const fmi2Real values[])
{
    (void)vr, (void)n, (void)order, (void)values;
    return judge(c, SET_SLOPES);
}
fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real values[])
{
    const Instance *instance = c;
    for (size_t i = 0; i < n; ++i)
        values[i] = vr[i] == U   ? instance->u
                    : vr[i] == X ? instance->x
                                 : instance->x + instance->u;
    return judge(c, GET_REAL);
}
fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                          fmi2Integer values[])
{
    const Instance *instance = c;
    for (size_t i = 0; i < n; ++i)
        values[i] = vr[i] == N ? instance->n : instance->n + instance->steps;
    return fmi2OK;
}
fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                          fmi2Boolean values[])
{
    const Instance *instance = c;
    for (size_t i = 0; i < n; ++i)
        values[i] = vr[i] == B ? instance->b : !instance->b;
    return judge(c, GET_BOOLEAN);
}
fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknowns[],
                                        size_t n, const fmi2ValueReference knowns[], size_t m,
                                        const fmi2Real seed[], fmi2Real result[])
{
    (void)unknowns, (void)n, (void)knowns, (void)m;
    result[0] = seed[0];
    return judge(c, DERIVE);
}
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no_way_back)
{
    (void)no_way_back;
    Instance *instance = c;
    instance->t = t;
    instance->x += h * (instance->u + instance->n - instance->x);
    instance->steps++;
    return judge(c, DO_STEP);
}
fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    if (!*state)
        *state = malloc(sizeof(Instance));
    memcpy(*state, c, sizeof(Instance));
    return judge(c, SAVE);
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
fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}
fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}
/* Required, and never called here. */
fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                         fmi2String values[])
{
    (void)c, (void)vr, (void)n, (void)values;
    return fmi2Error;
}
fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                         const fmi2String values[])
{
    (void)c, (void)vr, (void)n, (void)values;
    return fmi2Error;
}
