/* A unit behind the functions of FMI 2.0, for model exchange and for co-simulation (FMI 2.0.4, sections 2.1, 3.2, 4.2).
 *
 * Co-simulation moves the inputs in straight lines over a step: fmi2SetRealInputDerivatives, order 1, used up by the step. */
#include "fmi2Functions.h"
#include "unit.h"

#include <stdlib.h>
#include <string.h>

typedef struct {
    unit *unit;
    const fmi2CallbackFunctions *functions;
    fmi2Type kind;
    char *name;
} instance;

static fmi2Status fail(const instance *i, const char *message)
{
    if (i->functions->logger)
        i->functions->logger(i->functions->componentEnvironment, i->name, fmi2Error, "logStatusError", message); /* no % in it */
    return fmi2Error;
}

static fmi2Status answer(const instance *i, const char *wrong) { return wrong ? fail(i, wrong) : fmi2OK; }

#define REQUIRE(modes)                                                                                                          \
    do {                                                                                                                        \
        if (!unit_is_in(i->unit, modes))                                                                                        \
            return fail(i, "call not allowed in this mode");                                                                    \
    } while (0)

static fmi2Status move(const instance *i, int from, int to)
{
    REQUIRE(from);
    unit_to(i->unit, to);
    return fmi2OK;
}

/* --- instances ----------------------------------------------------------------------------------------------------------- */

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }

void fmi2FreeInstance(fmi2Component c)
{
    instance *i = c;
    if (!i)
        return;
    unit_free(i->unit);
    free(i->name);
    free(i);
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type kind, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging)
{
    (void)resources, (void)visible, (void)logging;
    if (!functions || !name || !guid)
        return NULL;
    instance *i = calloc(1, sizeof *i);
    if (!i)
        return NULL;
    i->functions = functions, i->kind = kind, i->unit = unit_new(), i->name = malloc(strlen(name) + 1);
    if (i->name)
        strcpy(i->name, name);
    if (i->name && i->unit && strcmp(guid, model_token) == 0 && (kind == fmi2CoSimulation || model_has_derivatives))
        return i;
    if (i->name && i->unit)
        fail(i, strcmp(guid, model_token) ? "fmi2Instantiate: the GUID is not that of this binary"
                                          : "fmi2Instantiate: this FMU is for co-simulation only");
    fmi2FreeInstance(i);
    return NULL;
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t count, const fmi2String categories[])
{
    (void)c, (void)on, (void)count, (void)categories; /* errors are always told, and there is nothing else to tell */
    return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean with_tolerance, fmi2Real tolerance, fmi2Real start,
                               fmi2Boolean with_stop, fmi2Real stop)
{
    (void)with_tolerance, (void)tolerance, (void)with_stop, (void)stop;
    const instance *i = c;
    REQUIRE(INSTANTIATED);
    unit_set_time(i->unit, start);
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return move(c, INSTANTIATED, INITIALIZATION); }

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    const instance *i = c;
    REQUIRE(INITIALIZATION);
    unit_end_start(i->unit);
    unit_to(i->unit, i->kind == fmi2ModelExchange ? EVENT : STEP);
    return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component c) { return move(c, RUNNING, TERMINATED); }

fmi2Status fmi2Reset(fmi2Component c)
{
    unit_reset(((instance *)c)->unit);
    return fmi2OK;
}

/* --- variables ----------------------------------------------------------------------------------------------------------- */

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Real value[])
{
    const instance *i = c;
    return answer(i, unit_get(i->unit, vr, nvr, value, nvr));
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Real value[])
{
    const instance *i = c;
    return answer(i, unit_set(i->unit, vr, nvr, value, nvr));
}

/* There are Real variables only: the others may be asked for no variable at all. */
#define NONE(Type)                                                                                                              \
    fmi2Status fmi2Get##Type(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2##Type value[])                    \
    {                                                                                                                           \
        (void)vr, (void)value;                                                                                                  \
        return nvr == 0 ? fmi2OK : fail(c, "this FMU has Real variables only");                                                 \
    }                                                                                                                           \
    fmi2Status fmi2Set##Type(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2##Type value[])              \
    {                                                                                                                           \
        (void)vr, (void)value;                                                                                                  \
        return nvr == 0 ? fmi2OK : fail(c, "this FMU has Real variables only");                                                 \
    }
NONE(Integer)
NONE(Boolean)
NONE(String)

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknowns[], size_t n_unknowns,
                                        const fmi2ValueReference knowns[], size_t n_knowns, const fmi2Real seed[],
                                        fmi2Real sensitivity[])
{
    const instance *i = c;
    return answer(i, unit_derivative(i->unit, 0, unknowns, n_unknowns, knowns, n_knowns, seed, n_knowns, sensitivity, n_unknowns));
}

/* --- FMU states ----------------------------------------------------------------------------------------------------------- */

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    const instance *i = c;
    return answer(i, unit_copy(i->unit, state));
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state)
{
    const instance *i = c;
    return answer(i, unit_restore(i->unit, state));
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    (void)c;
    if (state) {
        free(*state);
        *state = NULL;
    }
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size)
{
    (void)state;
    *size = unit_copy_size(((const instance *)c)->unit);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size)
{
    const instance *i = c;
    return answer(i, unit_write(i->unit, state, bytes, size));
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state)
{
    const instance *i = c;
    return answer(i, unit_read(i->unit, bytes, size, state));
}

/* --- model exchange ------------------------------------------------------------------------------------------------------- */

fmi2Status fmi2EnterEventMode(fmi2Component c) { return move(c, EVENT | CONTINUOUS, EVENT); }
fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) { return move(c, EVENT, CONTINUOUS); }

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info)
{
    const instance *i = c;
    REQUIRE(EVENT);
    memset(info, 0, sizeof *info); /* there are no discrete states and no events */
    return fmi2OK;
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean keep, fmi2Boolean *enter_event, fmi2Boolean *terminate)
{
    (void)keep;
    const instance *i = c;
    REQUIRE(CONTINUOUS);
    *enter_event = *terminate = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time)
{
    const instance *i = c;
    REQUIRE(EVENT | CONTINUOUS);
    unit_set_time(i->unit, time);
    return fmi2OK;
}

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t nx)
{
    const instance *i = c;
    return answer(i, unit_set_states(i->unit, x, nx));
}

fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t nx)
{
    const instance *i = c;
    return answer(i, unit_get_states(i->unit, x, nx));
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real derivatives[], size_t nx)
{
    const instance *i = c;
    return answer(i, unit_get_derivatives(i->unit, derivatives, nx));
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real nominals[], size_t nx)
{
    const instance *i = c;
    return answer(i, unit_get_nominals(i->unit, nominals, nx));
}

fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real indicators[], size_t ni)
{
    (void)indicators;
    return ni == 0 ? fmi2OK : fail(c, "there are no event indicators");
}

/* --- co-simulation -------------------------------------------------------------------------------------------------------- */

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Integer order[],
                                       const fmi2Real value[])
{
    const instance *i = c;
    for (size_t k = 0; k < nvr; ++k) {
        const char *wrong = order[k] == 1 ? unit_set_slope(i->unit, vr[k], value[k]) : "input derivatives are of order 1";
        if (wrong)
            return fail(i, wrong);
    }
    return fmi2OK;
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Integer order[],
                                        fmi2Real value[])
{
    (void)vr, (void)order, (void)value;
    return nvr == 0 ? fmi2OK : fail(c, "fmi2GetRealOutputDerivatives: maxOutputDerivativeOrder is 0");
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean keep)
{
    (void)keep;
    const instance *i = c;
    REQUIRE(STEP);
    const char *wrong = unit_begin_step(i->unit, t, h);
    if (wrong)
        return fail(i, wrong);
    unit_move_inputs(i->unit, h);
    return answer(i, unit_end_step(i->unit, t, h));
}

fmi2Status fmi2CancelStep(fmi2Component c) { return fail(c, "fmi2CancelStep: steps are never pending"); }

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value)
{
    if (kind != fmi2LastSuccessfulTime)
        return fmi2Discard;
    *value = *((const instance *)c)->unit->time;
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Integer *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value)
{
    (void)c;
    if (kind != fmi2Terminated)
        return fmi2Discard;
    *value = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind kind, fmi2String *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}
