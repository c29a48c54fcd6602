/* Goes through every function of an exported FMI 2.0 FMU, with right and with wrong calls. */
#include "drive.h"
#include "fmi2Functions.h"

static int errors = 0;

static void logger(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status,
                   fmi2String category, fmi2String message, ...)
{
    (void)environment, (void)category;
    CHECK(strcmp(name, "one") == 0 && status == fmi2Error && strchr(message, '%') == NULL);
    ++errors;
}

static const fmi2CallbackFunctions functions = {.logger = logger}, silent = {0};
static references u, y, dx, wrong;

#define REFUSED(call)                                       \
    do {                                                    \
        const int before = errors;                          \
        CHECK((call) == fmi2Error && errors == before + 1); \
    } while (0)
#define DONE(call) CHECK((call) == fmi2OK)

static fmi2Component begin(fmi2Type kind)
{
    fmi2Component c =
        fmi2Instantiate("one", kind, model_token, "", &functions, fmi2False, fmi2False);
    double *values = some(u.elements, 1.0);
    CHECK(c);
    REFUSED(fmi2ExitInitializationMode(c));
    REFUSED(fmi2DoStep(c, 0.0, step_size(), 1));
    DONE(fmi2SetDebugLogging(c, 1, 0, NULL));
    DONE(fmi2SetupExperiment(c, 0, 0.0, 0.0, 0, 0.0));
    DONE(fmi2EnterInitializationMode(c));
    REFUSED(fmi2EnterInitializationMode(c));
    REFUSED(fmi2SetupExperiment(c, 0, 0.0, 0.0, 0, 0.0));
    DONE(fmi2SetReal(c, u.of, u.count, values));
    free(values);
    return c;
}

static void values(fmi2Component c)
{
    double *in = some(u.elements, 2.0), *out = some(y.elements, 0.0), *back = some(u.elements, 0.0),
           one = 1.0;
    const int32_t settable = model_state_of[0] >= 0 && model_is_exact[model_state_of[0]];
    fmi2Integer integer = 0;
    fmi2Boolean boolean = 0;
    fmi2String string = "";
    DONE(fmi2SetReal(c, u.of, u.count, in));
    DONE(fmi2GetReal(c, u.of, u.count, back));
    CHECK(memcmp(in, back, u.elements * sizeof(double)) == 0);
    DONE(fmi2GetReal(c, y.of, y.count, out));
    REFUSED(fmi2GetReal(c, wrong.of, 1, out));
    REFUSED(fmi2SetReal(c, wrong.of, 1, &one));
    if (!settable)
        REFUSED(fmi2SetReal(c, y.of, 1, &one));
    DONE(fmi2GetInteger(c, NULL, 0, NULL));
    DONE(fmi2SetString(c, NULL, 0, NULL));
    REFUSED(fmi2GetInteger(c, u.of, 1, &integer));
    REFUSED(fmi2SetInteger(c, u.of, 1, &integer));
    REFUSED(fmi2GetBoolean(c, u.of, 1, &boolean));
    REFUSED(fmi2SetBoolean(c, u.of, 1, &boolean));
    REFUSED(fmi2GetString(c, u.of, 1, &string));
    REFUSED(fmi2SetString(c, u.of, 1, &string));
    DONE(fmi2GetDirectionalDerivative(c, y.of, y.count, u.of, u.count, in, out));
    REFUSED(fmi2GetDirectionalDerivative(c, y.of, y.count, wrong.of, 1, in, out));
    REFUSED(fmi2GetDirectionalDerivative(c, u.of, 1, u.of, 1, in, out));
    REFUSED(fmi2GetRealOutputDerivatives(c, y.of, 1, &integer, out));
    DONE(fmi2GetRealOutputDerivatives(c, NULL, 0, NULL, NULL));
    free(in), free(out), free(back);
}

static void model_exchange(void)
{
    const size_t n = (size_t)model_n;
    fmi2Component c = begin(fmi2ModelExchange);
    fmi2EventInfo info;
    fmi2Boolean event, terminate;
    double *x = some(n, 1.0);
    REFUSED(fmi2SetTime(c, 1.0));
    DONE(fmi2ExitInitializationMode(c));
    DONE(fmi2NewDiscreteStates(c, &info));
    CHECK(!info.newDiscreteStatesNeeded && !info.nextEventTimeDefined);
    REFUSED(fmi2CompletedIntegratorStep(c, 1, &event, &terminate));
    DONE(fmi2EnterContinuousTimeMode(c));
    REFUSED(fmi2NewDiscreteStates(c, &info));
    DONE(fmi2SetTime(c, 0.5));
    DONE(fmi2GetContinuousStates(c, x, n));
    DONE(fmi2SetContinuousStates(c, x, n));
    REFUSED(fmi2GetContinuousStates(c, x, n + 1));
    REFUSED(fmi2SetContinuousStates(c, x, n + 1));
    REFUSED(fmi2GetDerivatives(c, x, n + 1));
    DONE(fmi2GetDerivatives(c, x, n));
    DONE(fmi2GetReal(c, dx.of, dx.count, x));
    REFUSED(fmi2GetNominalsOfContinuousStates(c, x, n + 1));
    DONE(fmi2GetNominalsOfContinuousStates(c, x, n));
    DONE(fmi2GetEventIndicators(c, NULL, 0));
    REFUSED(fmi2GetEventIndicators(c, x, 1));
    values(c);
    DONE(fmi2CompletedIntegratorStep(c, 1, &event, &terminate));
    CHECK(!event && !terminate);
    REFUSED(fmi2DoStep(c, 0.0, 0.1, 1));
    DONE(fmi2EnterEventMode(c));
    REFUSED(fmi2SetContinuousStates(c, x, n));
    DONE(fmi2Terminate(c));
    REFUSED(fmi2Terminate(c));
    fmi2FreeInstance(c);
    free(x);
}

static void steps(fmi2Component c, int count, double *out)
{
    const double h = step_size();
    fmi2Integer *order = malloc(sizeof(fmi2Integer) * u.count);
    double *in = some(u.elements, 1.0), *slope = some(u.elements, 3.0);
    CHECK(order);
    for (size_t k = 0; k < u.count; ++k)
        order[k] = 1;
    for (int k = 0; k < count; ++k) {
        double now;
        DONE(fmi2GetRealStatus(c, fmi2LastSuccessfulTime, &now));
        DONE(fmi2SetReal(c, u.of, u.count, in));
        DONE(fmi2SetRealInputDerivatives(c, u.of, u.count, order, slope));
        DONE(fmi2DoStep(c, now, h, 0));
    }
    DONE(fmi2GetReal(c, y.of, y.count, out));
    free(order), free(in), free(slope);
}

static void states(fmi2Component c, double *first, double *again)
{
    fmi2Component other = begin(fmi2CoSimulation);
    fmi2FMUstate state = NULL, copy = NULL;
    size_t size;
    DONE(fmi2GetFMUstate(c, &state));
    steps(c, 7, first);
    DONE(fmi2SerializedFMUstateSize(c, state, &size));
    char *bytes = malloc(size);
    CHECK(bytes);
    DONE(fmi2SerializeFMUstate(c, state, bytes, size));
    REFUSED(fmi2SerializeFMUstate(c, state, bytes, size - 1));
    REFUSED(fmi2SerializeFMUstate(c, NULL, bytes, size));
    DONE(fmi2DeSerializeFMUstate(other, bytes, size, &copy));
    REFUSED(fmi2DeSerializeFMUstate(c, bytes, size - 1, &copy));
    DONE(fmi2SetFMUstate(other, copy));
    steps(other, 7, again);
    CHECK(memcmp(first, again, y.elements * sizeof(double)) == 0);
    bytes[0] ^= 1; /* of another FMU */
    REFUSED(fmi2DeSerializeFMUstate(c, bytes, size, &copy));
    DONE(fmi2SetFMUstate(c, state));
    DONE(fmi2GetFMUstate(c, &state)); /* into the same memory */
    steps(c, 7, again);
    CHECK(memcmp(first, again, y.elements * sizeof(double)) == 0);
    DONE(fmi2FreeFMUstate(c, &state));
    DONE(fmi2FreeFMUstate(c, &copy));
    CHECK(!state && !copy);
    REFUSED(fmi2SetFMUstate(c, NULL));
    DONE(fmi2FreeFMUstate(c, &state)); /* nothing is done */
    DONE(fmi2FreeFMUstate(c, NULL));
    free(bytes);
    fmi2FreeInstance(other);
}

static void co_simulation(void)
{
    fmi2Component c = begin(fmi2CoSimulation);
    const double h = step_size();
    double *first = some(y.elements, 0.0), *again = some(y.elements, 0.0), slope = 1.0, now;
    fmi2Integer one = 1, two = 2, integer;
    fmi2Boolean boolean;
    fmi2Status status;
    fmi2String string;
    DONE(fmi2ExitInitializationMode(c));
    REFUSED(fmi2EnterContinuousTimeMode(c));
    REFUSED(fmi2SetTime(c, 1.0));
    values(c);
    steps(c, 3, first);
    states(c, first, again);
    DONE(fmi2GetRealStatus(c, fmi2LastSuccessfulTime, &now));
    REFUSED(fmi2DoStep(c, now, -h, 0));
    REFUSED(fmi2DoStep(c, now, (double)NAN, 0));
    REFUSED(fmi2DoStep(c, now + 0.5 * h, h, 0));
    if (model_step > 0.0)
        REFUSED(fmi2DoStep(c, now, 0.5 * h, 0));
    else
        DONE(fmi2DoStep(c, now, 0.5 * h, 0));
    REFUSED(fmi2SetRealInputDerivatives(c, u.of, 1, &two, &slope));
    REFUSED(fmi2SetRealInputDerivatives(c, y.of, 1, &one, &slope));
    REFUSED(fmi2CancelStep(c));
    CHECK(fmi2GetStatus(c, fmi2DoStepStatus, &status) == fmi2Discard);
    CHECK(fmi2GetRealStatus(c, fmi2DoStepStatus, &now) == fmi2Discard);
    CHECK(fmi2GetIntegerStatus(c, fmi2DoStepStatus, &integer) == fmi2Discard);
    DONE(fmi2GetBooleanStatus(c, fmi2Terminated, &boolean));
    CHECK(!boolean && fmi2GetBooleanStatus(c, fmi2DoStepStatus, &boolean) == fmi2Discard);
    CHECK(fmi2GetStringStatus(c, fmi2PendingStatus, &string) == fmi2Discard);
    DONE(fmi2Terminate(c));
    DONE(fmi2GetReal(c, y.of, y.count, first));
    REFUSED(fmi2SetReal(c, u.of, 1, &slope));
    DONE(fmi2Reset(c));
    DONE(fmi2GetReal(c, y.of, y.count, again));
    fmi2FreeInstance(c);
    free(first), free(again);
}

int main(void)
{
    u = take(0, model_m), y = take(model_m, model_p), dx = take(model_m + model_p, model_n),
    wrong = take(0, 1);
    wrong.of[0] = 12345;
    CHECK(strcmp(fmi2GetVersion(), "2.0") == 0 && strcmp(fmi2GetTypesPlatform(), "default") == 0);
    if (model_has_derivatives)
        model_exchange();
    else
        CHECK(!fmi2Instantiate("one", fmi2ModelExchange, model_token, "", &functions, fmi2False,
                               fmi2False));
    co_simulation();
    CHECK(!fmi2Instantiate("one", fmi2CoSimulation, "another GUID", "", &functions, fmi2False,
                           fmi2False));
    CHECK(!fmi2Instantiate("one", fmi2CoSimulation, "another GUID", "", &silent, fmi2False,
                           fmi2False));
    CHECK(!fmi2Instantiate(NULL, fmi2CoSimulation, model_token, "", &functions, fmi2False,
                           fmi2False));
    CHECK(!fmi2Instantiate("one", fmi2CoSimulation, model_token, "", NULL, fmi2False, fmi2False));
    fmi2FreeInstance(NULL);
    free(u.of), free(y.of), free(dx.of), free(wrong.of);
    return 0;
}
