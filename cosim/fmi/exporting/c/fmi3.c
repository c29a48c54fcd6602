/* The functions of FMI 3.0, for model exchange and for co-simulation (FMI 3.0.2,
 * sections 2.2, 2.3, 3.2, 4.2).
 *
 * Co-simulation interpolates the inputs linearly over a step, from what was set before it to what
 * the importer sets in the one Intermediate Update, which is at the end of the step; without one
 * they are held. */
#include "fmi3Functions.h"
#include "instance.h"

#include <stdlib.h>
#include <string.h>

/* What an fmi3Instance points to. */
typedef struct {
    instance *instance;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
    fmi3IntermediateUpdateCallback intermediate_update;
    int is_co_simulation, has_event_mode; /* the importer's choice */
} handle;

static fmi3Status fail(const handle *self, const char *message)
{
    if (self->log)
        self->log(self->environment, fmi3Error, "logStatusError", message);
    return fmi3Error;
}

static fmi3Status status_of(const handle *self, const char *error)
{
    return error ? fail(self, error) : fmi3OK;
}

#define REQUIRE(modes)                                          \
    do {                                                        \
        if (!instance_is_in(self->instance, modes))             \
            return fail(self, "call not allowed in this mode"); \
    } while (0)

static fmi3Status enter(const handle *self, int from, int to)
{
    REQUIRE(from);
    instance_enter(self->instance, to);
    return fmi3OK;
}

/* --- instances --- */

const char *fmi3GetVersion(void) { return fmi3Version; }

static fmi3Instance instantiate(const handle *wanted, fmi3String name, fmi3String token,
                                const char *refused)
{
    if (!name || !token)
        return NULL;
    if (strcmp(token, model_token) != 0)
        refused = "the instantiation token is not that of this binary";
    if (refused) {
        fail(wanted, refused);
        return NULL;
    }
    handle *self = malloc(sizeof *self);
    instance *inner = instance_new();
    if (!self || !inner) {
        free(self);
        instance_free(inner);
        return NULL;
    }
    *self = *wanted;
    self->instance = inner;
    return self;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                          fmi3Boolean visible, fmi3Boolean logging,
                                          fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log)
{
    (void)resources, (void)visible, (void)logging;
    const handle wanted = {.environment = environment, .log = log};
    return instantiate(&wanted, name, token,
                       model_has_derivatives ? NULL : "this FMU is for co-simulation only");
}

fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
    fmi3Boolean logging, fmi3Boolean event_mode_used, fmi3Boolean early_return_allowed,
    const fmi3ValueReference required[], size_t n_required, fmi3InstanceEnvironment environment,
    fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback intermediate_update)
{
    (void)resources, (void)visible, (void)logging, (void)early_return_allowed, (void)required,
        (void)n_required;
    const handle wanted = {.environment = environment,
                           .log = log,
                           .intermediate_update = intermediate_update,
                           .is_co_simulation = 1,
                           .has_event_mode = event_mode_used};
    return instantiate(&wanted, name, token, NULL);
}

fmi3Instance fmi3InstantiateScheduledExecution(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
    fmi3Boolean logging, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
    fmi3ClockUpdateCallback clock_update, fmi3LockPreemptionCallback lock,
    fmi3UnlockPreemptionCallback unlock)
{
    (void)resources, (void)visible, (void)logging, (void)clock_update, (void)lock, (void)unlock;
    const handle wanted = {.environment = environment, .log = log};
    return instantiate(&wanted, name, token, "this FMU is not for scheduled execution");
}

void fmi3FreeInstance(fmi3Instance c)
{
    handle *self = c;
    if (self)
        instance_free(self->instance);
    free(self);
}

fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t count,
                               const fmi3String categories[])
{
    /* errors are always logged, and there is nothing else to log */
    (void)c, (void)on, (void)count, (void)categories;
    return fmi3OK;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean with_tolerance,
                                       fmi3Float64 tolerance, fmi3Float64 start,
                                       fmi3Boolean with_stop, fmi3Float64 stop)
{
    (void)with_tolerance, (void)tolerance, (void)with_stop, (void)stop;
    const handle *self = c;
    REQUIRE(INSTANTIATED);
    instance_set_time(self->instance, start);
    instance_enter(self->instance, INITIALIZATION);
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance c)
{
    const handle *self = c;
    REQUIRE(INITIALIZATION);
    instance_initialize(self->instance);
    instance_enter(self->instance, self->is_co_simulation && !self->has_event_mode ? STEP : EVENT);
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance c) { return enter(c, RUNNING, TERMINATED); }

fmi3Status fmi3Reset(fmi3Instance c)
{
    instance_reset(((handle *)c)->instance);
    return fmi3OK;
}

fmi3Status fmi3EnterConfigurationMode(fmi3Instance c)
{
    return fail(c, "there are no structural parameters to configure");
}
fmi3Status fmi3ExitConfigurationMode(fmi3Instance c)
{
    return fail(c, "there are no structural parameters to configure");
}

/* --- variables --- */

fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr,
                          fmi3Float64 values[], size_t n_values)
{
    const handle *self = c;
    return status_of(self, instance_get(self->instance, vr, nvr, values, n_values));
}

fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr,
                          const fmi3Float64 values[], size_t n_values)
{
    const handle *self = c;
    return status_of(self, instance_set(self->instance, vr, nvr, values, n_values));
}

/* There are Float64 variables only: the others may be asked for no variable at all. */
static fmi3Status none(const handle *self, size_t count)
{
    return count == 0 ? fmi3OK : fail(self, "this FMU has Float64 variables only");
}

#define NONE(Type)                                                                      \
    fmi3Status fmi3Get##Type(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr, \
                             fmi3##Type values[], size_t n_values)                      \
    {                                                                                   \
        (void)vr, (void)values, (void)n_values;                                         \
        return none(c, nvr);                                                            \
    }                                                                                   \
    fmi3Status fmi3Set##Type(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr, \
                             const fmi3##Type values[], size_t n_values)                \
    {                                                                                   \
        (void)vr, (void)values, (void)n_values;                                         \
        return none(c, nvr);                                                            \
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

fmi3Status fmi3GetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr, size_t sizes[],
                         fmi3Binary values[], size_t n_values)
{
    (void)vr, (void)sizes, (void)values, (void)n_values;
    return none(c, nvr);
}

fmi3Status fmi3SetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr,
                         const size_t sizes[], const fmi3Binary values[], size_t n_values)
{
    (void)vr, (void)sizes, (void)values, (void)n_values;
    return none(c, nvr);
}

fmi3Status fmi3GetClock(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr,
                        fmi3Clock values[])
{
    (void)vr, (void)values;
    return none(c, nvr);
}

fmi3Status fmi3SetClock(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr,
                        const fmi3Clock values[])
{
    (void)vr, (void)values;
    return none(c, nvr);
}

fmi3Status fmi3GetIntervalDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr,
                                  fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[])
{
    (void)vr, (void)intervals, (void)qualifiers;
    return none(c, nvr);
}

fmi3Status fmi3GetIntervalFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr,
                                   fmi3UInt64 counters[], fmi3UInt64 resolutions[],
                                   fmi3IntervalQualifier qualifiers[])
{
    (void)vr, (void)counters, (void)resolutions, (void)qualifiers;
    return none(c, nvr);
}

fmi3Status fmi3GetShiftDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr,
                               fmi3Float64 shifts[])
{
    (void)vr, (void)shifts;
    return none(c, nvr);
}

fmi3Status fmi3GetShiftFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr,
                                fmi3UInt64 counters[], fmi3UInt64 resolutions[])
{
    (void)vr, (void)counters, (void)resolutions;
    return none(c, nvr);
}

fmi3Status fmi3SetIntervalDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr,
                                  const fmi3Float64 intervals[])
{
    (void)vr, (void)intervals;
    return none(c, nvr);
}

fmi3Status fmi3SetIntervalFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr,
                                   const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
{
    (void)vr, (void)counters, (void)resolutions;
    return none(c, nvr);
}

fmi3Status fmi3SetShiftDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr,
                               const fmi3Float64 shifts[])
{
    (void)vr, (void)shifts;
    return none(c, nvr);
}

fmi3Status fmi3SetShiftFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr,
                                const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
{
    (void)vr, (void)counters, (void)resolutions;
    return none(c, nvr);
}

/* --- derivatives --- */

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference unknowns[],
                                        size_t n_unknowns, const fmi3ValueReference knowns[],
                                        size_t n_knowns, const fmi3Float64 seed[], size_t n_seed,
                                        fmi3Float64 sensitivity[], size_t n_sensitivity)
{
    const handle *self = c;
    return status_of(self, instance_derivative(self->instance, 0, unknowns, n_unknowns, knowns,
                                               n_knowns, seed, n_seed, sensitivity, n_sensitivity));
}

fmi3Status fmi3GetAdjointDerivative(fmi3Instance c, const fmi3ValueReference unknowns[],
                                    size_t n_unknowns, const fmi3ValueReference knowns[],
                                    size_t n_knowns, const fmi3Float64 seed[], size_t n_seed,
                                    fmi3Float64 sensitivity[], size_t n_sensitivity)
{
    const handle *self = c;
    return status_of(self, instance_derivative(self->instance, 1, unknowns, n_unknowns, knowns,
                                               n_knowns, seed, n_seed, sensitivity, n_sensitivity));
}

fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance c, fmi3ValueReference reference,
                                               size_t *count)
{
    (void)reference, (void)count;
    return fail(c, "providesPerElementDependencies is false");
}

fmi3Status fmi3GetVariableDependencies(fmi3Instance c, fmi3ValueReference dependent,
                                       size_t elements_of_dependent[],
                                       fmi3ValueReference independents[],
                                       size_t elements_of_independents[],
                                       fmi3DependencyKind kinds[], size_t count)
{
    (void)dependent, (void)elements_of_dependent, (void)independents,
        (void)elements_of_independents, (void)kinds, (void)count;
    return fail(c, "providesPerElementDependencies is false");
}

/* --- FMU states --- */

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state)
{
    const handle *self = c;
    return status_of(self, instance_copy(self->instance, state));
}

fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state)
{
    const handle *self = c;
    return status_of(self, instance_restore(self->instance, state));
}

fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *state)
{
    (void)c;
    if (state) {
        free(*state);
        *state = NULL;
    }
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState state, size_t *size)
{
    (void)state;
    *size = instance_copy_size(((const handle *)c)->instance);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState state, fmi3Byte bytes[], size_t size)
{
    const handle *self = c;
    return status_of(self, instance_write(self->instance, state, bytes, size));
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size,
                                   fmi3FMUState *state)
{
    const handle *self = c;
    return status_of(self, instance_read(self->instance, bytes, size, state));
}

/* --- events --- */

fmi3Status fmi3EnterEventMode(fmi3Instance c)
{
    const handle *self = c;
    return enter(self, self->is_co_simulation ? (self->has_event_mode ? STEP : 0) : CONTINUOUS,
                 EVENT);
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *need_update,
                                    fmi3Boolean *terminate, fmi3Boolean *nominals_changed,
                                    fmi3Boolean *values_changed, fmi3Boolean *has_next_event,
                                    fmi3Float64 *next_event)
{
    (void)next_event;
    const handle *self = c;
    REQUIRE(EVENT);
    *need_update = *terminate = *nominals_changed = *values_changed = *has_next_event = fmi3False;
    return fmi3OK;
}

fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance c)
{
    const handle *self = c;
    REQUIRE(INITIALIZATION | EVENT);
    return fmi3OK; /* there are none */
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *count)
{
    (void)c;
    *count = 0;
    return fmi3OK;
}

fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 indicators[], size_t count)
{
    (void)indicators;
    return count == 0 ? fmi3OK : fail(c, "there are no event indicators");
}

/* --- model exchange --- */

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c)
{
    const handle *self = c;
    return enter(self, self->is_co_simulation ? 0 : EVENT, CONTINUOUS);
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean no_set_state,
                                       fmi3Boolean *enter_event, fmi3Boolean *terminate)
{
    (void)no_set_state;
    const handle *self = c;
    REQUIRE(CONTINUOUS);
    *enter_event = *terminate = fmi3False;
    return fmi3OK;
}

fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 time)
{
    const handle *self = c;
    REQUIRE(EVENT | CONTINUOUS);
    instance_set_time(self->instance, time);
    return fmi3OK;
}

fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t nx)
{
    const handle *self = c;
    return status_of(self, instance_set_states(self->instance, x, nx));
}

fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t nx)
{
    const handle *self = c;
    return status_of(self, instance_get_states(self->instance, x, nx));
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 derivatives[], size_t nx)
{
    const handle *self = c;
    return status_of(self, instance_get_derivatives(self->instance, derivatives, nx));
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 nominals[], size_t nx)
{
    const handle *self = c;
    return status_of(self, instance_get_nominals(self->instance, nominals, nx));
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *count)
{
    (void)c;
    *count = (size_t)model_n;
    return fmi3OK;
}

/* --- co-simulation --- */

fmi3Status fmi3EnterStepMode(fmi3Instance c)
{
    const handle *self = c;
    return enter(self, self->is_co_simulation ? EVENT : 0, STEP);
}

fmi3Status fmi3GetOutputDerivatives(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr,
                                    const fmi3Int32 orders[], fmi3Float64 values[], size_t n_values)
{
    (void)vr, (void)orders, (void)values, (void)n_values;
    return nvr == 0 ? fmi3OK : fail(c, "fmi3GetOutputDerivatives: maxOutputDerivativeOrder is 0");
}

/* Call back, so that the importer sets the inputs to their values at the end of the step. */
static void update_inputs(const handle *self, double end)
{
    fmi3Boolean wants_early_return = fmi3False;
    fmi3Float64 early_return = end;
    if (!self->intermediate_update)
        return;
    instance_enter(self->instance, INTERMEDIATE);
    self->intermediate_update(self->environment, end, fmi3True, fmi3False, fmi3False, fmi3False,
                              &wants_early_return, &early_return);
    instance_enter(self->instance, STEP);
}

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean no_set_state,
                      fmi3Boolean *event_needed, fmi3Boolean *terminate, fmi3Boolean *early_return,
                      fmi3Float64 *reached)
{
    (void)no_set_state;
    const handle *self = c;
    REQUIRE(STEP);
    *event_needed = *terminate = *early_return = fmi3False;
    *reached = *self->instance->time;
    const char *error = instance_begin_step(self->instance, t, h);
    if (error)
        return fail(self, error);
    update_inputs(self, t + h);
    error = instance_end_step(self->instance, t, h);
    *reached = *self->instance->time;
    return status_of(self, error);
}

fmi3Status fmi3ActivateModelPartition(fmi3Instance c, fmi3ValueReference clock, fmi3Float64 time)
{
    (void)clock, (void)time;
    return fail(c, "this FMU is not for scheduled execution");
}
