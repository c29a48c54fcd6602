/* Small systems as FMI 2.0 co-simulation, to be coupled with each other.
 *
 * KIND 0: x' = A x + B u, y = C x + D u, with an inner step that is exact for inputs on a line.
 * KIND 1: y and z with u + y + z = 0, 2 u - 3 y + 2 z = 9.
 * KIND 2: y with y^2 + u^2 + v^2 = 5, y > 0.
 * KIND 3: y = 1, and 5 from the step on that ends behind 0.45 s.
 * SAYS 1: a message in every step. With COUNTS, KIND 0 has in y how many instances there were in
 * this process before, which the binary knows and not the instance. With FORGETS all values are 0
 * when the experiment is set up; with NUMBER=float it keeps them in single precision. */
#include "fmi2Functions.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#ifndef NUMBER
#define NUMBER double
#endif

enum { U, V, X, Y, Z, A, B, C, D, KIND, SAYS, VALUES };

typedef struct {
    double value[VALUES], slope, end;
    const fmi2CallbackFunctions *functions;
    int steps; /* in initialization outputs follow inputs at once, later only in steps */
} Instance;

static int instances = 0;

static void show(Instance *instance)
{
    double *p = instance->value;
    switch ((int)p[KIND]) {
    case 0:
        p[Y] = p[C] * p[X] + p[D] * p[U];
#ifdef COUNTS
        p[Y] += instances - 1;
#endif
        break;
    case 1:
        p[Y] = -9.0 / 5.0;
        p[Z] = 9.0 / 5.0 - p[U];
        break;
    case 2: p[Y] = sqrt(5.0 - p[U] * p[U] - p[V] * p[V]); break;
    default: p[Y] = instance->end > 0.45 ? 5.0 : 1.0;
    }
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type kind, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible,
                              fmi2Boolean logging)
{
    (void)name, (void)kind, (void)guid, (void)resources, (void)visible, (void)logging;
    Instance *instance = calloc(1, sizeof(Instance));
    instance->functions = functions;
    ++instances;
    return instance;
}

void fmi2FreeInstance(fmi2Component c) { free(c); }

#define NOTHING(name)                            \
    fmi2Status fmi2##name(fmi2Component c)       \
    {                                            \
        (void)c;                                 \
        return fmi2OK;                           \
    }
NOTHING(Terminate)
NOTHING(EnterInitializationMode)

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    show(c);
    ((Instance *)c)->steps = 1;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c)
{
    const fmi2CallbackFunctions *functions = ((Instance *)c)->functions;
    memset(c, 0, sizeof(Instance));
    ((Instance *)c)->functions = functions;
    return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean tolerant, fmi2Real tolerance,
                               fmi2Real t, fmi2Boolean stops, fmi2Real stop)
{
    (void)c, (void)tolerant, (void)tolerance, (void)t, (void)stops, (void)stop;
#ifdef FORGETS
    memset(((Instance *)c)->value, 0, sizeof(((Instance *)c)->value));
#endif
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                       const fmi2Real values[])
{
    for (size_t i = 0; i < n; ++i)
        ((Instance *)c)->value[vr[i]] = (NUMBER)values[i];
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real values[])
{
    Instance *instance = c;
    if (!instance->steps)
        show(instance);
    for (size_t i = 0; i < n; ++i)
        values[i] = instance->value[vr[i]];
    return fmi2OK;
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                       const fmi2Integer order[], const fmi2Real values[])
{
    (void)vr, (void)n, (void)order;
    ((Instance *)c)->slope = values[0];
    return fmi2OK;
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknowns[],
                                        size_t n, const fmi2ValueReference knowns[], size_t m,
                                        const fmi2Real seed[], fmi2Real result[])
{
    (void)unknowns, (void)n, (void)knowns, (void)m;
    result[0] = ((Instance *)c)->value[D] * seed[0];
    return fmi2OK;
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no_way_back)
{
    Instance *instance = c;
    double *p = instance->value, a = p[A];
    (void)no_way_back;
    if (p[SAYS] != 0.0)
        instance->functions->logger(instance->functions->componentEnvironment, "small", fmi2OK,
                                    "step", "to %g s", t + h);
    if (p[KIND] == 0.0) {
        const double grown = expm1(a * h), slope = instance->slope;
        p[X] += grown * p[X] + p[B] * (p[U] * grown / a + slope * (grown / a - h) / a);
        p[U] += slope * h;
        instance->slope = 0.0;
    }
    instance->end = t + h;
    show(instance);
    return fmi2OK;
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
