/* A unit behind the functions of FMI 3.0, for model exchange and for co-simulation (FMI 3.0.2, sections 2.2, 2.3, 3.2, 4.2).
 *
 * Co-simulation moves the inputs in straight lines over a step, from what was set before it to what the importer sets in the one
 * Intermediate Update, which stands for the end of the step; without one they hold. */
#include "fmi3Functions.h"
#include "unit.h"

#include <stdlib.h>
#include <string.h>

typedef struct {
    unit *unit;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
    fmi3IntermediateUpdateCallback intermediate_update;
    int is_co_simulation, has_event_mode; /* the importer's choice */
} instance;

static fmi3Status fail(const instance *i, const char *message)
{
    if (i->log)
        i->log(i->environment, fmi3Error, "logStatusError", message);
    return fmi3Error;
}

static fmi3Status answer(const instance *i, const char *wrong) { return wrong ? fail(i, wrong) : fmi3OK; }

#define REQUIRE(modes)                                                                                                          \
    do {                                                                                                                        \
        if (!unit_is_in(i->unit, modes))                                                                                        \
            return fail(i, "call not allowed in this mode");                                                                    \
    } while (0)

static fmi3Status move(const instance *i, int from, int to)
{
    REQUIRE(from);
    unit_to(i->unit, to);
    return fmi3OK;
}

/* --- instances ----------------------------------------------------------------------------------------------------------- */

const char *fmi3GetVersion(void) { return fmi3Version; }

static fmi3Instance instantiate(const instance *wanted, fmi3String name, fmi3String token, const char *refused)
{
    if (!name || !token)
        return NULL;
    if (strcmp(token, model_token) != 0)
        refused = "the instantiation token is not that of this binary";
    if (refused) {
        fail(wanted, refused);
        return NULL;
    }
    instance *i = malloc(sizeof *i);
    unit *u = unit_new();
    if (!i || !u) {
        free(i);
        unit_free(u);
        return NULL;
    }
    *i = *wanted;
    i->unit = u;
    return i;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                          fmi3Boolean logging, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log)
{
    (void)resources, (void)visible, (void)logging;
    const instance wanted = {.environment = environment, .log = log};
    return instantiate(&wanted, name, token, model_has_derivatives ? NULL : "this FMU is for co-simulation only");
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean event_mode_used, fmi3Boolean early_return_allowed,
                                         const fmi3ValueReference required[], size_t n_required,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback intermediate_update)
{
    (void)resources, (void)visible, (void)logging, (void)early_return_allowed, (void)required, (void)n_required;
    const instance wanted = {.environment = environment, .log = log, .intermediate_update = intermediate_update,
                             .is_co_simulation = 1, .has_event_mode = event_mode_used};
    return instantiate(&wanted, name, token, NULL);
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                               fmi3Boolean logging, fmi3InstanceEnvironment environment,
                                               fmi3LogMessageCallback log, fmi3ClockUpdateCallback clock_update,
                                               fmi3LockPreemptionCallback lock, fmi3UnlockPreemptionCallback unlock)
{
    (void)resources, (void)visible, (void)logging, (void)clock_update, (void)lock, (void)unlock;
    const instance wanted = {.environment = environment, .log = log};
    return instantiate(&wanted, name, token, "this FMU is not for scheduled execution");
}

void fmi3FreeInstance(fmi3Instance c)
{
    instance *i = c;
    if (i)
        unit_free(i->unit);
    free(i);
}

fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t count, const fmi3String categories[])
{
    (void)c, (void)on, (void)count, (void)categories; /* errors are always told, and there is nothing else to tell */
    return fmi3OK;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean with_tolerance, fmi3Float64 tolerance, fmi3Float64 start,
                                       fmi3Boolean with_stop, fmi3Float64 stop)
{
    (void)with_tolerance, (void)tolerance, (void)with_stop, (void)stop;
    const instance *i = c;
    REQUIRE(INSTANTIATED);
    unit_set_time(i->unit, start);
    unit_to(i->unit, INITIALIZATION);
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance c)
{
    const instance *i = c;
    REQUIRE(INITIALIZATION);
    unit_end_start(i->unit);
    unit_to(i->unit, i->is_co_simulation && !i->has_event_mode ? STEP : EVENT);
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance c) { return move(c, RUNNING, TERMINATED); }

fmi3Status fmi3Reset(fmi3Instance c)
{
    unit_reset(((instance *)c)->unit);
    return fmi3OK;
}

fmi3Status fmi3EnterConfigurationMode(fmi3Instance c) { return fail(c, "there are no structural parameters to configure"); }
fmi3Status fmi3ExitConfigurationMode(fmi3Instance c) { return fail(c, "there are no structural parameters to configure"); }

/* --- variables ----------------------------------------------------------------------------------------------------------- */

fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr, fmi3Float64 values[], size_t n_values)
{
    const instance *i = c;
    return answer(i, unit_get(i->unit, vr, nvr, values, n_values));
}

fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr, const fmi3Float64 values[], size_t n_values)
{
    const instance *i = c;
    return answer(i, unit_set(i->unit, vr, nvr, values, n_values));
}

/* There are Float64 variables only: the others may be asked for no variable at all. */
static fmi3Status none(const instance *i, size_t count) { return count == 0 ? fmi3OK : fail(i, "this FMU has Float64 variables only"); }

#define NONE(Type)                                                                                                              \
    fmi3Status fmi3Get##Type(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr, fmi3##Type values[], size_t n_values)   \
    {                                                                                                                           \
        (void)vr, (void)values, (void)n_values;                                                                                 \
        return none(c, nvr);                                                                                                    \
    }                                                                                                                           \
    fmi3Status fmi3Set##Type(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr, const fmi3##Type values[],              \
                             size_t n_values)                                                                                   \
    {                                                                                                                           \
        (void)vr, (void)values, (void)n_values;                                                                                 \
        return none(c, nvr);                                                                                                    \
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

fmi3Status fmi3GetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr, size_t sizes[], fmi3Binary values[],
                         size_t n_values)
{
    (void)vr, (void)sizes, (void)values, (void)n_values;
    return none(c, nvr);
}

fmi3Status fmi3SetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr, const size_t sizes[],
                         const fmi3Binary values[], size_t n_values)
{
    (void)vr, (void)sizes, (void)values, (void)n_values;
    return none(c, nvr);
}

fmi3Status fmi3GetClock(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr, fmi3Clock values[])
{
    (void)vr, (void)values;
    return none(c, nvr);
}

fmi3Status fmi3SetClock(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr, const fmi3Clock values[])
{
    (void)vr, (void)values;
    return none(c, nvr);
}

fmi3Status fmi3GetIntervalDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr, fmi3Float64 intervals[],
                                  fmi3IntervalQualifier qualifiers[])
{
    (void)vr, (void)intervals, (void)qualifiers;
    return none(c, nvr);
}

fmi3Status fmi3GetIntervalFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr, fmi3UInt64 counters[],
                                   fmi3UInt64 resolutions[], fmi3IntervalQualifier qualifiers[])
{
    (void)vr, (void)counters, (void)resolutions, (void)qualifiers;
    return none(c, nvr);
}

fmi3Status fmi3GetShiftDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr, fmi3Float64 shifts[])
{
    (void)vr, (void)shifts;
    return none(c, nvr);
}

fmi3Status fmi3GetShiftFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr, fmi3UInt64 counters[],
                                fmi3UInt64 resolutions[])
{
    (void)vr, (void)counters, (void)resolutions;
    return none(c, nvr);
}

fmi3Status fmi3SetIntervalDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr, const fmi3Float64 intervals[])
{
    (void)vr, (void)intervals;
    return none(c, nvr);
}

fmi3Status fmi3SetIntervalFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr, const fmi3UInt64 counters[],
                                   const fmi3UInt64 resolutions[])
{
    (void)vr, (void)counters, (void)resolutions;
    return none(c, nvr);
}

fmi3Status fmi3SetShiftDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr, const fmi3Float64 shifts[])
{
    (void)vr, (void)shifts;
    return none(c, nvr);
}

fmi3Status fmi3SetShiftFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr, const fmi3UInt64 counters[],
                                const fmi3UInt64 resolutions[])
{
    (void)vr, (void)counters, (void)resolutions;
    return none(c, nvr);
}

/* --- derivatives ----------------------------------------------------------------------------------------------------------- */

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference unknowns[], size_t n_unknowns,
                                        const fmi3ValueReference knowns[], size_t n_knowns, const fmi3Float64 seed[],
                                        size_t n_seed, fmi3Float64 sensitivity[], size_t n_sensitivity)
{
    const instance *i = c;
    return answer(i, unit_derivative(i->unit, 0, unknowns, n_unknowns, knowns, n_knowns, seed, n_seed, sensitivity, n_sensitivity));
}

fmi3Status fmi3GetAdjointDerivative(fmi3Instance c, const fmi3ValueReference unknowns[], size_t n_unknowns,
                                    const fmi3ValueReference knowns[], size_t n_knowns, const fmi3Float64 seed[], size_t n_seed,
                                    fmi3Float64 sensitivity[], size_t n_sensitivity)
{
    const instance *i = c;
    return answer(i, unit_derivative(i->unit, 1, unknowns, n_unknowns, knowns, n_knowns, seed, n_seed, sensitivity, n_sensitivity));
}

fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance c, fmi3ValueReference reference, size_t *count)
{
    (void)reference, (void)count;
    return fail(c, "providesPerElementDependencies is false");
}

fmi3Status fmi3GetVariableDependencies(fmi3Instance c, fmi3ValueReference dependent, size_t elements_of_dependent[],
                                       fmi3ValueReference independents[], size_t elements_of_independents[],
                                       fmi3DependencyKind kinds[], size_t count)
{
    (void)dependent, (void)elements_of_dependent, (void)independents, (void)elements_of_independents, (void)kinds, (void)count;
    return fail(c, "providesPerElementDependencies is false");
}

/* --- FMU states ----------------------------------------------------------------------------------------------------------- */

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state)
{
    const instance *i = c;
    return answer(i, unit_copy(i->unit, state));
}

fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state)
{
    const instance *i = c;
    return answer(i, unit_restore(i->unit, state));
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
    *size = unit_copy_size(((const instance *)c)->unit);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState state, fmi3Byte bytes[], size_t size)
{
    const instance *i = c;
    return answer(i, unit_write(i->unit, state, bytes, size));
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size, fmi3FMUState *state)
{
    const instance *i = c;
    return answer(i, unit_read(i->unit, bytes, size, state));
}

/* --- events ---------------------------------------------------------------------------------------------------------------- */

fmi3Status fmi3EnterEventMode(fmi3Instance c)
{
    const instance *i = c;
    return move(i, i->is_co_simulation ? (i->has_event_mode ? STEP : 0) : CONTINUOUS, EVENT);
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *need_update, fmi3Boolean *terminate, fmi3Boolean *nominals_changed,
                                    fmi3Boolean *values_changed, fmi3Boolean *has_next_event, fmi3Float64 *next_event)
{
    (void)next_event;
    const instance *i = c;
    REQUIRE(EVENT);
    *need_update = *terminate = *nominals_changed = *values_changed = *has_next_event = fmi3False;
    return fmi3OK;
}

fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance c)
{
    const instance *i = c;
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

/* --- model exchange ------------------------------------------------------------------------------------------------------- */

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c)
{
    const instance *i = c;
    return move(i, i->is_co_simulation ? 0 : EVENT, CONTINUOUS);
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean no_set_state, fmi3Boolean *enter_event, fmi3Boolean *terminate)
{
    (void)no_set_state;
    const instance *i = c;
    REQUIRE(CONTINUOUS);
    *enter_event = *terminate = fmi3False;
    return fmi3OK;
}

fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 time)
{
    const instance *i = c;
    REQUIRE(EVENT | CONTINUOUS);
    unit_set_time(i->unit, time);
    return fmi3OK;
}

fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t nx)
{
    const instance *i = c;
    return answer(i, unit_set_states(i->unit, x, nx));
}

fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t nx)
{
    const instance *i = c;
    return answer(i, unit_get_states(i->unit, x, nx));
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 derivatives[], size_t nx)
{
    const instance *i = c;
    return answer(i, unit_get_derivatives(i->unit, derivatives, nx));
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 nominals[], size_t nx)
{
    const instance *i = c;
    return answer(i, unit_get_nominals(i->unit, nominals, nx));
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *count)
{
    (void)c;
    *count = (size_t)model_n;
    return fmi3OK;
}

/* --- co-simulation -------------------------------------------------------------------------------------------------------- */

fmi3Status fmi3EnterStepMode(fmi3Instance c)
{
    const instance *i = c;
    return move(i, i->is_co_simulation ? EVENT : 0, STEP);
}

fmi3Status fmi3GetOutputDerivatives(fmi3Instance c, const fmi3ValueReference vr[], size_t nvr, const fmi3Int32 orders[],
                                    fmi3Float64 values[], size_t n_values)
{
    (void)vr, (void)orders, (void)values, (void)n_values;
    return nvr == 0 ? fmi3OK : fail(c, "fmi3GetOutputDerivatives: maxOutputDerivativeOrder is 0");
}

/* Let the importer move the inputs to their values at the end of the step. */
static void update_inputs(const instance *i, double end)
{
    fmi3Boolean wants_early_return = fmi3False;
    fmi3Float64 early_return = end;
    if (!i->intermediate_update)
        return;
    unit_to(i->unit, INTERMEDIATE);
    i->intermediate_update(i->environment, end, fmi3True, fmi3False, fmi3False, fmi3False, &wants_early_return, &early_return);
    unit_to(i->unit, STEP);
}

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 t, fmi3Float64 h, fmi3Boolean no_set_state, fmi3Boolean *event_needed,
                      fmi3Boolean *terminate, fmi3Boolean *early_return, fmi3Float64 *reached)
{
    (void)no_set_state;
    const instance *i = c;
    REQUIRE(STEP);
    *event_needed = *terminate = *early_return = fmi3False;
    *reached = *i->unit->time;
    const char *wrong = unit_begin_step(i->unit, t, h);
    if (wrong)
        return fail(i, wrong);
    update_inputs(i, t + h);
    wrong = unit_end_step(i->unit, t, h);
    *reached = *i->unit->time;
    return answer(i, wrong);
}

fmi3Status fmi3ActivateModelPartition(fmi3Instance c, fmi3ValueReference clock, fmi3Float64 time)
{
    (void)clock, (void)time;
    return fail(c, "this FMU is not for scheduled execution");
}
