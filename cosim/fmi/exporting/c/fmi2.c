/* The functions of FMI 2.0, for model exchange and for co-simulation (FMI 2.0.4,
 * sections 2.1, 3.2, 4.2).
 *
 * Co-simulation interpolates the inputs linearly over a step: fmi2SetRealInputDerivatives, order 1,
 * used up by the step. */
#include "fmi2Functions.h"
#include "instance.h"

#include <stdlib.h>
#include <string.h>

/* What an fmi2Component points to. */
typedef struct {
    instance *instance;
    const fmi2CallbackFunctions *functions;
    fmi2Type interface_type;
    char *name;
} handle;

static fmi2Status fail(const handle *self, const char *message)
{
    if (self->functions->logger)
        self->functions->logger(self->functions->componentEnvironment, self->name, fmi2Error,
                                "logStatusError", message); /* no % in it */
    return fmi2Error;
}

static fmi2Status status_of(const handle *self, const char *error)
{
    return error ? fail(self, error) : fmi2OK;
}

#define REQUIRE(modes)                                          \
    do {                                                        \
        if (!instance_is_in(self->instance, modes))             \
            return fail(self, "call not allowed in this mode"); \
    } while (0)

static fmi2Status enter(const handle *self, int from, int to)
{
    REQUIRE(from);
    instance_enter(self->instance, to);
    return fmi2OK;
}

/* --- instances --- */

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }

void fmi2FreeInstance(fmi2Component c)
{
    handle *self = c;
    if (!self)
        return;
    instance_free(self->instance);
    free(self->name);
    free(self);
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type interface_type, fmi2String guid,
                              fmi2String resources, const fmi2CallbackFunctions *functions,
                              fmi2Boolean visible, fmi2Boolean logging)
{
    (void)resources, (void)visible, (void)logging;
    if (!functions || !name || !guid)
        return NULL;
    handle *self = calloc(1, sizeof *self);
    if (!self)
        return NULL;
    self->functions = functions;
    self->interface_type = interface_type;
    self->instance = instance_new();
    self->name = malloc(strlen(name) + 1);
    if (self->name)
        strcpy(self->name, name);
    if (self->name && self->instance && strcmp(guid, model_token) == 0 &&
        (interface_type == fmi2CoSimulation || model_has_derivatives))
        return self;
    if (self->name && self->instance)
        fail(self, strcmp(guid, model_token)
                       ? "fmi2Instantiate: the GUID is not that of this binary"
                       : "fmi2Instantiate: this FMU is for co-simulation only");
    fmi2FreeInstance(self);
    return NULL;
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t count,
                               const fmi2String categories[])
{
    /* errors are always logged, and there is nothing else to log */
    (void)c, (void)on, (void)count, (void)categories;
    return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean with_tolerance, fmi2Real tolerance,
                               fmi2Real start, fmi2Boolean with_stop, fmi2Real stop)
{
    (void)with_tolerance, (void)tolerance, (void)with_stop, (void)stop;
    const handle *self = c;
    REQUIRE(INSTANTIATED);
    instance_set_time(self->instance, start);
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    return enter(c, INSTANTIATED, INITIALIZATION);
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    const handle *self = c;
    REQUIRE(INITIALIZATION);
    instance_initialize(self->instance);
    instance_enter(self->instance, self->interface_type == fmi2ModelExchange ? EVENT : STEP);
    return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component c) { return enter(c, RUNNING, TERMINATED); }

fmi2Status fmi2Reset(fmi2Component c)
{
    instance_reset(((handle *)c)->instance);
    return fmi2OK;
}

/* --- variables --- */

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Real value[])
{
    const handle *self = c;
    return status_of(self, instance_get(self->instance, vr, nvr, value, nvr));
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                       const fmi2Real value[])
{
    const handle *self = c;
    return status_of(self, instance_set(self->instance, vr, nvr, value, nvr));
}

/* There are Real variables only: the others may be asked for no variable at all. */
#define NONE(Type)                                                                       \
    fmi2Status fmi2Get##Type(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, \
                             fmi2##Type value[])                                         \
    {                                                                                    \
        (void)vr, (void)value;                                                           \
        return nvr == 0 ? fmi2OK : fail(c, "this FMU has Real variables only");          \
    }                                                                                    \
    fmi2Status fmi2Set##Type(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, \
                             const fmi2##Type value[])                                   \
    {                                                                                    \
        (void)vr, (void)value;                                                           \
        return nvr == 0 ? fmi2OK : fail(c, "this FMU has Real variables only");          \
    }
NONE(Integer)
NONE(Boolean)
NONE(String)

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknowns[],
                                        size_t n_unknowns, const fmi2ValueReference knowns[],
                                        size_t n_knowns, const fmi2Real seed[],
                                        fmi2Real sensitivity[])
{
    const handle *self = c;
    return status_of(self, instance_derivative(self->instance, 0, unknowns, n_unknowns, knowns,
                                               n_knowns, seed, n_knowns, sensitivity, n_unknowns));
}

/* --- FMU states --- */

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    const handle *self = c;
    return status_of(self, instance_copy(self->instance, state));
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state)
{
    const handle *self = c;
    return status_of(self, instance_restore(self->instance, state));
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
    *size = instance_copy_size(((const handle *)c)->instance);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size)
{
    const handle *self = c;
    return status_of(self, instance_write(self->instance, state, bytes, size));
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size,
                                   fmi2FMUstate *state)
{
    const handle *self = c;
    return status_of(self, instance_read(self->instance, bytes, size, state));
}

/* --- model exchange --- */

fmi2Status fmi2EnterEventMode(fmi2Component c) { return enter(c, EVENT | CONTINUOUS, EVENT); }
fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) { return enter(c, EVENT, CONTINUOUS); }

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info)
{
    const handle *self = c;
    REQUIRE(EVENT);
    memset(info, 0, sizeof *info); /* there are no discrete states and no events */
    return fmi2OK;
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean keep, fmi2Boolean *enter_event,
                                       fmi2Boolean *terminate)
{
    (void)keep;
    const handle *self = c;
    REQUIRE(CONTINUOUS);
    *enter_event = *terminate = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time)
{
    const handle *self = c;
    REQUIRE(EVENT | CONTINUOUS);
    instance_set_time(self->instance, time);
    return fmi2OK;
}

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t nx)
{
    const handle *self = c;
    return status_of(self, instance_set_states(self->instance, x, nx));
}

fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t nx)
{
    const handle *self = c;
    return status_of(self, instance_get_states(self->instance, x, nx));
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real derivatives[], size_t nx)
{
    const handle *self = c;
    return status_of(self, instance_get_derivatives(self->instance, derivatives, nx));
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real nominals[], size_t nx)
{
    const handle *self = c;
    return status_of(self, instance_get_nominals(self->instance, nominals, nx));
}

fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real indicators[], size_t ni)
{
    (void)indicators;
    return ni == 0 ? fmi2OK : fail(c, "there are no event indicators");
}

/* --- co-simulation --- */

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                       const fmi2Integer order[], const fmi2Real value[])
{
    const handle *self = c;
    for (size_t k = 0; k < nvr; ++k) {
        const char *error = order[k] == 1 ? instance_set_slope(self->instance, vr[k], value[k])
                                          : "input derivatives are of order 1";
        if (error)
            return fail(self, error);
    }
    return fmi2OK;
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                        const fmi2Integer order[], fmi2Real value[])
{
    (void)vr, (void)order, (void)value;
    return nvr == 0 ? fmi2OK
                    : fail(c, "fmi2GetRealOutputDerivatives: maxOutputDerivativeOrder is 0");
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean keep)
{
    (void)keep;
    const handle *self = c;
    REQUIRE(STEP);
    const char *error = instance_begin_step(self->instance, t, h);
    if (error)
        return fail(self, error);
    instance_move_inputs(self->instance, h);
    return status_of(self, instance_end_step(self->instance, t, h));
}

fmi2Status fmi2CancelStep(fmi2Component c)
{
    return fail(c, "fmi2CancelStep: steps are never pending");
}

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value)
{
    if (kind != fmi2LastSuccessfulTime)
        return fmi2Discard;
    *value = *((const handle *)c)->instance->time;
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
