/* Goes through every function of an exported FMI 3.0 FMU, with right and with wrong calls. */
#include "drive.h"
#include "fmi3Functions.h"

static int errors = 0, updates = 0;
static references u, y, dx, wrong;
static fmi3Instance stepping;

static void log_message(fmi3InstanceEnvironment environment, fmi3Status status, fmi3String category,
                        fmi3String message)
{
    (void)category, (void)message;
    CHECK(environment == &errors && status == fmi3Error);
    ++errors;
}

#define REFUSED(call)                                       \
    do {                                                    \
        const int before = errors;                          \
        CHECK((call) == fmi3Error && errors == before + 1); \
    } while (0)
#define DONE(call) CHECK((call) == fmi3OK)

/* Sets the inputs at the end of the step, and tries what is not allowed there. */
static void update(fmi3InstanceEnvironment environment, fmi3Float64 t, fmi3Boolean set,
                   fmi3Boolean get, fmi3Boolean finished, fmi3Boolean early,
                   fmi3Boolean *early_requested, fmi3Float64 *early_time)
{
    double *in = some(u.elements, 1.0 + t), *out = some(y.elements, 0.0);
    fmi3Boolean flag;
    fmi3Float64 time;
    fmi3FMUState state = NULL;
    CHECK(environment == &errors && set && !get && !finished && !early && early_requested &&
          early_time);
    DONE(fmi3SetFloat64(stepping, u.of, u.count, in, u.elements));
    REFUSED(fmi3GetFloat64(stepping, y.of, y.count, out, y.elements));
    REFUSED(fmi3GetFMUState(stepping, &state));
    REFUSED(fmi3DoStep(stepping, t, step_size(), 0, &flag, &flag, &flag, &time));
    ++updates;
    free(in), free(out);
}

static fmi3Instance co_simulation_instance(fmi3Boolean event_mode)
{
    return fmi3InstantiateCoSimulation("one", model_token, "", 0, 0, event_mode, 0, u.of, u.count,
                                       &errors, log_message, update);
}

static void begin(fmi3Instance c)
{
    double *values = some(u.elements, 1.0);
    fmi3Boolean flag;
    fmi3Float64 time;
    CHECK(c);
    REFUSED(fmi3ExitInitializationMode(c));
    REFUSED(fmi3DoStep(c, 0.0, step_size(), 0, &flag, &flag, &flag, &time));
    REFUSED(fmi3EnterConfigurationMode(c));
    REFUSED(fmi3ExitConfigurationMode(c));
    DONE(fmi3SetDebugLogging(c, 1, 0, NULL));
    DONE(fmi3EnterInitializationMode(c, 0, 0.0, 0.0, 0, 0.0));
    REFUSED(fmi3EnterInitializationMode(c, 0, 0.0, 0.0, 0, 0.0));
    DONE(fmi3SetFloat64(c, u.of, u.count, values, u.elements));
    DONE(fmi3EvaluateDiscreteStates(c));
    free(values);
}

#define NO_VARIABLES(Type)                             \
    do {                                               \
        fmi3##Type value = 0;                          \
        DONE(fmi3Get##Type(c, NULL, 0, NULL, 0));      \
        DONE(fmi3Set##Type(c, NULL, 0, NULL, 0));      \
        REFUSED(fmi3Get##Type(c, u.of, 1, &value, 1)); \
        REFUSED(fmi3Set##Type(c, u.of, 1, &value, 1)); \
    } while (0)

static void other_types(fmi3Instance c)
{
    fmi3Binary binary = NULL;
    fmi3Clock clock = 0;
    fmi3Float64 number = 0.0;
    fmi3UInt64 count = 0;
    fmi3IntervalQualifier qualifier = fmi3IntervalNotYetKnown;
    size_t size = 0;
    NO_VARIABLES(Float32);
    NO_VARIABLES(Int8);
    NO_VARIABLES(UInt8);
    NO_VARIABLES(Int16);
    NO_VARIABLES(UInt16);
    NO_VARIABLES(Int32);
    NO_VARIABLES(UInt32);
    NO_VARIABLES(Int64);
    NO_VARIABLES(UInt64);
    NO_VARIABLES(Boolean);
    NO_VARIABLES(String);
    REFUSED(fmi3GetBinary(c, u.of, 1, &size, &binary, 1));
    REFUSED(fmi3SetBinary(c, u.of, 1, &size, &binary, 1));
    REFUSED(fmi3GetClock(c, u.of, 1, &clock));
    REFUSED(fmi3SetClock(c, u.of, 1, &clock));
    REFUSED(fmi3GetIntervalDecimal(c, u.of, 1, &number, &qualifier));
    REFUSED(fmi3GetIntervalFraction(c, u.of, 1, &count, &count, &qualifier));
    REFUSED(fmi3GetShiftDecimal(c, u.of, 1, &number));
    REFUSED(fmi3GetShiftFraction(c, u.of, 1, &count, &count));
    REFUSED(fmi3SetIntervalDecimal(c, u.of, 1, &number));
    REFUSED(fmi3SetIntervalFraction(c, u.of, 1, &count, &count));
    REFUSED(fmi3SetShiftDecimal(c, u.of, 1, &number));
    REFUSED(fmi3SetShiftFraction(c, u.of, 1, &count, &count));
    REFUSED(fmi3ActivateModelPartition(c, 0, 0.0));
    REFUSED(fmi3GetNumberOfVariableDependencies(c, 0, &size));
    REFUSED(fmi3GetVariableDependencies(c, 0, &size, NULL, &size, NULL, 0));
}

static void values(fmi3Instance c)
{
    double *in = some(u.elements, 2.0), *out = some(y.elements, 0.0), *back = some(u.elements, 0.0),
           time;
    const uint32_t clock = (uint32_t)(model_m + model_p + 2 * model_n);
    const fmi3Int32 order = 1;
    DONE(fmi3SetFloat64(c, u.of, u.count, in, u.elements));
    DONE(fmi3GetFloat64(c, u.of, u.count, back, u.elements));
    CHECK(memcmp(in, back, u.elements * sizeof(double)) == 0);
    DONE(fmi3GetFloat64(c, y.of, y.count, out, y.elements));
    DONE(fmi3GetFloat64(c, &clock, 1, &time, 1));
    REFUSED(fmi3SetFloat64(c, &clock, 1, &time, 1));
    REFUSED(fmi3GetFloat64(c, y.of, y.count, out, y.elements - 1));
    REFUSED(fmi3GetFloat64(c, y.of, y.count, out, y.elements + 1));
    REFUSED(fmi3SetFloat64(c, u.of, u.count, in, u.elements - 1));
    REFUSED(fmi3GetFloat64(c, wrong.of, 1, out, 1));
    REFUSED(fmi3SetFloat64(c, wrong.of, 1, in, 1));
    DONE(fmi3GetDirectionalDerivative(c, y.of, y.count, u.of, u.count, in, u.elements, out,
                                      y.elements));
    DONE(
        fmi3GetAdjointDerivative(c, y.of, y.count, u.of, u.count, out, y.elements, in, u.elements));
    REFUSED(fmi3GetDirectionalDerivative(c, y.of, y.count, u.of, u.count, in, u.elements + 1, out,
                                         y.elements));
    REFUSED(fmi3GetDirectionalDerivative(c, y.of, y.count, u.of, u.count, in, u.elements, out,
                                         y.elements + 1));
    REFUSED(fmi3GetAdjointDerivative(c, y.of, y.count, u.of, u.count, out, y.elements + 1, in,
                                     u.elements));
    REFUSED(fmi3GetDirectionalDerivative(c, u.of, u.count, u.of, u.count, in, u.elements, back,
                                         u.elements));
    REFUSED(fmi3GetOutputDerivatives(c, y.of, 1, &order, out, 1));
    DONE(fmi3GetOutputDerivatives(c, NULL, 0, NULL, NULL, 0));
    free(in), free(out), free(back);
}

/* Gives algebraic variables: the residual shows it, y and x' follow, and their derivatives by them
 * are told. */
static void algebraic(fmi3Instance c, int may_be_set)
{
    const int32_t n_z = model_residual_form->n_z;
    int32_t first = 0;
    while (model_residual_form->of_output[first] < 0)
        ++first;
    references z = take(model_m + first, n_z), r = take(model_m + model_p + 2 * model_n + 1, n_z);
    double *given = some(z.elements, 3.0), *back = some(z.elements, 0.0),
           *rest = some(r.elements, 0.0), *found = some(dx.elements, 0.0);
    if (may_be_set)
        DONE(fmi3SetFloat64(c, z.of, z.count, given, z.elements));
    else
        REFUSED(fmi3SetFloat64(c, z.of, z.count, given, z.elements));
    REFUSED(fmi3SetFloat64(c, r.of, r.count, rest, r.elements));
    DONE(fmi3GetFloat64(c, z.of, z.count, back, z.elements));
    CHECK((memcmp(given, back, z.elements * sizeof(double)) == 0) == may_be_set);
    DONE(fmi3GetFloat64(c, r.of, r.count, rest, r.elements));
    CHECK((fabs(rest[0]) > 1e-9) == may_be_set);
    REFUSED(fmi3GetFloat64(c, r.of, r.count, rest, r.elements + 1));
    DONE(fmi3GetDirectionalDerivative(c, r.of, r.count, z.of, z.count, given, z.elements, rest,
                                      r.elements));
    DONE(fmi3GetDirectionalDerivative(c, dx.of, dx.count, z.of, z.count, given, z.elements, found,
                                      dx.elements));
    DONE(fmi3GetAdjointDerivative(c, r.of, r.count, z.of, z.count, rest, r.elements, back,
                                  z.elements));
    REFUSED(fmi3GetDirectionalDerivative(c, r.of, r.count, r.of, r.count, rest, r.elements, rest,
                                         r.elements));
    free(z.of), free(r.of), free(given), free(back), free(rest), free(found);
}

static void event_iteration(fmi3Instance c)
{
    fmi3Boolean need = 1, terminate = 1, nominals = 1, changed = 1, has_time = 1;
    fmi3Float64 time;
    DONE(fmi3UpdateDiscreteStates(c, &need, &terminate, &nominals, &changed, &has_time, &time));
    CHECK(!need && !terminate && !nominals && !changed && !has_time);
}

static void model_exchange(void)
{
    size_t n = 99, indicators = 99;
    fmi3Instance c =
        fmi3InstantiateModelExchange("one", model_token, "", 0, 0, &errors, log_message);
    fmi3Boolean event = 1, terminate = 1;
    begin(c);
    REFUSED(fmi3SetTime(c, 1.0));
    if (model_residual_form)
        algebraic(c, 0);
    DONE(fmi3ExitInitializationMode(c));
    DONE(fmi3GetNumberOfContinuousStates(c, &n));
    DONE(fmi3GetNumberOfEventIndicators(c, &indicators));
    CHECK(n == (size_t)model_n && indicators == 0);
    double *x = some(n, 1.0);
    event_iteration(c);
    REFUSED(fmi3EnterStepMode(c));
    DONE(fmi3EnterContinuousTimeMode(c));
    REFUSED(fmi3EvaluateDiscreteStates(c));
    DONE(fmi3SetTime(c, 0.5));
    DONE(fmi3GetContinuousStates(c, x, n));
    DONE(fmi3SetContinuousStates(c, x, n));
    REFUSED(fmi3GetContinuousStates(c, x, n + 1));
    REFUSED(fmi3SetContinuousStates(c, x, n + 1));
    DONE(fmi3GetContinuousStateDerivatives(c, x, n));
    REFUSED(fmi3GetContinuousStateDerivatives(c, x, n + 1));
    DONE(fmi3GetFloat64(c, dx.of, dx.count, x, n));
    DONE(fmi3GetNominalsOfContinuousStates(c, x, n));
    REFUSED(fmi3GetNominalsOfContinuousStates(c, x, n + 1));
    DONE(fmi3GetEventIndicators(c, NULL, 0));
    REFUSED(fmi3GetEventIndicators(c, x, 1));
    values(c);
    if (model_residual_form) {
        algebraic(c, 1);
        values(c);
    }
    DONE(fmi3CompletedIntegratorStep(c, 1, &event, &terminate));
    CHECK(!event && !terminate);
    DONE(fmi3EnterEventMode(c));
    REFUSED(fmi3CompletedIntegratorStep(c, 1, &event, &terminate));
    REFUSED(fmi3SetContinuousStates(c, x, n));
    DONE(fmi3Terminate(c));
    fmi3FreeInstance(c);
    free(x);
}

static double now(fmi3Instance c)
{
    const uint32_t clock = (uint32_t)(model_m + model_p + 2 * model_n);
    double time;
    DONE(fmi3GetFloat64(c, &clock, 1, &time, 1));
    return time;
}

static void steps(fmi3Instance c, int count, double *out)
{
    fmi3Boolean event = 1, terminate = 1, early = 1;
    fmi3Float64 reached;
    stepping = c;
    for (int k = 0; k < count; ++k) {
        double *in = some(u.elements, 1.0 + now(c));
        DONE(fmi3SetFloat64(c, u.of, u.count, in, u.elements));
        DONE(fmi3DoStep(c, now(c), step_size(), 0, &event, &terminate, &early, &reached));
        CHECK(!event && !terminate && !early && reached == now(c));
        free(in);
    }
    DONE(fmi3GetFloat64(c, y.of, y.count, out, y.elements));
}

static void states(fmi3Instance c, double *first, double *again)
{
    fmi3Instance other = co_simulation_instance(0);
    fmi3FMUState state = NULL, copy = NULL;
    size_t size;
    begin(other);
    DONE(fmi3GetFMUState(c, &state));
    steps(c, 7, first);
    DONE(fmi3SerializedFMUStateSize(c, state, &size));
    fmi3Byte *bytes = malloc(size);
    CHECK(bytes);
    DONE(fmi3SerializeFMUState(c, state, bytes, size));
    REFUSED(fmi3SerializeFMUState(c, state, bytes, size - 1));
    REFUSED(fmi3SerializeFMUState(c, NULL, bytes, size));
    DONE(fmi3DeserializeFMUState(other, bytes, size, &copy));
    REFUSED(fmi3DeserializeFMUState(c, bytes, size - 1, &copy));
    DONE(fmi3SetFMUState(other, copy));
    steps(other, 7, again);
    CHECK(memcmp(first, again, y.elements * sizeof(double)) == 0);
    bytes[0] ^= 1; /* of another FMU */
    REFUSED(fmi3DeserializeFMUState(c, bytes, size, &copy));
    DONE(fmi3SetFMUState(c, state));
    steps(c, 7, again);
    CHECK(memcmp(first, again, y.elements * sizeof(double)) == 0);
    DONE(fmi3FreeFMUState(c, &state));
    DONE(fmi3FreeFMUState(c, &copy));
    CHECK(!state && !copy);
    REFUSED(fmi3SetFMUState(c, NULL));
    DONE(fmi3FreeFMUState(c, &state)); /* nothing is done */
    DONE(fmi3FreeFMUState(c, NULL));
    free(bytes);
    fmi3FreeInstance(other);
}

static void refused_steps(fmi3Instance c)
{
    fmi3Boolean flag;
    fmi3Float64 reached;
    const double h = step_size(), t = now(c);
    const int answered = updates;
    REFUSED(fmi3DoStep(c, t, -h, 0, &flag, &flag, &flag, &reached));
    REFUSED(fmi3DoStep(c, t, (double)NAN, 0, &flag, &flag, &flag, &reached));
    REFUSED(fmi3DoStep(c, t + 0.5 * h, h, 0, &flag, &flag, &flag, &reached));
    if (model_step > 0.0)
        REFUSED(fmi3DoStep(c, t, 0.5 * h, 0, &flag, &flag, &flag, &reached));
    CHECK(reached == t && updates == answered);
}

static void co_simulation(fmi3Boolean event_mode)
{
    fmi3Instance c = co_simulation_instance(event_mode);
    double *first = some(y.elements, 0.0), *again = some(y.elements, 0.0);
    begin(c);
    DONE(fmi3ExitInitializationMode(c));
    REFUSED(fmi3EnterContinuousTimeMode(c));
    if (event_mode) {
        event_iteration(c);
        DONE(fmi3EnterStepMode(c));
        DONE(fmi3EnterEventMode(c));
        values(c);
        event_iteration(c);
        DONE(fmi3EnterStepMode(c));
    } else {
        REFUSED(fmi3EnterEventMode(c));
        REFUSED(fmi3EnterStepMode(c));
    }
    other_types(c);
    values(c);
    steps(c, 3, first);
    CHECK(updates >= 3);
    if (!event_mode)
        states(c, first, again);
    refused_steps(c);
    DONE(fmi3Terminate(c));
    REFUSED(fmi3Terminate(c));
    DONE(fmi3Reset(c));
    begin(c);
    fmi3FreeInstance(c);
    free(first), free(again);
}

int main(void)
{
    u = take(0, model_m), y = take(model_m, model_p), dx = take(model_m + model_p, model_n),
    wrong = take(0, 1);
    wrong.of[0] = 12345;
    CHECK(strncmp(fmi3GetVersion(), "3.0", 3) == 0);
    if (model_has_derivatives)
        model_exchange();
    else
        CHECK(!fmi3InstantiateModelExchange("one", model_token, "", 0, 0, &errors, log_message));
    co_simulation(0);
    co_simulation(1);
    CHECK(!fmi3InstantiateModelExchange("one", "another token", "", 0, 0, &errors, log_message));
    CHECK(!fmi3InstantiateModelExchange("one", "another token", "", 0, 0, NULL, NULL));
    CHECK(!fmi3InstantiateModelExchange(NULL, model_token, "", 0, 0, &errors, log_message));
    CHECK(!fmi3InstantiateScheduledExecution("one", model_token, "", 0, 0, &errors, log_message,
                                             NULL, NULL, NULL));
    fmi3FreeInstance(NULL);
    free(u.of), free(y.of), free(dx.of), free(wrong.of);
    return 0;
}
