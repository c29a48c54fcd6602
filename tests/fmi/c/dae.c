/* Model exchange FMUs with a residual form (FMI-LS-DAE), FMI 3, one per -DMODEL; with DERIVATIVES
 * they know their Jacobian.
 *
 * CUBIC   x' = -q z, 0 = z^3 + z - x - u; q is 1 while z > p, else 4 (a state event of an
 *         algebraic variable)
 * FOLD    x' = -1, 0 = z^2 - x: no solution from x = 0 on
 * STATIC  0 = z^3 + z - u
 *
 * z is calculated, by Newton's iteration, until it is set while time moves or in an event. */
#include "fmi3Functions.h"

#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

enum { CUBIC, FOLD, STATIC };
enum { U, X, Z, DER, R, P, Q, INDICATOR, Y, VALUES };

typedef struct {
    double v[VALUES];
    bool given, started;
} Instance;

static double residual(const double *v)
{
    return MODEL == FOLD ? v[Z] * v[Z] - v[X]
                         : v[Z] * v[Z] * v[Z] + v[Z] - (MODEL == CUBIC ? v[X] : 0.0) - v[U];
}

static double slope(const double *v)
{
    return MODEL == FOLD ? 2.0 * v[Z] : 3.0 * v[Z] * v[Z] + 1.0;
}

static void update(Instance *instance)
{
    double *v = instance->v;
    for (int k = 0; k < 50 && !instance->given && MODEL != FOLD; ++k)
        v[Z] -= residual(v) / slope(v);
    v[DER] = MODEL == FOLD ? -1.0 : -v[Q] * v[Z];
    v[R] = residual(v);
    v[INDICATOR] = v[Z] - v[P];
    v[Y] = v[X] + 2.0 * v[Z];
}

fmi3Status fmi3Reset(fmi3Instance c)
{
    Instance *instance = c;
    memset(instance, 0, sizeof *instance);
    instance->v[X] = instance->v[Z] = instance->v[Q] = 1.0;
    instance->v[P] = -1e9;
    return fmi3OK;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                          fmi3Boolean visible, fmi3Boolean logging,
                                          fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment,
        (void)log;
    Instance *instance = malloc(sizeof *instance);
    if (instance)
        fmi3Reset(instance);
    return instance;
}

void fmi3FreeInstance(fmi3Instance c) { free(c); }

fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, double values[],
                          size_t m)
{
    (void)m;
    update(c);
    for (size_t k = 0; k < n; ++k)
        values[k] = ((Instance *)c)->v[vr[k]];
    return fmi3OK;
}

fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                          const double values[], size_t m)
{
    (void)m;
    for (size_t k = 0; k < n; ++k) {
        ((Instance *)c)->v[vr[k]] = values[k];
        ((Instance *)c)->given |= vr[k] == Z && ((Instance *)c)->started;
    }
    return fmi3OK;
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference unknowns[],
                                        size_t n_unknowns, const fmi3ValueReference knowns[],
                                        size_t n_knowns, const double seed[], size_t n_seed,
                                        double sensitivity[], size_t n_sensitivity)
{
    (void)n_seed, (void)n_sensitivity;
#ifdef DERIVATIVES
    double d[VALUES] = {0.0};
    for (size_t k = 0; k < n_knowns; ++k)
        d[knowns[k]] = seed[k];
    for (size_t k = 0; k < n_unknowns; ++k)
        sensitivity[k] = unknowns[k] == DER ? (MODEL == FOLD ? 0.0 : -((Instance *)c)->v[Q] * d[Z])
                                            : slope(((Instance *)c)->v) * d[Z] - d[X] -
                                                  (MODEL == FOLD ? 0.0 : d[U]);
    return fmi3OK;
#else
    (void)c, (void)unknowns, (void)n_unknowns, (void)knowns, (void)n_knowns, (void)seed,
        (void)sensitivity;
    return fmi3Error;
#endif
}

fmi3Status fmi3SetContinuousStates(fmi3Instance c, const double x[], size_t n)
{
    return fmi3SetFloat64(c, (fmi3ValueReference[]){X}, n, x, n);
}
fmi3Status fmi3GetContinuousStates(fmi3Instance c, double x[], size_t n)
{
    return fmi3GetFloat64(c, (fmi3ValueReference[]){X}, n, x, n);
}
fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, double x[], size_t n)
{
    return fmi3GetFloat64(c, (fmi3ValueReference[]){DER}, n, x, n);
}
fmi3Status fmi3GetEventIndicators(fmi3Instance c, double z[], size_t n)
{
    return fmi3GetFloat64(c, (fmi3ValueReference[]){INDICATOR}, n, z, n);
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, double nominals[], size_t n)
{
    (void)c;
    for (size_t k = 0; k < n; ++k)
        nominals[k] = 1.0;
    return fmi3OK;
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, bool *need_update, bool *terminate,
                                    bool *nominals, bool *values, bool *has_next, double *next)
{
    Instance *instance = c;
    update(instance);
    instance->v[Q] = instance->v[INDICATOR] > 0.0 ? 1.0 : 4.0;
    *need_update = *terminate = *nominals = *values = *has_next = false;
    *next = 0.0;
    return fmi3OK;
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, bool no_way_back, bool *event,
                                       bool *terminate)
{
    (void)c, (void)no_way_back;
    *event = *terminate = false;
    return fmi3OK;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, bool has_tolerance, double tolerance,
                                       double start, bool has_stop, double stop)
{
    (void)c, (void)has_tolerance, (void)tolerance, (void)start, (void)has_stop, (void)stop;
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance c)
{
    ((Instance *)c)->started = true;
    return fmi3OK;
}
fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c)
{
    (void)c;
    return fmi3OK;
}
fmi3Status fmi3EnterEventMode(fmi3Instance c)
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
fmi3Status fmi3SetTime(fmi3Instance c, double t)
{
    (void)c, (void)t;
    return fmi3OK;
}
fmi3Status fmi3Terminate(fmi3Instance c)
{
    (void)c;
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

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state)
{
    if (*state == NULL)
        *state = malloc(sizeof(Instance));
    memcpy(*state, c, sizeof(Instance));
    return fmi3OK;
}

#define NONE(Type)                                                                    \
    fmi3Status fmi3Get##Type(fmi3Instance c, const fmi3ValueReference vr[], size_t n, \
                             fmi3##Type values[], size_t m)                           \
    {                                                                                 \
        (void)c, (void)vr, (void)n, (void)values, (void)m;                            \
        return fmi3Error;                                                             \
    }                                                                                 \
    fmi3Status fmi3Set##Type(fmi3Instance c, const fmi3ValueReference vr[], size_t n, \
                             const fmi3##Type values[], size_t m)                     \
    {                                                                                 \
        (void)c, (void)vr, (void)n, (void)values, (void)m;                            \
        return fmi3Error;                                                             \
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

fmi3Status fmi3GetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t n, size_t sizes[],
                         fmi3Binary values[], size_t m)
{
    (void)c, (void)vr, (void)n, (void)sizes, (void)values, (void)m;
    return fmi3Error;
}

fmi3Status fmi3SetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                         const size_t sizes[], const fmi3Binary values[], size_t m)
{
    (void)c, (void)vr, (void)n, (void)sizes, (void)values, (void)m;
    return fmi3Error;
}
