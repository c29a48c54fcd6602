/* Clocks of FMI 3.0, of every kind, in co-simulation and model exchange. What belongs to a clock can
 * be set and read where the standard allows it only; anything else is answered with an error.
 *
 *   sample   based on time: count + 1, sum + u, when = time
 *   asked    based on time, its interval is asked for: asked_count + 1
 *   next     changing: the k-th interval (from 0) is (k + 1) * step: next_count + 1
 *   in       triggered: in_count + 1, latched = v; after it later counts down
 *   later    countdown, delay after a tick of in: later_count + 1, later_when = time
 *   out      ticks with every n-th tick of sample, and with later: shown = sum
 *   x        x' = count, whether clocks tick or not */
#include "fmi3Functions.h"
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum {
    TIME,
    SAMPLE,
    ASKED,
    NEXT,
    IN,
    LATER,
    OUT,
    CLOCKS,
    U = 10,
    V,
    COUNT,
    SUM,
    WHEN,
    ASKED_COUNT,
    NEXT_COUNT,
    IN_COUNT,
    LATCHED,
    LATER_COUNT,
    LATER_WHEN,
    SHOWN,
    X,
    DER_X,
    EVERY,
    PERIOD,
    OFFSET,
    STEP,
    DELAY,
    VALUES
};

/* To which clock a variable belongs; 0: to none. */
static const int clock_of[VALUES] = {
    [U] = SAMPLE,         [COUNT] = SAMPLE,         [SUM] = SAMPLE,   [WHEN] = SAMPLE,
    [ASKED_COUNT] = ASKED, [NEXT_COUNT] = NEXT,     [IN_COUNT] = IN,  [LATCHED] = IN,
    [V] = IN,             [LATER_COUNT] = LATER,    [LATER_WHEN] = LATER, [SHOWN] = OUT};

typedef enum { INSTANTIATED, INITIALIZATION, EVENT_MODE, TIME_MODE } Mode;

typedef struct {
    double before[VALUES], now[VALUES], t, last_period;
    int active[CLOCKS], event_mode_used, waits, told;
    Mode mode;
    fmi3LogMessageCallback log;
    fmi3InstanceEnvironment environment;
} Instance;

static fmi3Status complain(Instance *instance, const char *text)
{
    instance->log(instance->environment, fmi3Error, "error", text);
    return fmi3Error;
}

static void set_start(Instance *instance)
{
    memset(instance->before, 0, sizeof instance->before);
    memset(instance->active, 0, sizeof instance->active);
    instance->before[EVERY] = 2.0;
    instance->before[PERIOD] = 0.3;
    instance->before[STEP] = 0.01;
    instance->before[DELAY] = 0.025;
    memcpy(instance->now, instance->before, sizeof instance->now);
    instance->t = instance->last_period = 0.0;
    instance->waits = instance->told = 0;
    instance->mode = INSTANTIATED;
}

/* What the active clocks make of the values before this instant. */
static void evaluate(Instance *instance)
{
    const double *old = instance->before;
    const int *active = instance->active;
    double *new = instance->now;
    if (active[SAMPLE]) {
        new[COUNT] = old[COUNT] + 1.0;
        new[SUM] = old[SUM] + new[U];
        new[WHEN] = instance->t;
    }
    if (active[ASKED])
        new[ASKED_COUNT] = old[ASKED_COUNT] + 1.0;
    if (active[NEXT])
        new[NEXT_COUNT] = old[NEXT_COUNT] + 1.0;
    if (active[IN]) {
        new[IN_COUNT] = old[IN_COUNT] + 1.0;
        new[LATCHED] = new[V];
    }
    if (active[LATER]) {
        new[LATER_COUNT] = old[LATER_COUNT] + 1.0;
        new[LATER_WHEN] = instance->t;
    }
    instance->active[OUT] =
        (active[SAMPLE] && fmod(new[COUNT], new[EVERY]) == 0.0) || active[LATER];
    if (active[OUT])
        new[SHOWN] = new[SUM];
}

static Instance *create(fmi3InstanceEnvironment environment, fmi3LogMessageCallback log)
{
    Instance *instance = calloc(1, sizeof(Instance));
    instance->log = log;
    instance->environment = environment;
    set_start(instance);
    return instance;
}

fmi3Instance
fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources,
                            fmi3Boolean visible, fmi3Boolean logging, fmi3Boolean event_mode_used,
                            fmi3Boolean early_return_allowed, const fmi3ValueReference required[],
                            size_t n, fmi3InstanceEnvironment environment,
                            fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging,
        (void)early_return_allowed, (void)required, (void)n, (void)update;
    Instance *instance = create(environment, log);
    instance->event_mode_used = event_mode_used;
    return instance;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                          fmi3Boolean visible, fmi3Boolean logging,
                                          fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging;
    Instance *instance = create(environment, log);
    instance->event_mode_used = 1;
    return instance;
}

void fmi3FreeInstance(fmi3Instance c) { free(c); }

fmi3Status fmi3Reset(fmi3Instance c)
{
    set_start(c);
    return fmi3OK;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean tolerant, fmi3Float64 tolerance,
                                       fmi3Float64 t, fmi3Boolean stops, fmi3Float64 stop)
{
    (void)tolerant, (void)tolerance, (void)stops, (void)stop;
    Instance *instance = c;
    instance->t = t;
    instance->mode = INITIALIZATION;
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance c)
{
    Instance *instance = c;
    memcpy(instance->before, instance->now, sizeof instance->before);
    instance->mode = instance->event_mode_used ? EVENT_MODE : TIME_MODE;
    return fmi3OK;
}

fmi3Status fmi3EnterEventMode(fmi3Instance c)
{
    Instance *instance = c;
    if (instance->mode != TIME_MODE || !instance->event_mode_used)
        return complain(c, "no event mode from here");
    instance->mode = EVENT_MODE;
    return fmi3OK;
}

static fmi3Status leave_event_mode(Instance *instance)
{
    if (instance->mode != EVENT_MODE)
        return complain(instance, "not in event mode");
    for (int clock = SAMPLE; clock < CLOCKS; ++clock)
        if (instance->active[clock])
            return complain(instance, "a clock is active still");
    instance->mode = TIME_MODE;
    return fmi3OK;
}

fmi3Status fmi3EnterStepMode(fmi3Instance c) { return leave_event_mode(c); }
fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c) { return leave_event_mode(c); }

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *need_update,
                                    fmi3Boolean *terminate, fmi3Boolean *nominals,
                                    fmi3Boolean *values, fmi3Boolean *has_time, fmi3Float64 *time)
{
    Instance *instance = c;
    if (instance->mode != EVENT_MODE)
        return complain(c, "update outside event mode");
    evaluate(instance);
    if (instance->active[IN]) {
        instance->waits = 1;
        instance->told = 0;
    }
    else if (instance->active[LATER])
        instance->waits = 0;
    memcpy(instance->before, instance->now, sizeof instance->before);
    memset(instance->active, 0, sizeof instance->active);
    *need_update = *terminate = *nominals = *values = *has_time = 0;
    *time = 0.0;
    return fmi3OK;
}

/* --- clocks --- */

fmi3Status fmi3SetClock(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                        const fmi3Clock values[])
{
    Instance *instance = c;
    if (instance->mode != EVENT_MODE)
        return complain(c, "a clock was set outside event mode");
    for (size_t i = 0; i < n; ++i) {
        if (vr[i] < SAMPLE || vr[i] > LATER || !values[i] || instance->active[vr[i]])
            return complain(c, "no input clock, or active already");
        instance->active[vr[i]] = 1;
    }
    return fmi3OK;
}

fmi3Status fmi3GetClock(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                        fmi3Clock values[])
{
    Instance *instance = c;
    if (instance->mode != EVENT_MODE)
        return complain(c, "a clock was read outside event mode");
    evaluate(instance);
    for (size_t i = 0; i < n; ++i) {
        if (vr[i] < SAMPLE || vr[i] >= CLOCKS)
            return complain(c, "no clock");
        values[i] = instance->active[vr[i]];
    }
    return fmi3OK;
}

fmi3Status fmi3GetIntervalDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                                  fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[])
{
    Instance *instance = c;
    if (instance->mode != INITIALIZATION && instance->mode != EVENT_MODE)
        return complain(c, "an interval was asked for in another mode");
    for (size_t i = 0; i < n; ++i) {
        qualifiers[i] = fmi3IntervalChanged;
        if (vr[i] == ASKED) {
            intervals[i] = instance->now[PERIOD];
            if (intervals[i] == instance->last_period)
                qualifiers[i] = fmi3IntervalUnchanged;
            instance->last_period = intervals[i];
        }
        else if (vr[i] == NEXT)
            intervals[i] = (instance->now[NEXT_COUNT] + 1.0) * instance->now[STEP];
        else if (vr[i] == LATER) {
            intervals[i] = instance->now[DELAY];
            qualifiers[i] = !instance->waits  ? fmi3IntervalNotYetKnown
                            : instance->told ? fmi3IntervalUnchanged
                                             : fmi3IntervalChanged;
            instance->told = instance->waits;
        }
        else
            return complain(c, "the file says the interval");
    }
    return fmi3OK;
}

fmi3Status fmi3GetShiftDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                               fmi3Float64 shifts[])
{
    Instance *instance = c;
    for (size_t i = 0; i < n; ++i) {
        if (vr[i] != ASKED || instance->mode != INITIALIZATION)
            return complain(c, "the file says the shift");
        shifts[i] = instance->now[OFFSET];
    }
    return fmi3OK;
}

/* Thousandths, rounded: a period of 1e-4 s is the fraction 0 / 1000. */
fmi3Status fmi3GetIntervalFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                                   fmi3UInt64 counters[], fmi3UInt64 resolutions[],
                                   fmi3IntervalQualifier qualifiers[])
{
    fmi3Float64 interval;
    for (size_t i = 0; i < n; ++i) {
        fmi3Status status = fmi3GetIntervalDecimal(c, vr + i, 1, &interval, qualifiers + i);
        if (status != fmi3OK)
            return status;
        resolutions[i] = 1000;
        counters[i] = (fmi3UInt64)llround(interval * 1000.0);
    }
    return fmi3OK;
}

fmi3Status fmi3GetShiftFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                                fmi3UInt64 counters[], fmi3UInt64 resolutions[])
{
    fmi3Float64 shift;
    for (size_t i = 0; i < n; ++i) {
        fmi3Status status = fmi3GetShiftDecimal(c, vr + i, 1, &shift);
        if (status != fmi3OK)
            return status;
        resolutions[i] = 1000;
        counters[i] = (fmi3UInt64)llround(shift * 1000.0);
    }
    return fmi3OK;
}

/* --- values --- */

static int accessible(const Instance *instance, fmi3ValueReference reference)
{
    int clock = reference < VALUES ? clock_of[reference] : 0;
    return instance->mode <= INITIALIZATION || !clock || instance->active[clock];
}

fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                          const fmi3Float64 values[], size_t m)
{
    Instance *instance = c;
    (void)m;
    for (size_t i = 0; i < n; ++i) {
        if (!accessible(instance, vr[i]))
            return complain(c, "set while its clock is not active");
        instance->now[vr[i]] = values[i];
    }
    return fmi3OK;
}

fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                          fmi3Float64 values[], size_t m)
{
    Instance *instance = c;
    (void)m;
    if (instance->mode == EVENT_MODE)
        evaluate(instance);
    for (size_t i = 0; i < n; ++i) {
        if (!accessible(instance, vr[i]))
            return complain(c, "read while its clock is not active");
        values[i] = vr[i] == TIME    ? instance->t
                    : vr[i] == DER_X ? instance->now[COUNT]
                                     : instance->now[vr[i]];
    }
    return fmi3OK;
}

/* --- co-simulation --- */

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean no_way_back,
                      fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early,
                      fmi3Float64 *reached)
{
    Instance *instance = c;
    (void)no_way_back;
    if (instance->mode != TIME_MODE || h <= 0.0 || fabs(t - instance->t) > 1e-12)
        return complain(c, "no step from here");
    instance->now[X] = instance->before[X] += h * instance->now[COUNT];
    instance->t = t + h;
    *event = *terminate = *early = 0;
    *reached = instance->t;
    return fmi3OK;
}

/* --- model exchange --- */

fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 t)
{
    Instance *instance = c;
    instance->t = t;
    return fmi3OK;
}

fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t n)
{
    Instance *instance = c;
    (void)n;
    instance->now[X] = instance->before[X] = x[0];
    return fmi3OK;
}

fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n)
{
    (void)n;
    x[0] = ((Instance *)c)->now[X];
    return fmi3OK;
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 dx[], size_t n)
{
    (void)n;
    dx[0] = ((Instance *)c)->now[COUNT];
    return fmi3OK;
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 nominals[], size_t n)
{
    (void)c, (void)n;
    nominals[0] = 1.0;
    return fmi3OK;
}

fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 indicators[], size_t n)
{
    (void)c, (void)indicators, (void)n;
    return fmi3OK;
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean no_way_back,
                                       fmi3Boolean *enter_event_mode, fmi3Boolean *terminate)
{
    (void)c, (void)no_way_back;
    *enter_event_mode = *terminate = 0;
    return fmi3OK;
}

/* --- states --- */

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state)
{
    if (*state == NULL)
        *state = malloc(sizeof(Instance));
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

/* --- what it does not have --- */

const char *fmi3GetVersion(void) { return "3.0"; }

fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t n,
                               const fmi3String categories[])
{
    (void)c, (void)on, (void)n, (void)categories;
    return fmi3OK;
}

static fmi3Status give(size_t *result, size_t n)
{
    *result = n;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *n)
{
    (void)c;
    return give(n, 0);
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *n)
{
    (void)c;
    return give(n, 1);
}

#define NOTHING(name)                 \
    fmi3Status fmi3##name(fmi3Instance c) \
    {                                 \
        (void)c;                      \
        return fmi3OK;                \
    }
NOTHING(Terminate)
NOTHING(EnterConfigurationMode)
NOTHING(ExitConfigurationMode)

#define NONE(name)                                                                    \
    fmi3Status fmi3Set##name(fmi3Instance c, const fmi3ValueReference vr[], size_t n, \
                             const fmi3##name values[], size_t m)                     \
    {                                                                                 \
        (void)vr, (void)n, (void)values, (void)m;                                     \
        return complain(c, "no variables of this type");                              \
    }                                                                                 \
    fmi3Status fmi3Get##name(fmi3Instance c, const fmi3ValueReference vr[], size_t n, \
                             fmi3##name values[], size_t m)                           \
    {                                                                                 \
        (void)vr, (void)n, (void)values, (void)m;                                     \
        return complain(c, "no variables of this type");                              \
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

fmi3Status fmi3SetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t n,
                         const size_t sizes[], const fmi3Binary values[], size_t m)
{
    (void)vr, (void)n, (void)sizes, (void)values, (void)m;
    return complain(c, "no variables of this type");
}

fmi3Status fmi3GetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t n, size_t sizes[],
                         fmi3Binary values[], size_t m)
{
    (void)vr, (void)n, (void)sizes, (void)values, (void)m;
    return complain(c, "no variables of this type");
}
