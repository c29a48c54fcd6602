/* An FMU of FMI 3.0 that keeps what it is given: a scalar (reference 10 k) and an array of three
 * (10 k + 1) of every type.
 *
 * x' = u by Simpson's rule over the u that Intermediate Updates leave at the start, the middle and
 * the end of a step. behavior (UInt8 500): 1 the step is discarded, 2 it returns early in the
 * middle for an event, 3 it asks for the end, 4 fmi3SetFloat64 fails in an Intermediate Update, 5 a
 * time event is announced. With REFUSES it has no event mode, with
 * FINDS it says where its resources are. */
#include "fmi3Functions.h"

#include <stdlib.h>
#include <string.h>

enum {
    U = 10,
    X = 20,
    DER_X = 30,
    NO_WAY_BACK = 40,
    BEHAVIOR = 500,
    EVENT_MODE = 510,
    EARLY_RETURN = 520,
    CONFIGURED = 530,
    LAST = 600
};

typedef struct {
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
    fmi3IntermediateUpdateCallback update;
    double t;
    fmi3Boolean inside; /* an Intermediate Update */
    union {
        double d[3];
        unsigned char bytes[24];
    } store[LAST];
    char text[2][100];
    fmi3Byte binary[2][100];
    size_t sizes[2];
} Instance;

static double *number(fmi3Instance c, int reference) { return ((Instance *)c)->store[reference].d; }
static void say(Instance *instance, fmi3Status status, const char *text)
{
    instance->log(instance->environment, status, "probe", text);
}

static Instance *create(fmi3String token, fmi3String resources,
                        fmi3InstanceEnvironment environment, fmi3LogMessageCallback log)
{
    if (strcmp(token, "probe") != 0) {
        log(environment, fmi3Error, "probe", "wrong token %s");
        return NULL;
    }
    Instance *instance = calloc(1, sizeof(Instance));
    instance->environment = environment;
    instance->log = log;
#ifdef FINDS
    say(instance, fmi3OK, resources ? resources : "nothing");
#endif
    (void)resources;
    return instance;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                          fmi3Boolean visible, fmi3Boolean logging,
                                          fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log)
{
    (void)name, (void)visible, (void)logging;
    return create(token, resources, environment, log);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources,
                                         fmi3Boolean visible, fmi3Boolean logging,
                                         fmi3Boolean event_mode, fmi3Boolean early_return,
                                         const fmi3ValueReference required[], size_t n_required,
                                         fmi3InstanceEnvironment environment,
                                         fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update)
{
    (void)name, (void)visible, (void)logging;
#ifdef REFUSES
    if (event_mode) {
        log(environment, fmi3Error, "probe", "no event mode");
        return NULL;
    }
#endif
    Instance *instance = create(token, resources, environment, log);
    if (instance) {
        instance->update = n_required == 1 && required[0] == U ? update : NULL;
        instance->store[EVENT_MODE].bytes[0] = event_mode;
        instance->store[EARLY_RETURN].bytes[0] = early_return;
    }
    return instance;
}

void fmi3FreeInstance(fmi3Instance c)
{
    say(c, fmi3OK, "freed");
    free(c);
}
fmi3Status fmi3Reset(fmi3Instance c)
{
    (void)c;
    return fmi3OK;
}
fmi3Status fmi3Terminate(fmi3Instance c)
{
    (void)c;
    return fmi3OK;
}
fmi3Status fmi3ExitInitializationMode(fmi3Instance c)
{
    (void)c;
    return fmi3OK;
}
fmi3Status fmi3EnterEventMode(fmi3Instance c)
{
    (void)c;
    return fmi3OK;
}
fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c)
{
    (void)c;
    return fmi3OK;
}
fmi3Status fmi3EnterStepMode(fmi3Instance c)
{
    (void)c;
    return fmi3OK;
}
fmi3Status fmi3EnterConfigurationMode(fmi3Instance c)
{
    ((Instance *)c)->store[CONFIGURED].bytes[0] = 1;
    return fmi3OK;
}
fmi3Status fmi3ExitConfigurationMode(fmi3Instance c)
{
    ((Instance *)c)->store[CONFIGURED].bytes[0] = 2;
    return fmi3OK;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean has_tolerance,
                                       fmi3Float64 tolerance, fmi3Float64 start,
                                       fmi3Boolean has_stop, fmi3Float64 stop)
{
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    ((Instance *)c)->t = start;
    return fmi3OK;
}

static size_t elements(fmi3ValueReference reference) { return reference % 10 == 1 ? 3 : 1; }

#define ACCESS(Name, type)                                                                       \
    fmi3Status fmi3Get##Name(fmi3Instance c, const fmi3ValueReference vr[], size_t n,            \
                             type values[], size_t n_values)                                     \
    {                                                                                            \
        const type *end = values + n_values;                                                     \
        for (size_t i = 0; i < n; values += elements(vr[i]), ++i)                                \
            memcpy(values, ((Instance *)c)->store[vr[i]].bytes, elements(vr[i]) * sizeof(type)); \
        return values == end ? fmi3OK : fmi3Error;                                               \
    }                                                                                            \
    fmi3Status fmi3Set##Name(fmi3Instance c, const fmi3ValueReference vr[], size_t n,            \
                             const type values[], size_t n_values)                               \
    {                                                                                            \
        const type *end = values + n_values;                                                     \
        if (((Instance *)c)->inside && ((Instance *)c)->store[BEHAVIOR].bytes[0] == 4)          \
            return fmi3Error;                                                                    \
        for (size_t i = 0; i < n; values += elements(vr[i]), ++i)                                \
            memcpy(((Instance *)c)->store[vr[i]].bytes, values, elements(vr[i]) * sizeof(type)); \
        return values == end ? fmi3OK : fmi3Error;                                               \
    }

ACCESS(Float64, fmi3Float64)
ACCESS(Float32, fmi3Float32)
ACCESS(Int8, fmi3Int8)
ACCESS(UInt8, fmi3UInt8)
ACCESS(Int16, fmi3Int16)
ACCESS(UInt16, fmi3UInt16)
ACCESS(Int32, fmi3Int32)
ACCESS(UInt32, fmi3UInt32)
ACCESS(Int64, fmi3Int64)
ACCESS(UInt64, fmi3UInt64)
ACCESS(Boolean, fmi3Boolean)

fmi3Status fmi3GetString(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                         fmi3String values[], size_t n_values)
{
    (void)vr, (void)n;
    for (size_t i = 0; i < n_values; ++i)
        values[i] = ((Instance *)c)->text[i];
    return n_values == 2 ? fmi3OK : fmi3Error;
}

fmi3Status fmi3SetString(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                         const fmi3String values[], size_t n_values)
{
    (void)vr, (void)n;
    for (size_t i = 0; i < n_values; ++i)
        strncpy(((Instance *)c)->text[i], values[i], 99);
    return n_values == 2 ? fmi3OK : fmi3Error;
}

fmi3Status fmi3GetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t n, size_t sizes[],
                         fmi3Binary values[], size_t n_values)
{
    (void)vr, (void)n;
    for (size_t i = 0; i < n_values; ++i) {
        sizes[i] = ((Instance *)c)->sizes[i];
        values[i] = ((Instance *)c)->binary[i];
    }
    return n_values == 2 ? fmi3OK : fmi3Error;
}

fmi3Status fmi3SetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                         const size_t sizes[], const fmi3Binary values[], size_t n_values)
{
    (void)vr, (void)n;
    for (size_t i = 0; i < n_values; ++i) {
        ((Instance *)c)->sizes[i] = sizes[i];
        memcpy(((Instance *)c)->binary[i], values[i], sizes[i]);
    }
    return n_values == 2 ? fmi3OK : fmi3Error;
}

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state)
{
    if (*state == NULL) {
        say(c, fmi3OK, "allocated a state");
        *state = malloc(sizeof(Instance));
    }
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

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *again, fmi3Boolean *terminate,
                                    fmi3Boolean *nominals, fmi3Boolean *values,
                                    fmi3Boolean *has_time, fmi3Float64 *time)
{
    *again = *terminate = *values = fmi3False;
    *nominals = fmi3True;
    *has_time = ((Instance *)c)->store[BEHAVIOR].bytes[0] == 5;
    *time = ((Instance *)c)->t + 0.5;
    return fmi3OK;
}

/* --- model exchange --- */

fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 t)
{
    ((Instance *)c)->t = t;
    return fmi3OK;
}
fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t n)
{
    (void)n;
    number(c, X)[0] = x[0];
    return fmi3OK;
}
fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n)
{
    (void)n;
    x[0] = number(c, X)[0];
    return fmi3OK;
}
fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 dx[], size_t n)
{
    (void)n;
    dx[0] = number(c, U)[0];
    return fmi3OK;
}
fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 z[], size_t n)
{
    (void)n;
    z[0] = number(c, X)[0] - 1.0;
    return fmi3OK;
}
fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n)
{
    (void)c, (void)n;
    x[0] = 7.0;
    return fmi3OK;
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean no_way_back, fmi3Boolean *event,
                                       fmi3Boolean *terminate)
{
    number(c, NO_WAY_BACK)[0] = no_way_back;
    *event = ((Instance *)c)->store[BEHAVIOR].bytes[0] == 5;
    *terminate = fmi3False;
    return fmi3OK;
}

/* --- co-simulation --- */

static double input(Instance *instance, double t)
{
    fmi3Boolean early = fmi3True;
    double when = 0.0;
    instance->inside = fmi3True;
    if (instance->update)
        instance->update(instance->environment, t, fmi3True, fmi3True, fmi3False, fmi3True, &early,
                         &when);
    instance->inside = fmi3False;
    if (instance->update && early)
        say(instance, fmi3Warning, "asked to return early");
    return number(instance, U)[0];
}

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean no_way_back,
                      fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early,
                      fmi3Float64 *reached)
{
    Instance *instance = c;
    const int behavior = instance->store[BEHAVIOR].bytes[0];
    number(c, NO_WAY_BACK)[0] = no_way_back;
    if (behavior == 1)
        return fmi3Discard;
    *event = *early = behavior == 2;
    *terminate = behavior == 3;
    if (behavior == 2)
        h *= 0.5;
    const double start = input(instance, t), middle = input(instance, t + 0.5 * h),
                 end = input(instance, t + h);
    number(c, X)[0] += h / 6.0 * (start + 4.0 * middle + end);
    *reached = t + h;
    return fmi3OK;
}
