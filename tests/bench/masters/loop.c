/* The floor: lags behind FMI 2 or FMI 3 (-DFMI=2, 3), stepped in a plain loop over their function
 * pointers. What is done, and in which order, is what cosim does, so that the values are the same to
 * the last bit.
 *
 *     loop METHOD STEP_NS STEPS SAMPLES (LIBRARY SOURCE)...
 *
 * METHOD: cs, rk4, RK45. SAMPLES: steps whose outputs are printed, with commas. LIBRARY: the binary
 * of an FMU; SOURCE: the number of the lag that drives it, -1: none.
 *
 * A lag whose source comes later in a step (Gauss-Seidel) keeps its input from the start of the step;
 * any other is driven by linear interpolation, in co-simulation by the latest value. All inputs
 * and outputs of all steps are kept in memory that the loop touches first. Prints the
 * processor time [s] of the loop, and the samples: see drivers/protocol.py. */
#if FMI == 2
#include "fmi2Functions.h"
#define F(name) fmi2##name
#define GetDerivatives_ "fmi2GetDerivatives"
#define SetReal_ "fmi2SetReal"
#define GetReal_ "fmi2GetReal"
#else
#include "fmi3Functions.h"
#define F(name) fmi3##name
#define fmi3Component fmi3Instance
#define fmi3SetRealTYPE fmi3SetFloat64TYPE
#define fmi3GetRealTYPE fmi3GetFloat64TYPE
#define fmi3GetDerivativesTYPE fmi3GetContinuousStateDerivativesTYPE
#define GetDerivatives_ "fmi3GetContinuousStateDerivatives"
#define SetReal_ "fmi3SetFloat64"
#define GetReal_ "fmi3GetFloat64"
#endif
#include "program.h"
#include "runge_kutta.h"

#include <dlfcn.h>
#include <math.h>
#include <stdbool.h>

#define RTOL 1e-9
#define COLUMNS 2 /* of a lag: u, y */

static const unsigned u_reference[] = {0}, y_reference[] = {1};

typedef struct {
    F(Component) instance;
    int source; /* -1: none */
    bool held;  /* the source has not reached the end of the step yet */
    F(SetRealTYPE) *set;
    F(GetRealTYPE) *get;
    F(DoStepTYPE) *step;
    F(SetTimeTYPE) *set_time;
    F(SetContinuousStatesTYPE) *set_states;
    F(GetContinuousStatesTYPE) *get_states;
    F(GetDerivativesTYPE) *derivatives;
    F(CompletedIntegratorStepTYPE) *completed;
    F(EnterEventModeTYPE) *enter_event_mode;
    F(EnterContinuousTimeModeTYPE) *enter_continuous_time_mode;
    void *update;
    /* model exchange: the step, the state, the time and the inputs that the FMU has */
    double t0, t1, u0, u1, x, t_set, u_set;
    cosim_runge_kutta solver;
} Lag;

static void *function(void *library, const char *name)
{
    void *address = dlsym(library, name);
    if (!address)
        fail(name);
    return address;
}

/* --- what differs between the versions --- */

#if FMI == 2
static void silent(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status,
                   fmi2String category, fmi2String message, ...)
{
    (void)environment, (void)name, (void)status, (void)category, (void)message;
}
static const fmi2CallbackFunctions callbacks = {.logger = silent,
                                                .allocateMemory = calloc,
                                                .freeMemory = free};

static void instantiate(Lag *lag, void *library, bool steps)
{
    fmi2InstantiateTYPE *create = function(library, "fmi2Instantiate");
    fmi2SetupExperimentTYPE *setup = function(library, "fmi2SetupExperiment");
    fmi2EnterInitializationModeTYPE *enter = function(library, "fmi2EnterInitializationMode");
    fmi2ExitInitializationModeTYPE *leave = function(library, "fmi2ExitInitializationMode");
    lag->instance = create("lag", steps ? fmi2CoSimulation : fmi2ModelExchange, "lag", "", &callbacks,
                           fmi2False, fmi2False);
    lag->update = function(library, "fmi2NewDiscreteStates");
    if (!lag->instance || setup(lag->instance, 0, 0.0, 0.0, 0, 0.0) || enter(lag->instance) ||
        leave(lag->instance))
        fail("cannot initialize");
}
static int set(Lag *lag, double u) { return lag->set(lag->instance, u_reference, 1, &u); }
static int get(Lag *lag, double *y) { return lag->get(lag->instance, y_reference, 1, y); }
static int do_step(Lag *lag, double t, double h)
{
    return lag->step(lag->instance, t, h, fmi2True);
}
static int completed(Lag *lag)
{
    fmi2Boolean event, terminate;
    return lag->completed(lag->instance, fmi2True, &event, &terminate) || event || terminate;
}
static int update(Lag *lag)
{
    fmi2EventInfo info;
    do {
        if (((fmi2NewDiscreteStatesTYPE *)lag->update)(lag->instance, &info))
            return 1;
    } while (info.newDiscreteStatesNeeded);
    return 0;
}
#else
static void instantiate(Lag *lag, void *library, bool steps)
{
    fmi3InstantiateModelExchangeTYPE *model =
        function(library, "fmi3InstantiateModelExchange");
    fmi3InstantiateCoSimulationTYPE *create = function(library, "fmi3InstantiateCoSimulation");
    fmi3EnterInitializationModeTYPE *enter = function(library, "fmi3EnterInitializationMode");
    fmi3ExitInitializationModeTYPE *leave = function(library, "fmi3ExitInitializationMode");
    if (steps)
        lag->instance = create("lag", "lag", "", false, false, false, false, NULL, 0, NULL, NULL,
                               NULL);
    else
        lag->instance = model("lag", "lag", "", false, false, NULL, NULL);
    lag->update = function(library, "fmi3UpdateDiscreteStates");
    if (!lag->instance || enter(lag->instance, false, 0.0, 0.0, false, 0.0) || leave(lag->instance))
        fail("cannot initialize");
}
static int set(Lag *lag, double u) { return lag->set(lag->instance, u_reference, 1, &u, 1); }
static int get(Lag *lag, double *y) { return lag->get(lag->instance, y_reference, 1, y, 1); }
static int do_step(Lag *lag, double t, double h)
{
    bool event, terminate, early;
    double reached;
    return lag->step(lag->instance, t, h, true, &event, &terminate, &early, &reached) || event ||
           terminate || early;
}
static int completed(Lag *lag)
{
    bool event, terminate;
    return lag->completed(lag->instance, true, &event, &terminate) || event || terminate;
}
static int update(Lag *lag)
{
    bool needed, terminate, nominals, values, has_next;
    double next;
    do {
        if (((fmi3UpdateDiscreteStatesTYPE *)lag->update)(lag->instance, &needed, &terminate,
                                                          &nominals, &values, &has_next, &next))
            return 1;
    } while (needed);
    return 0;
}
#endif

/* --- model exchange --- */

/* The input at t, by linear interpolation. */
static double input(const Lag *lag, double t)
{
    if (t >= lag->t1)
        return lag->u1;
    if (t <= lag->t0)
        return lag->u0;
    return lag->u0 + (t - lag->t0) / (lag->t1 - lag->t0) * (lag->u1 - lag->u0);
}

/* Time and input are set where they change only. */
static int set_point(Lag *lag, double t, const double *x)
{
    if (t != lag->t_set) {
        if (lag->set_time(lag->instance, t) || set(lag, input(lag, t)))
            return 1;
        lag->t_set = t;
    }
    return lag->set_states(lag->instance, x, 1);
}

static int32_t right_hand_side(void *self, double t, const double *x, double *dx)
{
    Lag *lag = self;
    return set_point(lag, t, x) || lag->derivatives(lag->instance, dx, 1) ? -1 : 0;
}

/* A new value of an input that is held is an event. */
static int event(Lag *lag, double t, double u)
{
    const double nominal = 1.0;
    if (lag->enter_event_mode(lag->instance) || set(lag, u) || update(lag) ||
        lag->enter_continuous_time_mode(lag->instance) ||
        lag->get_states(lag->instance, &lag->x, 1))
        return 1;
    lag->t_set = NAN;
    lag->u_set = u;
    return lag->solver.method ? cosim_runge_kutta_start(&lag->solver, t, &lag->x, &nominal) : 0;
}

/* Begin a communication step. */
static int begin(Lag *lag, double t0, double t1, double u0, double u1)
{
    if (lag->held && u0 != lag->u_set && event(lag, t0, u0))
        return 1;
    lag->t0 = t0;
    lag->t1 = t1;
    lag->u0 = u0;
    lag->u1 = u1;
    return 0;
}

/* Classic Runge-Kutta. */
static int rk4(Lag *lag, double t0, double t1)
{
    const double h = t1 - t0, middle = t0 + 0.5 * h, x0 = lag->x;
    double k[4], x = x0;
    if (right_hand_side(lag, t0, &x, &k[0]))
        return 1;
    x = x0 + h * (0.5 * k[0]);
    if (right_hand_side(lag, middle, &x, &k[1]))
        return 1;
    x = x0 + h * (0.5 * k[1]);
    if (right_hand_side(lag, middle, &x, &k[2]))
        return 1;
    x = x0 + h * k[2];
    if (right_hand_side(lag, t1, &x, &k[3]))
        return 1;
    lag->x = x0 + h * (1.0 / 6.0 * k[0] + 1.0 / 3.0 * k[1] + 1.0 / 3.0 * k[2] + 1.0 / 6.0 * k[3]);
    return set_point(lag, t1, &lag->x) || completed(lag);
}

/* Dormand and Prince with step control: the kernel of cosim, in as many steps as it takes. */
static int rk45(Lag *lag, double t1)
{
    double reached;
    do {
        if (cosim_runge_kutta_step(&lag->solver, t1, &reached) ||
            cosim_runge_kutta_at(&lag->solver, reached, &lag->x) ||
            set_point(lag, reached, &lag->x) || completed(lag))
            return 1;
    } while (reached < t1);
    return 0;
}

/* --- the masters --- */

static int step_co_simulation(Lag *lags, int n, double *before, double *row, double t, double h)
{
    for (int i = 0; i < n; ++i) {
        Lag *lag = &lags[i];
        const double u0 = before[COLUMNS * i];
        row[COLUMNS * i] = u0;
        if (lag->source >= 0 && !lag->held)
            row[COLUMNS * i] = row[COLUMNS * lag->source + 1];
        if (set(lag, row[COLUMNS * i]) || do_step(lag, t, h) || get(lag, &row[COLUMNS * i + 1]))
            return 1;
    }
    return 0;
}

static int step_model_exchange(Lag *lags, int n, double *before, double *row, double t0, double t1)
{
    for (int i = 0; i < n; ++i) {
        Lag *lag = &lags[i];
        const double u0 = before[COLUMNS * i];
        row[COLUMNS * i] = u0;
        if (lag->source >= 0 && !lag->held)
            row[COLUMNS * i] = row[COLUMNS * lag->source + 1];
        if (begin(lag, t0, t1, u0, row[COLUMNS * i]) ||
            (lag->solver.method ? rk45(lag, t1) : rk4(lag, t0, t1)) ||
            get(lag, &row[COLUMNS * i + 1]))
            return 1;
    }
    return 0;
}

static Lag *load(int n, char **arguments, const char *method)
{
    static cosim_method tableau;
    const bool steps = strcmp(method, "cs") == 0, embedded = strcmp(method, "RK45") == 0;
    Lag *lags = calloc((size_t)n, sizeof(Lag));
    if (embedded && cosim_method_named(method, &tableau))
        fail("no such method");
    for (int i = 0; i < n; ++i) {
        Lag *lag = &lags[i];
        void *library = dlopen(arguments[2 * i], RTLD_NOW | RTLD_LOCAL);
        if (!library)
            fail(dlerror());
        lag->source = atoi(arguments[2 * i + 1]);
        lag->held = lag->source >= i;
        lag->set = function(library, SetReal_);
        lag->get = function(library, GetReal_);
        lag->derivatives = function(library, GetDerivatives_);
#define BIND(member, name) lag->member = function(library, (FMI == 2 ? "fmi2" name : "fmi3" name))
        BIND(step, "DoStep");
        BIND(set_time, "SetTime");
        BIND(set_states, "SetContinuousStates");
        BIND(get_states, "GetContinuousStates");
        BIND(completed, "CompletedIntegratorStep");
        BIND(enter_event_mode, "EnterEventMode");
        BIND(enter_continuous_time_mode, "EnterContinuousTimeMode");
        instantiate(lag, library, steps);
        if (embedded) {
            lag->solver = (cosim_runge_kutta){&tableau, right_hand_side, lag, 1, RTOL, 0, NULL};
            lag->solver.memory =
                calloc((size_t)cosim_runge_kutta_memory(&tableau, 1), sizeof(double));
        }
    }
    return lags;
}

/* Fill the first row, and leave initialization. */
static int start(Lag *lags, int n, double *row, bool steps)
{
    const double nominal = 1.0;
    for (int i = 0; i < n; ++i)
        if (get(&lags[i], &row[COLUMNS * i + 1]))
            return 1;
    for (int i = 0; i < n; ++i) {
        Lag *lag = &lags[i];
        row[COLUMNS * i] = lag->source >= 0 ? row[COLUMNS * lag->source + 1] : 0.0;
        lag->u_set = row[COLUMNS * i];
        lag->t_set = NAN;
        if (steps)
            continue;
        if (set(lag, lag->u_set) || update(lag) || lag->enter_continuous_time_mode(lag->instance) ||
            lag->get_states(lag->instance, &lag->x, 1))
            return 1;
        if (lag->solver.method)
            cosim_runge_kutta_start(&lag->solver, 0.0, &lag->x, &nominal);
    }
    return 0;
}

int main(int count, char **arguments)
{
    if (count < 7 || (count - 5) % 2)
        fail("needed METHOD STEP_NS STEPS SAMPLES (LIBRARY SOURCE)...");
    const int n = (count - 5) / 2;
    const bool steps = strcmp(arguments[1], "cs") == 0;
    const int64_t step_ns = atoll(arguments[2]), last = atoll(arguments[3]);
    const size_t width = (size_t)(COLUMNS * n);
    const double h = (double)step_ns / 1e9;
    Lag *lags = load(n, arguments + 5, arguments[1]);
    double *first = calloc(width, sizeof(double));
    if (start(lags, n, first, steps))
        fail("cannot start");

    const double began = now();
    double *rows = malloc(((size_t)last + 1) * width * sizeof(double));
    memcpy(rows, first, width * sizeof(double));
    for (int64_t k = 0; k < last; ++k) {
        double *before = rows + (size_t)k * width, *row = before + width;
        const double t0 = (double)(k * step_ns) / 1e9, t1 = (double)((k + 1) * step_ns) / 1e9;
        if (steps ? step_co_simulation(lags, n, before, row, t0, h)
                  : step_model_exchange(lags, n, before, row, t0, t1))
            fail("a step failed");
        /* what is kept as applied at the end of a step is what the sources gave there at last */
        for (int i = 0; i < n; ++i)
            if (lags[i].held)
                row[COLUMNS * i] = row[COLUMNS * lags[i].source + 1];
    }
    report(now() - began, arguments[4], rows, width, 1, COLUMNS);
    return 0;
}
