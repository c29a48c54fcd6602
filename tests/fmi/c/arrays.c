/* A linear model of FMI 3.0 in arrays: x' = A x + B u, y = C x + D u, with three states, two inputs
   and two outputs.

   It knows its directional derivatives, and refuses a state among the unknowns. */
#include <stdlib.h>
#include <string.h>

#include "fmi3Functions.h"

enum { U, X, DX, Y, VARIABLES };
static const size_t SIZE[VARIABLES] = {2, 3, 3, 2};
static const double A[3][3] = {{-1, 2, 0}, {0, -3, 0.5}, {0.25, 0, -2}},
                    B[3][2] = {{1, 0}, {0, 4}, {-1, 1}};
static const double C[2][3] = {{1, 0, 2}, {0, -1, 0}}, D[2][2] = {{0, 3}, {0, 0}};

typedef double Values[VARIABLES][3];

static void evaluate(Values v)
{
    for (int i = 0; i < 3; i++)
        v[DX][i] = A[i][0] * v[X][0] + A[i][1] * v[X][1] + A[i][2] * v[X][2] + B[i][0] * v[U][0] +
                   B[i][1] * v[U][1];
    for (int i = 0; i < 2; i++)
        v[Y][i] = C[i][0] * v[X][0] + C[i][1] * v[X][1] + C[i][2] * v[X][2] + D[i][0] * v[U][0] +
                  D[i][1] * v[U][1];
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                          fmi3Boolean visible, fmi3Boolean logging,
                                          fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment,
        (void)log;
    return calloc(1, sizeof(Values));
}
void fmi3FreeInstance(fmi3Instance c) { free(c); }
fmi3Status fmi3Reset(fmi3Instance c) { return memset(c, 0, sizeof(Values)), fmi3OK; }
fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean td, fmi3Float64 tol,
                                       fmi3Float64 t, fmi3Boolean sd, fmi3Float64 stop)
{
    return (void)c, (void)td, (void)tol, (void)t, (void)sd, (void)stop, fmi3OK;
}
fmi3Status fmi3ExitInitializationMode(fmi3Instance c) { return (void)c, fmi3OK; }
fmi3Status fmi3EnterConfigurationMode(fmi3Instance c) { return (void)c, fmi3Error; }
fmi3Status fmi3ExitConfigurationMode(fmi3Instance c) { return (void)c, fmi3Error; }
fmi3Status fmi3EnterEventMode(fmi3Instance c) { return (void)c, fmi3OK; }
fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c) { return (void)c, fmi3OK; }
fmi3Status fmi3Terminate(fmi3Instance c) { return (void)c, fmi3OK; }
fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 t) { return (void)c, (void)t, fmi3OK; }
fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *more, fmi3Boolean *end,
                                    fmi3Boolean *nominals, fmi3Boolean *values, fmi3Boolean *timed,
                                    fmi3Float64 *next)
{
    (void)c, (void)next;
    return *more = *end = *nominals = *values = *timed = fmi3False, fmi3OK;
}
fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean no_way_back, fmi3Boolean *event,
                                       fmi3Boolean *end)
{
    (void)c, (void)no_way_back;
    return *event = *end = fmi3False, fmi3OK;
}
fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference r[], size_t n,
                          fmi3Float64 value[], size_t size)
{
    double (*v)[3] = c;
    evaluate(v);
    for (size_t i = 0, at = 0; i < n && at < size; at += SIZE[r[i]], i++)
        memcpy(value + at, v[r[i]], SIZE[r[i]] * sizeof(double));
    return fmi3OK;
}
fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference r[], size_t n,
                          const fmi3Float64 value[], size_t size)
{
    double (*v)[3] = c;
    for (size_t i = 0, at = 0; i < n && at < size; at += SIZE[r[i]], i++)
        memcpy(v[r[i]], value + at, SIZE[r[i]] * sizeof(double));
    return fmi3OK;
}
fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t n)
{
    return memcpy(((double (*)[3])c)[X], x, n * sizeof *x), fmi3OK;
}
fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n)
{
    return memcpy(x, ((double (*)[3])c)[X], n * sizeof *x), fmi3OK;
}
fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 dx[], size_t n)
{
    evaluate(c);
    return memcpy(dx, ((double (*)[3])c)[DX], n * sizeof *dx), fmi3OK;
}
fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n)
{
    for (size_t i = 0; i < n; i++)
        x[i] = 1.0;
    return (void)c, fmi3OK;
}
fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 z[], size_t n)
{
    return (void)c, (void)z, n ? fmi3Error : fmi3OK;
}

/* Element-wise: the seeds of the knowns one after the other, the unknowns likewise. */
fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference unknown[],
                                        size_t n, const fmi3ValueReference known[], size_t m,
                                        const fmi3Float64 seed[], size_t seeds,
                                        fmi3Float64 sensitivity[], size_t size)
{
    Values moved = {{0}};
    (void)c;
    fmi3SetFloat64(moved, known, m, seed, seeds);
    for (size_t i = 0; i < n; i++)
        if (unknown[i] != DX && unknown[i] != Y)
            return fmi3Error;
    return fmi3GetFloat64(moved, unknown, n, sensitivity, size);
}

/* What the standard requires and this model has no use for. */
#define REFUSE(type)                                                                 \
    fmi3Status fmi3Get##type(fmi3Instance c, const fmi3ValueReference r[], size_t n, \
                             fmi3##type v[], size_t size)                            \
    {                                                                                \
        return (void)c, (void)r, (void)n, (void)v, (void)size, fmi3Error;            \
    }                                                                                \
    fmi3Status fmi3Set##type(fmi3Instance c, const fmi3ValueReference r[], size_t n, \
                             const fmi3##type v[], size_t size)                      \
    {                                                                                \
        return (void)c, (void)r, (void)n, (void)v, (void)size, fmi3Error;            \
    }
REFUSE(Float32)
REFUSE(Int8)
REFUSE(UInt8)
REFUSE(Int16)
REFUSE(UInt16)
REFUSE(Int32)
REFUSE(UInt32)
REFUSE(Int64)
REFUSE(UInt64)
REFUSE(Boolean)
REFUSE(String)
fmi3Status fmi3GetBinary(fmi3Instance c, const fmi3ValueReference r[], size_t n, size_t s[],
                         fmi3Binary v[], size_t size)
{
    return (void)c, (void)r, (void)n, (void)s, (void)v, (void)size, fmi3Error;
}
fmi3Status fmi3SetBinary(fmi3Instance c, const fmi3ValueReference r[], size_t n, const size_t s[],
                         const fmi3Binary v[], size_t size)
{
    return (void)c, (void)r, (void)n, (void)s, (void)v, (void)size, fmi3Error;
}
