/* FMUs of FMI 2 and FMI 3 (-DFMI=2, 3) that start with other outputs than their initialization
 * shows: x' = u from x = 3 u, y = base + x / 6. The base is -1 in initialization mode, 10 behind
 * it, and 20 behind the first event. With FAILS that event is an error.
 *
 * In co-simulation y is computed at the end of a step or an event. unused.c has what the standards
 * require beyond that. */
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

#include <stdbool.h>
#include <stdlib.h>

#ifndef FAILS
#define FAILS 0
#endif

enum { U, X, DER_X, Y, VARIABLES };

typedef struct {
    double t, base, v[VARIABLES];
    bool initializing, steps;
} Instance;

typedef F(Component) Handle;
typedef F(Status) Status;

static void show(Instance *instance) { instance->v[Y] = instance->base + instance->v[X] / 6.0; }

static Handle create(bool steps)
{
    Instance *instance = calloc(1, sizeof(Instance));
    instance->steps = steps;
    return instance;
}

static Status begin(Instance *instance)
{
    instance->initializing = true;
    instance->base = -1.0;
    return F(OK);
}

static Status update(Instance *instance)
{
    instance->base = 20.0;
    show(instance);
    return FAILS ? F(Error) : F(OK);
}

static Status get_values(Instance *instance, const unsigned vr[], size_t n, double values[])
{
    double *v = instance->v;
    if (instance->initializing)
        v[X] = 3.0 * v[U];
    if (instance->initializing || !instance->steps)
        show(instance);
    v[DER_X] = v[U];
    for (size_t i = 0; i < n; ++i)
        values[i] = v[vr[i]];
    return F(OK);
}

static Status set_values(Instance *instance, const unsigned vr[], size_t n, const double values[])
{
    for (size_t i = 0; i < n; ++i)
        instance->v[vr[i]] = values[i];
    return F(OK);
}

static Status step(Instance *instance, double h)
{
    instance->v[X] += h * instance->v[U];
    show(instance);
    return F(OK);
}

void F(FreeInstance)(Handle c) { free(c); }
Status F(Reset)(Handle c)
{
    *(Instance *)c = (Instance){.steps = ((Instance *)c)->steps};
    return F(OK);
}
Status F(Terminate)(Handle c)
{
    (void)c;
    return F(OK);
}
Status F(ExitInitializationMode)(Handle c)
{
    Instance *instance = c;
    instance->v[X] = 3.0 * instance->v[U];
    instance->initializing = false;
    instance->base = 10.0;
    show(instance);
    return F(OK);
}
Status F(EnterContinuousTimeMode)(Handle c)
{
    (void)c;
    return F(OK);
}
Status F(EnterEventMode)(Handle c)
{
    (void)c;
    return F(OK);
}
Status F(SetTime)(Handle c, double t)
{
    ((Instance *)c)->t = t;
    return F(OK);
}
Status F(SetContinuousStates)(Handle c, const double x[], size_t n)
{
    (void)n;
    ((Instance *)c)->v[X] = x[0];
    return F(OK);
}
Status F(GetContinuousStates)(Handle c, double x[], size_t n)
{
    (void)n;
    x[0] = ((Instance *)c)->v[X];
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
    (void)name, (void)guid, (void)resources, (void)functions, (void)visible, (void)logging;
    return create(kind == fmi2CoSimulation);
}
Status fmi2SetupExperiment(Handle c, fmi2Boolean has_tolerance, double tolerance, double start,
                           fmi2Boolean has_stop, double stop)
{
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    ((Instance *)c)->t = start;
    return fmi2OK;
}
Status fmi2EnterInitializationMode(Handle c) { return begin(c); }
Status fmi2GetReal(Handle c, VALUES(double)) { return get_values(c, vr, n, values); }
Status fmi2SetReal(Handle c, VALUES(const double)) { return set_values(c, vr, n, values); }
Status fmi2GetDerivatives(Handle c, double dx[], size_t n)
{
    (void)n;
    dx[0] = ((Instance *)c)->v[U];
    return fmi2OK;
}
Status fmi2NewDiscreteStates(Handle c, fmi2EventInfo *info)
{
    *info = (fmi2EventInfo){0};
    return update(c);
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
    (void)t, (void)no_way_back;
    return step(c, h);
}
#else
Handle fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                    fmi3Boolean visible, fmi3Boolean logging,
                                    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment,
        (void)log;
    return create(false);
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
    return create(true);
}
Status fmi3EnterInitializationMode(Handle c, bool has_tolerance, double tolerance, double start,
                                   bool has_stop, double stop)
{
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    ((Instance *)c)->t = start;
    return begin(c);
}
Status fmi3EnterStepMode(Handle c)
{
    (void)c;
    return fmi3OK;
}
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
    dx[0] = ((Instance *)c)->v[U];
    return fmi3OK;
}
Status fmi3UpdateDiscreteStates(Handle c, bool *need_update, bool *terminate, bool *nominals,
                                bool *values, bool *has_next, double *next)
{
    *need_update = *terminate = *nominals = *values = *has_next = false;
    *next = 0.0;
    return update(c);
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
    return step(c, h);
}
#endif
