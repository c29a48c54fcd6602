/* A damped pendulum with a torque and a wind, FMI 2.0 model exchange; with DERIVATIVES it knows its
   Jacobian.

       theta' = omega
       omega' = -G/length sin(theta) - FRICTION omega + (torque + level + wind)/length^2

   Several of its outputs are other names of a state or a derivative: they have its value
   reference. With -DCHANGES=<statement> it does that wherever its values are computed. */
#include <fenv.h>
#include <math.h>
#include <stdlib.h>
#ifdef CHANGES
#include <unistd.h>
#else
#define CHANGES
#endif

#include "fmi2Functions.h"

enum { TORQUE, WIND, THETA, OMEGA, D_THETA, D_OMEGA, MIX, REACH, POWER, LENGTH, REALS };
#define G 9.81
#define FRICTION 0.2

typedef struct {
    double time, value[REALS];
    int level, running;
} Pendulum;

static void start(Pendulum *p)
{
    for (int i = 0; i < REALS; i++)
        p->value[i] = 0.0;
    p->value[THETA] = 0.5;
    p->value[LENGTH] = 1.0;
    p->level = 0;
    p->running = 0;
}

static void update(Pendulum *p)
{
    double *v = p->value, l = v[LENGTH];
    CHANGES;
    v[D_THETA] = v[OMEGA];
    v[D_OMEGA] =
        -G / l * sin(v[THETA]) - FRICTION * v[OMEGA] + (v[TORQUE] + p->level + v[WIND]) / (l * l);
    v[MIX] = v[OMEGA] + 2.0 * v[THETA];
    v[REACH] = l * sin(v[THETA]);
    v[POWER] = v[TORQUE] * v[OMEGA];
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String where,
                              const fmi2CallbackFunctions *f, fmi2Boolean visible,
                              fmi2Boolean logging)
{
    (void)name, (void)type, (void)guid, (void)where, (void)f, (void)visible, (void)logging;
    Pendulum *p = malloc(sizeof *p);
    if (p)
        start(p);
    return p;
}

void fmi2FreeInstance(fmi2Component c) { free(c); }
fmi2Status fmi2Reset(fmi2Component c) { return start(c), fmi2OK; }
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean td, fmi2Real tol, fmi2Real t,
                               fmi2Boolean sd, fmi2Real stop)
{
    (void)td, (void)tol, (void)sd, (void)stop;
    ((Pendulum *)c)->time = t;
    return fmi2OK;
}
fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return (void)c, fmi2OK; }
fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    return ((Pendulum *)c)->running = 1, fmi2OK;
}
fmi2Status fmi2EnterEventMode(fmi2Component c) { return (void)c, fmi2OK; }
fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) { return (void)c, fmi2OK; }
fmi2Status fmi2Terminate(fmi2Component c) { return (void)c, fmi2OK; }
fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String s[])
{
    return (void)c, (void)on, (void)n, (void)s, fmi2OK;
}
fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info)
{
    (void)c;
    *info = (fmi2EventInfo){0};
    return fmi2OK;
}
fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean no_way_back, fmi2Boolean *event,
                                       fmi2Boolean *end)
{
    (void)c, (void)no_way_back;
    return *event = *end = fmi2False, fmi2OK;
}
fmi2Status fmi2SetTime(fmi2Component c, fmi2Real t) { return ((Pendulum *)c)->time = t, fmi2OK; }

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2Real value[])
{
    update(c);
    for (size_t i = 0; i < n; i++)
        value[i] = ((Pendulum *)c)->value[r[i]];
    return fmi2OK;
}
fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference r[], size_t n,
                       const fmi2Real value[])
{
    for (size_t i = 0; i < n; i++)
        ((Pendulum *)c)->value[r[i]] = value[i];
    return fmi2OK;
}
fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference r[], size_t n,
                          fmi2Integer value[])
{
    for (size_t i = 0; i < n; i++)
        value[i] = ((Pendulum *)c)->level;
    return (void)r, fmi2OK;
}
fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference r[], size_t n,
                          const fmi2Integer value[])
{
    for (size_t i = 0; i < n; i++)
        ((Pendulum *)c)->level = value[i];
    return (void)r, fmi2OK;
}
#define REFUSE(name, type)                                                         \
    fmi2Status name(fmi2Component c, const fmi2ValueReference r[], size_t n, type) \
    {                                                                              \
        return (void)c, (void)r, (void)n, (void)v, fmi2Error;                      \
    }
REFUSE(fmi2GetBoolean, fmi2Boolean v[])
REFUSE(fmi2SetBoolean, const fmi2Boolean v[])
REFUSE(fmi2GetString, fmi2String v[])
REFUSE(fmi2SetString, const fmi2String v[])
fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *s) { return (void)c, (void)s, fmi2Error; }
fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate s) { return (void)c, (void)s, fmi2Error; }
fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *s) { return (void)c, (void)s, fmi2OK; }

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate s, size_t *n)
{
    return (void)c, (void)s, (void)n, fmi2Error;
}
fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate s, fmi2Byte b[], size_t n)
{
    return (void)c, (void)s, (void)b, (void)n, fmi2Error;
}
fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte b[], size_t n, fmi2FMUstate *s)
{
    return (void)c, (void)s, (void)b, (void)n, fmi2Error;
}

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t n)
{
    for (size_t i = 0; i < n; i++)
        ((Pendulum *)c)->value[THETA + i] = x[i];
    return fmi2OK;
}
fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t n)
{
    for (size_t i = 0; i < n; i++)
        x[i] = ((Pendulum *)c)->value[THETA + i];
    return fmi2OK;
}
fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x[], size_t n)
{
    for (size_t i = 0; i < n; i++)
        x[i] = 1.0;
    return (void)c, fmi2OK;
}
fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real z[], size_t n)
{
    for (size_t i = 0; i < n; i++)
        z[i] = ((Pendulum *)c)->value[THETA] + 4.0;
    return fmi2OK;
}
fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real dx[], size_t n)
{
    update(c);
    for (size_t i = 0; i < n; i++)
        dx[i] = ((Pendulum *)c)->value[D_THETA + i];
    return fmi2OK;
}

/* d(unknown)/d(known); a state as an unknown is an error, as it is a known one in continuous-time
 * mode. */
fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference z[], size_t nz,
                                        const fmi2ValueReference v[], size_t nv,
                                        const fmi2Real dv[], fmi2Real dz[])
{
#ifdef DERIVATIVES
    const double *x = ((Pendulum *)c)->value, l = x[LENGTH];
    double seed[REALS] = {0};
    for (size_t i = 0; i < nv; i++)
        seed[v[i]] = dv[i];
    for (size_t i = 0; i < nz; i++) {
        switch (z[i]) {
        case D_THETA: dz[i] = seed[OMEGA]; break;
        case D_OMEGA:
            dz[i] = -G / l * cos(x[THETA]) * seed[THETA] - FRICTION * seed[OMEGA] +
                    (seed[TORQUE] + seed[WIND]) / (l * l);
            break;
        case MIX: dz[i] = seed[OMEGA] + 2.0 * seed[THETA]; break;
        case REACH: dz[i] = l * cos(x[THETA]) * seed[THETA]; break;
        case POWER: dz[i] = x[TORQUE] * seed[OMEGA] + x[OMEGA] * seed[TORQUE]; break;
        default: return fmi2Error;
        }
    }
    return fmi2OK;
#else
    return (void)c, (void)z, (void)nz, (void)v, (void)nv, (void)dv, (void)dz, fmi2Error;
#endif
}
const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }
