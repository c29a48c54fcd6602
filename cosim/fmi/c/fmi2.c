/* A linear model as an FMI 2.0 unit, for model exchange and for co-simulation (FMI 2.0.4, sections 2.1, 3.2, 4.2).
 *
 * Value references: inputs 0..m-1, outputs m.., derivatives m+p.., states m+p+n... . Everything that changes stands in one flat
 * array of doubles, so saving, restoring and serializing an instance is one copy. Nothing is allocated after fmi2Instantiate
 * but FMU states; there are no variables outside the instance.
 *
 * Co-simulation moves the inputs in straight lines over a step (fmi2SetRealInputDerivatives, order 1) and is then exact: the
 * discretisation is that of cosim_first_order_hold, computed again only where the communication step size changes. */
#include "fmi2Functions.h"
#include "model.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { INSTANTIATED = 1, INITIALIZATION = 2, EVENT = 4, CONTINUOUS = 8, STEP = 16, TERMINATED = 32 };
#define RUNNING (EVENT | CONTINUOUS | STEP)
#define READABLE (INITIALIZATION | RUNNING | TERMINATED)
#define ANY (INSTANTIATED | READABLE)

typedef struct {
    const fmi2CallbackFunctions *functions;
    char *name;
    fmi2Type kind;
    int stale; /* outputs and derivatives are not those of the state and the inputs */
    size_t size; /* of everything that changes: values[0 .. size-1] */
    double *values, *time, *mode, *x0, *x, *u, *slope;
    double *y, *dx; /* computed */
    double h, *Ad, *B0, *B1, *work, *next;
    uint8_t *held;
} Instance;

static size_t n(void) { return (size_t)model_n; }
static size_t m(void) { return (size_t)model_m; }
static size_t p(void) { return (size_t)model_p; }

static fmi2Status fail(const Instance *i, const char *message)
{
    if (i->functions->logger)
        i->functions->logger(i->functions->componentEnvironment, i->name, fmi2Error, "logStatusError", message); /* no % in any message */
    return fmi2Error;
}

static int in_mode(const Instance *i, int modes) { return ((int)*i->mode & modes) != 0; }

#define REQUIRE(modes)                                                                                                          \
    do {                                                                                                                        \
        if (!in_mode(i, modes))                                                                                                 \
            return fail(i, "call not allowed in this mode");                                                                    \
    } while (0)

static fmi2Status to_mode(Instance *i, int mode)
{
    *i->mode = mode;
    return fmi2OK;
}

static void set_defaults(Instance *i)
{
    *i->time = 0.0;
    *i->mode = INSTANTIATED;
    memcpy(i->x0, model_X0, n() * sizeof(double));
    memcpy(i->x, model_X0, n() * sizeof(double));
    memset(i->u, 0, m() * sizeof(double));
    memset(i->slope, 0, m() * sizeof(double));
    i->stale = 1;
}

/* Outputs, derivatives and, before the run, the consistent state. */
static void update(Instance *i)
{
    if (!i->stale)
        return;
    if (in_mode(i, INSTANTIATED | INITIALIZATION)) {
        cosim_multiply(model_n, model_m, model_Xu, i->u, i->x);
        for (size_t k = 0; k < n(); ++k)
            i->x[k] = i->x0[k] + i->x[k];
    }
    cosim_multiply(model_n, model_n, model_A, i->x, i->dx);
    cosim_multiply_add(model_n, model_m, model_B, i->u, i->dx);
    cosim_multiply(model_p, model_n, model_C, i->x, i->y);
    cosim_multiply_add(model_p, model_m, model_D, i->u, i->y);
    i->stale = 0;
}

/* --- variables ----------------------------------------------------------------------------------------------------------- */

typedef enum { INPUT, OUTPUT, DERIVATIVE, STATE, UNKNOWN } Class;

static Class classify(fmi2ValueReference reference, size_t *index)
{
    const size_t counts[] = {m(), p(), n(), n()};
    *index = reference;
    for (int class = INPUT; class < UNKNOWN; ++class) {
        if (*index < counts[class])
            return (Class)class;
        *index -= counts[class];
    }
    return UNKNOWN;
}

/* The state behind a variable, or -1. */
static int32_t state_of(Class class, size_t index)
{
    if (class == STATE)
        return (int32_t)index;
    return class == OUTPUT ? model_state_of[index] : -1;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Real value[])
{
    Instance *i = c;
    REQUIRE(ANY);
    update(i);
    for (size_t k = 0; k < nvr; ++k) {
        size_t index;
        switch (classify(vr[k], &index)) {
        case INPUT: value[k] = i->u[index]; break;
        case OUTPUT: value[k] = i->y[index]; break;
        case DERIVATIVE: value[k] = i->dx[index]; break;
        case STATE: value[k] = i->x[index]; break;
        default: return fail(i, "fmi2GetReal: unknown value reference");
        }
    }
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Real value[])
{
    Instance *i = c;
    REQUIRE(INSTANTIATED | INITIALIZATION | RUNNING);
    for (size_t k = 0; k < nvr; ++k) {
        size_t index;
        const Class class = classify(vr[k], &index);
        const int32_t state = state_of(class, index);
        if (class == INPUT)
            i->u[index] = value[k];
        else if (state >= 0 && model_is_exact[state] && in_mode(i, INSTANTIATED | INITIALIZATION))
            i->x0[state] = value[k];
        else
            return fail(i, "fmi2SetReal: this variable cannot be set in this mode");
    }
    i->stale = 1;
    return fmi2OK;
}

/* There are Real variables only: the others may be asked for no variable at all. */
static fmi2Status none(const Instance *i, size_t nvr) { return nvr == 0 ? fmi2OK : fail(i, "this FMU has Real variables only"); }

fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Integer value[])
{
    (void)vr, (void)value;
    return none(c, nvr);
}

fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Boolean value[])
{
    (void)vr, (void)value;
    return none(c, nvr);
}

fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2String value[])
{
    (void)vr, (void)value;
    return none(c, nvr);
}

fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Integer value[])
{
    (void)vr, (void)value;
    return none(c, nvr);
}

fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Boolean value[])
{
    (void)vr, (void)value;
    return none(c, nvr);
}

fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2String value[])
{
    (void)vr, (void)value;
    return none(c, nvr);
}

/* --- directional derivatives: exact, the entries of A, B, C, D, Xu ---------------------------------------------------------- */

/* d(row . x)/du_j in initialization mode, where x = X0 + Xu u. */
static double through_start(const double *row, size_t j)
{
    double sum = 0.0;
    for (size_t k = 0; k < n(); ++k)
        sum += row[k] * model_Xu[k * m() + j];
    return sum;
}

static fmi2Status entry(const Instance *i, fmi2ValueReference unknown, fmi2ValueReference known, double *value)
{
    size_t row, column;
    const Class of = classify(unknown, &row), by = classify(known, &column);
    const int32_t state = state_of(by, column);
    if ((by != INPUT && state < 0) || (of != OUTPUT && of != DERIVATIVE && of != STATE))
        return fail(i, "fmi2GetDirectionalDerivative: unknowns are outputs, derivatives, states; knowns are inputs, states");
    const double *of_x = of == OUTPUT ? model_C + row * n() : model_A + row * n();
    const double *of_u = of == OUTPUT ? model_D + row * m() : model_B + row * m();
    if (of == STATE)
        *value = by == INPUT ? (in_mode(i, INITIALIZATION) ? model_Xu[row * m() + column] : 0.0) : (double)((int32_t)row == state);
    else if (by == INPUT)
        *value = of_u[column] + (in_mode(i, INITIALIZATION) ? through_start(of_x, column) : 0.0);
    else
        *value = of_x[state];
    return fmi2OK;
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknowns[], size_t n_unknowns,
                                        const fmi2ValueReference knowns[], size_t n_knowns, const fmi2Real seed[],
                                        fmi2Real sensitivity[])
{
    const Instance *i = c;
    REQUIRE(READABLE);
    for (size_t row = 0; row < n_unknowns; ++row) {
        double sum = 0.0, value;
        for (size_t column = 0; column < n_knowns; ++column) {
            const fmi2Status status = entry(i, unknowns[row], knowns[column], &value);
            if (status != fmi2OK)
                return status;
            sum += value * seed[column];
        }
        sensitivity[row] = sum;
    }
    return fmi2OK;
}

/* --- instances ----------------------------------------------------------------------------------------------------------- */

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }

static double *take(double **rest, size_t count)
{
    double *start = *rest;
    *rest += count;
    return start;
}

static int allocate(Instance *i, const char *name)
{
    const size_t N = n() + 2 * m(), changing = 2 + 2 * n() + 2 * m();
    const size_t total = changing + p() + n() + n() * n() + 2 * n() * m() + 4 * N * N + 2 * n();
    double *rest = i->values = calloc(total, sizeof(double));
    i->held = calloc(m() + 1, sizeof(uint8_t));
    i->name = calloc(strlen(name) + 1, sizeof(char));
    if (!i->values || !i->held || !i->name)
        return 0;
    strcpy(i->name, name);
    i->size = changing;
    i->time = take(&rest, 1), i->mode = take(&rest, 1);
    i->x0 = take(&rest, n()), i->x = take(&rest, n());
    i->u = take(&rest, m()), i->slope = take(&rest, m());
    i->y = take(&rest, p()), i->dx = take(&rest, n());
    i->Ad = take(&rest, n() * n()), i->B0 = take(&rest, n() * m()), i->B1 = take(&rest, n() * m());
    i->work = take(&rest, 4 * N * N), i->next = take(&rest, 2 * n());
    return 1;
}

void fmi2FreeInstance(fmi2Component c)
{
    Instance *i = c;
    if (!i)
        return;
    free(i->values);
    free(i->held);
    free(i->name);
    free(i);
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type kind, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging)
{
    (void)resources, (void)visible, (void)logging;
    if (!functions || !name || !guid)
        return NULL;
    Instance *i = calloc(1, sizeof *i);
    if (!i)
        return NULL;
    i->functions = functions;
    i->kind = kind;
    if (!allocate(i, name)) {
        fmi2FreeInstance(i);
        return NULL;
    }
    if (strcmp(guid, model_guid) != 0) {
        fail(i, "fmi2Instantiate: the GUID is not that of this binary");
        fmi2FreeInstance(i);
        return NULL;
    }
    set_defaults(i);
    return i;
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t count, const fmi2String categories[])
{
    (void)c, (void)on, (void)count, (void)categories;
    return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean with_tolerance, fmi2Real tolerance, fmi2Real start,
                               fmi2Boolean with_stop, fmi2Real stop)
{
    (void)with_tolerance, (void)tolerance, (void)with_stop, (void)stop;
    Instance *i = c;
    REQUIRE(INSTANTIATED);
    *i->time = start;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    Instance *i = c;
    REQUIRE(INSTANTIATED);
    return to_mode(i, INITIALIZATION);
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    Instance *i = c;
    REQUIRE(INITIALIZATION);
    update(i);
    return to_mode(i, i->kind == fmi2ModelExchange ? EVENT : STEP);
}

fmi2Status fmi2Terminate(fmi2Component c)
{
    Instance *i = c;
    REQUIRE(RUNNING);
    return to_mode(i, TERMINATED);
}

fmi2Status fmi2Reset(fmi2Component c)
{
    set_defaults(c);
    return fmi2OK;
}

/* --- FMU states: a copy of everything that changes -------------------------------------------------------------------------- */

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    const Instance *i = c;
    if (!*state)
        *state = malloc(i->size * sizeof(double));
    if (!*state)
        return fail(i, "fmi2GetFMUstate: out of memory");
    memcpy(*state, i->values, i->size * sizeof(double));
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state)
{
    Instance *i = c;
    if (!state)
        return fail(i, "fmi2SetFMUstate: there is no state");
    memcpy(i->values, state, i->size * sizeof(double));
    i->stale = 1;
    return fmi2OK;
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
    const Instance *i = c;
    (void)state;
    *size = i->size * sizeof(double);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size)
{
    const Instance *i = c;
    if (!state || size < i->size * sizeof(double))
        return fail(i, "fmi2SerializeFMUstate: the buffer is too small");
    memcpy(bytes, state, i->size * sizeof(double));
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state)
{
    const Instance *i = c;
    if (size != i->size * sizeof(double))
        return fail(i, "fmi2DeSerializeFMUstate: not a state of this FMU");
    if (!*state)
        *state = malloc(size);
    if (!*state)
        return fail(i, "fmi2DeSerializeFMUstate: out of memory");
    memcpy(*state, bytes, size);
    return fmi2OK;
}

/* --- model exchange ------------------------------------------------------------------------------------------------------- */

fmi2Status fmi2EnterEventMode(fmi2Component c)
{
    Instance *i = c;
    REQUIRE(EVENT | CONTINUOUS);
    return to_mode(i, EVENT);
}

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info)
{
    const Instance *i = c;
    REQUIRE(EVENT);
    memset(info, 0, sizeof *info); /* there are no discrete states and no events */
    return fmi2OK;
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c)
{
    Instance *i = c;
    REQUIRE(EVENT);
    return to_mode(i, CONTINUOUS);
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean keep, fmi2Boolean *enter_event, fmi2Boolean *terminate)
{
    (void)keep;
    const Instance *i = c;
    REQUIRE(CONTINUOUS);
    *enter_event = *terminate = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time)
{
    Instance *i = c;
    REQUIRE(EVENT | CONTINUOUS);
    *i->time = time; /* the model does not depend on it */
    return fmi2OK;
}

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t nx)
{
    Instance *i = c;
    REQUIRE(CONTINUOUS);
    if (nx != n())
        return fail(i, "fmi2SetContinuousStates: wrong number of states");
    memcpy(i->x, x, nx * sizeof(double));
    i->stale = 1;
    return fmi2OK;
}

fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t nx)
{
    Instance *i = c;
    REQUIRE(READABLE);
    if (nx != n())
        return fail(i, "fmi2GetContinuousStates: wrong number of states");
    update(i);
    memcpy(x, i->x, nx * sizeof(double));
    return fmi2OK;
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real derivatives[], size_t nx)
{
    Instance *i = c;
    REQUIRE(READABLE);
    if (nx != n())
        return fail(i, "fmi2GetDerivatives: wrong number of states");
    update(i);
    memcpy(derivatives, i->dx, nx * sizeof(double));
    return fmi2OK;
}

fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real indicators[], size_t ni)
{
    (void)indicators;
    return none(c, ni);
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real nominals[], size_t nx)
{
    const Instance *i = c;
    if (nx != n())
        return fail(i, "fmi2GetNominalsOfContinuousStates: wrong number of states");
    for (size_t k = 0; k < nx; ++k)
        nominals[k] = 1.0;
    return fmi2OK;
}

/* --- co-simulation -------------------------------------------------------------------------------------------------------- */

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Integer order[],
                                       const fmi2Real value[])
{
    Instance *i = c;
    REQUIRE(INITIALIZATION | STEP);
    for (size_t k = 0; k < nvr; ++k) {
        size_t index;
        if (classify(vr[k], &index) != INPUT || order[k] != 1)
            return fail(i, "fmi2SetRealInputDerivatives: needed an input and order 1");
        i->slope[index] = value[k];
    }
    return fmi2OK;
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Integer order[],
                                        fmi2Real value[])
{
    (void)vr, (void)order, (void)value;
    return nvr == 0 ? fmi2OK : fail(c, "fmi2GetRealOutputDerivatives: maxOutputDerivativeOrder is 0");
}

/* x(t+h) = Ad x + B0 u(t) + B1 u(t+h); the inputs then stand at their end, their derivatives are used up. */
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean keep)
{
    (void)keep;
    Instance *i = c;
    REQUIRE(STEP);
    if (!(isfinite(t) && isfinite(h) && h > 0.0))
        return fail(i, "fmi2DoStep: the communication step size must be positive and finite");
    if (h != i->h) {
        cosim_first_order_hold(model_n, model_m, model_A, model_B, h, i->held, i->Ad, i->B0, i->B1, i->work);
        i->h = h;
    }
    cosim_multiply(model_n, model_n, i->Ad, i->x, i->next);
    cosim_multiply_add(model_n, model_m, i->B0, i->u, i->next);
    for (size_t j = 0; j < m(); ++j) {
        i->u[j] += h * i->slope[j];
        i->slope[j] = 0.0;
    }
    cosim_multiply_add(model_n, model_m, i->B1, i->u, i->next);
    memcpy(i->x, i->next, n() * sizeof(double));
    *i->time = t + h;
    i->stale = 1;
    return fmi2OK;
}

fmi2Status fmi2CancelStep(fmi2Component c) { return fail(c, "fmi2CancelStep: steps are never pending"); }

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value)
{
    const Instance *i = c;
    if (kind != fmi2LastSuccessfulTime)
        return fmi2Discard;
    *value = *i->time;
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
