/* A lag y' = GAIN u + BIAS - y from y = 0, of FMI 2 or FMI 3 (-DFMI=2, 3), for model exchange and
 * co-simulation: the binary that every master of the benchmark steps.
 *
 * Its own step is exact for an input that holds its value; the decay is computed where the step size
 * changes. tests/fmi/c/unused.c has what the standards require beyond that. */
#if FMI == 2
#include "fmi2Functions.h"
#define F(name) fmi2##name
#define VALUES(type) const fmi2ValueReference vr[], size_t n, type values[]
#else
#include "fmi3Functions.h"
#define F(name) fmi3##name
#define VALUES(type) const fmi3ValueReference vr[], size_t n, type values[], size_t n_values
#define fmi3Component fmi3Instance
#endif

#include <math.h>
#include <stdbool.h>
#include <stdlib.h>

enum { U, Y, DER_Y, TIME, VARIABLES };

typedef struct {
    double v[VARIABLES];
    double h, decay;
} Instance;

typedef F(Component) Handle;
typedef F(Status) Status;

static double slope(const Instance *instance)
{
    return GAIN * instance->v[U] + BIAS - instance->v[Y];
}

static Status get_values(Instance *instance, const unsigned vr[], size_t n, double values[])
{
    for (size_t i = 0; i < n; ++i) {
        if (vr[i] >= VARIABLES)
            return F(Error);
        values[i] = vr[i] == DER_Y ? slope(instance) : instance->v[vr[i]];
    }
    return F(OK);
}

static Status set_values(Instance *instance, const unsigned vr[], size_t n, const double values[])
{
    for (size_t i = 0; i < n; ++i) {
        if (vr[i] >= DER_Y)
            return F(Error);
        instance->v[vr[i]] = values[i];
    }
    return F(OK);
}

static Status step(Instance *instance, double t, double h)
{
    instance->v[TIME] = t + h;
    if (h != instance->h) {
        instance->h = h;
        instance->decay = exp(-h);
    }
    const double end = GAIN * instance->v[U] + BIAS;
    instance->v[Y] = end + (instance->v[Y] - end) * instance->decay;
    return F(OK);
}

/* Nothing happens in these. */
#define ONLY_CALLED(name)     \
    Status F(name)(Handle c)  \
    {                         \
        (void)c;              \
        return F(OK);         \
    }
ONLY_CALLED(Terminate)
ONLY_CALLED(ExitInitializationMode)
ONLY_CALLED(EnterContinuousTimeMode)
ONLY_CALLED(EnterEventMode)

void F(FreeInstance)(Handle c) { free(c); }
Status F(Reset)(Handle c)
{
    *(Instance *)c = (Instance){0};
    return F(OK);
}
Status F(SetTime)(Handle c, double t)
{
    ((Instance *)c)->v[TIME] = t;
    return F(OK);
}
Status F(SetContinuousStates)(Handle c, const double x[], size_t n)
{
    (void)n;
    ((Instance *)c)->v[Y] = x[0];
    return F(OK);
}
Status F(GetContinuousStates)(Handle c, double x[], size_t n)
{
    (void)n;
    x[0] = ((Instance *)c)->v[Y];
    return F(OK);
}
Status F(GetEventIndicators)(Handle c, double z[], size_t n)
{
    (void)c, (void)z, (void)n;
    return F(OK);
}
Status F(GetNominalsOfContinuousStates)(Handle c, double nominals[], size_t n)
{
    (void)c, (void)n;
    nominals[0] = 1.0;
    return F(OK);
}

#if FMI == 2
Handle fmi2Instantiate(fmi2String name, fmi2Type kind, fmi2String guid, fmi2String resources,
                       const fmi2CallbackFunctions *functions, fmi2Boolean visible,
                       fmi2Boolean logging)
{
    (void)name, (void)kind, (void)guid, (void)resources, (void)functions, (void)visible,
        (void)logging;
    return calloc(1, sizeof(Instance));
}
Status fmi2SetupExperiment(Handle c, fmi2Boolean has_tolerance, double tolerance, double start,
                           fmi2Boolean has_stop, double stop)
{
    (void)c, (void)has_tolerance, (void)tolerance, (void)start, (void)has_stop, (void)stop;
    return fmi2OK;
}
ONLY_CALLED(EnterInitializationMode)
Status fmi2GetReal(Handle c, VALUES(double)) { return get_values(c, vr, n, values); }
Status fmi2SetReal(Handle c, VALUES(const double)) { return set_values(c, vr, n, values); }
Status fmi2GetDerivatives(Handle c, double dx[], size_t n)
{
    (void)n;
    dx[0] = slope(c);
    return fmi2OK;
}
Status fmi2NewDiscreteStates(Handle c, fmi2EventInfo *info)
{
    (void)c;
    *info = (fmi2EventInfo){0};
    return fmi2OK;
}
Status fmi2CompletedIntegratorStep(Handle c, fmi2Boolean no_way_back, fmi2Boolean *event,
                                   fmi2Boolean *terminate)
{
    (void)c, (void)no_way_back;
    *event = *terminate = fmi2False;
    return fmi2OK;
}
Status fmi2DoStep(Handle c, double t, double h, fmi2Boolean no_way_back)
{
    (void)no_way_back;
    return step(c, t, h);
}
#else
Handle fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                    fmi3Boolean visible, fmi3Boolean logging,
                                    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment,
        (void)log;
    return calloc(1, sizeof(Instance));
}
Handle fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources,
                                   fmi3Boolean visible, fmi3Boolean logging, fmi3Boolean event_mode,
                                   fmi3Boolean early_return, const fmi3ValueReference required[],
                                   size_t n, fmi3InstanceEnvironment environment,
                                   fmi3LogMessageCallback log,
                                   fmi3IntermediateUpdateCallback intermediate)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment,
        (void)log, (void)event_mode, (void)early_return, (void)required, (void)n,
        (void)intermediate;
    return calloc(1, sizeof(Instance));
}
Status fmi3EnterInitializationMode(Handle c, bool has_tolerance, double tolerance, double start,
                                   bool has_stop, double stop)
{
    (void)c, (void)has_tolerance, (void)tolerance, (void)start, (void)has_stop, (void)stop;
    return fmi3OK;
}
ONLY_CALLED(EnterStepMode)
Status fmi3GetFloat64(Handle c, VALUES(double))
{
    (void)n_values;
    return get_values(c, vr, n, values);
}
Status fmi3SetFloat64(Handle c, VALUES(const double))
{
    (void)n_values;
    return set_values(c, vr, n, values);
}
Status fmi3GetContinuousStateDerivatives(Handle c, double dx[], size_t n)
{
    (void)n;
    dx[0] = slope(c);
    return fmi3OK;
}
Status fmi3UpdateDiscreteStates(Handle c, bool *need_update, bool *terminate, bool *nominals,
                                bool *values, bool *has_next, double *next)
{
    (void)c;
    *need_update = *terminate = *nominals = *values = *has_next = false;
    *next = 0.0;
    return fmi3OK;
}
Status fmi3CompletedIntegratorStep(Handle c, bool no_way_back, bool *event, bool *terminate)
{
    (void)c, (void)no_way_back;
    *event = *terminate = false;
    return fmi3OK;
}
Status fmi3DoStep(Handle c, double t, double h, bool no_way_back, bool *event, bool *terminate,
                  bool *early, double *reached)
{
    (void)no_way_back;
    *event = *terminate = *early = false;
    *reached = t + h;
    return step(c, t, h);
}
#endif
