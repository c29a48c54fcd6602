/* Goes through an exported FMU in both kinds; every CHECK that fails is the exit code. */
#include "fmi2Functions.h"
#include "model.h"

#include <stdlib.h>
#include <string.h>

#define CHECK(condition)                                                                                                        \
    do {                                                                                                                        \
        if (!(condition))                                                                                                       \
            exit(__LINE__ % 251 + 1);                                                                                           \
    } while (0)

static int errors = 0;

static void logger(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status, fmi2String category, fmi2String message, ...)
{
    (void)environment, (void)name, (void)status, (void)category;
    CHECK(strchr(message, '%') == NULL);
    ++errors;
}

static const fmi2CallbackFunctions functions = {.logger = logger};
static const fmi2ValueReference inputs[] = {0, 1}, outputs[] = {2, 3, 4, 5}, derivatives[] = {6, 7}, wrong[] = {99};

static fmi2Component begin(fmi2Type kind)
{
    fmi2Component c = fmi2Instantiate("one", kind, model_guid, "", &functions, fmi2False, fmi2False);
    CHECK(c);
    CHECK(fmi2SetupExperiment(c, 0, 0.0, 0.0, 0, 0.0) == fmi2OK);
    CHECK(fmi2EnterInitializationMode(c) == fmi2OK);
    return c;
}

static void model_exchange(void)
{
    fmi2Component c = begin(fmi2ModelExchange);
    fmi2EventInfo info;
    fmi2Boolean event, terminate;
    double x[2], y[4], one = 1.0;
    CHECK(fmi2SetTime(c, 1.0) == fmi2Error);
    CHECK(fmi2ExitInitializationMode(c) == fmi2OK && fmi2NewDiscreteStates(c, &info) == fmi2OK);
    CHECK(fmi2EnterContinuousTimeMode(c) == fmi2OK && fmi2SetTime(c, 0.5) == fmi2OK);
    CHECK(fmi2GetContinuousStates(c, x, 2) == fmi2OK && fmi2SetContinuousStates(c, x, 2) == fmi2OK);
    CHECK(fmi2GetContinuousStates(c, x, 3) == fmi2Error);
    CHECK(fmi2GetReal(c, outputs, 4, y) == fmi2OK && fmi2GetReal(c, derivatives, 2, y) == fmi2OK);
    CHECK(fmi2GetReal(c, wrong, 1, y) == fmi2Error && fmi2SetReal(c, outputs, 1, &one) == fmi2Error);
    CHECK(fmi2GetDirectionalDerivative(c, outputs, 4, inputs, 1, &one, y) == fmi2OK);
    CHECK(fmi2GetDirectionalDerivative(c, outputs, 4, wrong, 1, &one, y) == fmi2Error);
    CHECK(fmi2CompletedIntegratorStep(c, 1, &event, &terminate) == fmi2OK && !event && !terminate);
    CHECK(fmi2GetNominalsOfContinuousStates(c, x, 2) == fmi2OK && fmi2GetEventIndicators(c, NULL, 0) == fmi2OK);
    CHECK(fmi2DoStep(c, 0.0, 0.1, 1) == fmi2Error);
    CHECK(fmi2Terminate(c) == fmi2OK);
    fmi2FreeInstance(c);
}

static void co_simulation(void)
{
    fmi2Component c = begin(fmi2CoSimulation), other = begin(fmi2CoSimulation);
    fmi2FMUstate state = NULL, copy = NULL;
    const double u[] = {1.0, 2.0}, slope[] = {0.1, 0.2};
    const int order[] = {1, 1}, second[] = {2, 2};
    double first[4], again[4];
    size_t size;
    CHECK(fmi2ExitInitializationMode(c) == fmi2OK);
    CHECK(fmi2SetReal(c, inputs, 2, u) == fmi2OK && fmi2SetRealInputDerivatives(c, inputs, 2, order, slope) == fmi2OK);
    CHECK(fmi2SetRealInputDerivatives(c, inputs, 2, second, slope) == fmi2Error);
    CHECK(fmi2GetFMUstate(c, &state) == fmi2OK);
    CHECK(fmi2DoStep(c, 0.0, 0.1, 0) == fmi2OK && fmi2GetReal(c, outputs, 4, first) == fmi2OK);
    CHECK(fmi2SerializedFMUstateSize(c, state, &size) == fmi2OK);
    char *bytes = malloc(size);
    CHECK(bytes && fmi2SerializeFMUstate(c, state, bytes, size) == fmi2OK && fmi2SerializeFMUstate(c, state, bytes, 1) == fmi2Error);
    CHECK(fmi2DeSerializeFMUstate(other, bytes, size, &copy) == fmi2OK && fmi2DeSerializeFMUstate(c, bytes, 1, &copy) == fmi2Error);
    CHECK(fmi2SetFMUstate(other, copy) == fmi2OK && fmi2DoStep(other, 0.0, 0.1, 0) == fmi2OK);
    CHECK(fmi2GetReal(other, outputs, 4, again) == fmi2OK && memcmp(first, again, sizeof first) == 0);
    CHECK(fmi2DoStep(c, 0.1, -1.0, 0) == fmi2Error && fmi2DoStep(c, 0.1, 0.05, 0) == fmi2OK);
    CHECK(fmi2GetFMUstate(c, &state) == fmi2OK && fmi2Reset(c) == fmi2OK && fmi2GetReal(c, inputs, 2, first) == fmi2OK);
    CHECK(fmi2FreeFMUstate(c, &state) == fmi2OK && !state && fmi2FreeFMUstate(c, &copy) == fmi2OK);
    CHECK(fmi2SetFMUstate(c, NULL) == fmi2Error);
    CHECK(fmi2FreeFMUstate(c, &state) == fmi2OK && fmi2FreeFMUstate(c, NULL) == fmi2OK); /* nothing is done */
    free(bytes);
    fmi2FreeInstance(c);
    fmi2FreeInstance(other);
}

int main(void)
{
    model_exchange();
    co_simulation();
    CHECK(errors > 0);
    CHECK(!fmi2Instantiate("one", fmi2CoSimulation, "another GUID", "", &functions, fmi2False, fmi2False));
    fmi2FreeInstance(NULL);
    return 0;
}
