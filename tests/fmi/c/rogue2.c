/* An FMI 2 co-simulation FMU, x' = u - x by Euler's method, y = x, that does one thing wrong:
 * -DROGUE=<one of these>; some of them -DWHERE=<a moment>, or -DAT=<number of steps>. */
#define _GNU_SOURCE
#include <fenv.h>
#include <locale.h>
#include <math.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>
#include <xmmintrin.h>
#include "fmi2Functions.h"

enum {
    GOOD, CRASH, HANG, EXITS, REFUSES, NAN_OUTPUT, OTHER_START, LIES, FORGETS,
    HANGS_BACK, CRASHES_FREE, FAILS_STEP, LOUD, LITTERS, PRINTS, REFUSES_STATE, REFUSES_BACK,
    NEARLY, FAILS_END, WARNS, ROUNDS, FLUSHES, TRAPS, SPEAKS, MOVES, CATCHES, CLOSES,
    ABORTS_LATER, ROUNDS_FAILS, ROUNDS_ENDS, HANGS_LATER, CRASHES_LATER,
    EXITS_LATER, REPEATS, HIDES, ONE_STEP
};
enum { INSTANTIATE, INITIALIZE, STEP, TERMINATE };
#ifndef ONLY
#define ONLY 0.1 /* the one step that ONE_STEP takes [s] */
#endif
#ifndef AT
#define AT 2 /* steps after which it does what it does later */
#endif
#ifndef WHERE
#define WHERE STEP
#endif

typedef struct {
    double x, u, memory, before; /* before: x at the beginning of the last step */
    int steps;
} Model;

/* Change the process. */
static void change(int where)
{
    if (where != WHERE)
        return;
    switch (ROGUE) {
    case ROUNDS:
    case ROUNDS_FAILS:
    case ROUNDS_ENDS: fesetround(FE_UPWARD); break;
    case FLUSHES: _mm_setcsr(_mm_getcsr() | 0x8040); break;
    case TRAPS: feenableexcept(FE_DIVBYZERO | FE_OVERFLOW); break;
    case SPEAKS: setlocale(LC_NUMERIC, "C.UTF-8"); break;
    case MOVES: (void)!chdir("/"); break;
    case CATCHES: signal(SIGINT, SIG_IGN); break;
    case CLOSES: close(1); break;
    default: break;
    }
}

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }
fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String names[])
{
    return fmi2OK;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String place,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible,
                              fmi2Boolean on)
{
    if (ROGUE == EXITS)
        exit(3);
    if (ROGUE == REFUSES)
        return NULL;
    if (ROGUE == LITTERS)
        fclose(fopen("litter", "w"));
    if (ROGUE == ABORTS_LATER)
        on_exit((void (*)(int, void *))abort, NULL); /* of the C library, so it is not unloaded */
    change(INSTANTIATE);
    return calloc(1, sizeof(Model));
}

void fmi2FreeInstance(fmi2Component c) { free(c); }
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean a, fmi2Real b, fmi2Real t,
                               fmi2Boolean d, fmi2Real e)
{
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    change(INITIALIZE);
    ((Model *)c)->x = ROGUE == OTHER_START ? 2.0 : 1.0;
    return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2Terminate(fmi2Component c)
{
    change(TERMINATE);
    return ROGUE == FAILS_END ? fmi2Error : fmi2OK;
}
fmi2Status fmi2Reset(fmi2Component c) { return fmi2OK; }

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference r[], size_t n, fmi2Real v[])
{
    if (ROGUE == HIDES && !r[0])
        return fmi2Error; /* an input is not for reading */
    for (size_t i = 0; i < n; i++)
        v[i] = r[i] ? ((Model *)c)->x : ((Model *)c)->u;
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference r[], size_t n, const fmi2Real v[])
{
    for (size_t i = 0; i < n; i++)
        ((Model *)c)->u = v[i];
    return fmi2OK;
}

#define NOTHING(name, type)                                                            \
    fmi2Status name(fmi2Component c, const fmi2ValueReference r[], size_t n, type v[]) \
    {                                                                                  \
        return fmi2OK;                                                                 \
    }
NOTHING(fmi2GetInteger, fmi2Integer)
NOTHING(fmi2GetBoolean, fmi2Boolean)
NOTHING(fmi2GetString, fmi2String)
NOTHING(fmi2SetInteger, const fmi2Integer)
NOTHING(fmi2SetBoolean, const fmi2Boolean)
NOTHING(fmi2SetString, const fmi2String)

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *s)
{
    if (ROGUE == REFUSES_STATE)
        return fmi2Error;
    if (!*s)
        *s = malloc(sizeof(Model));
    *(Model *)*s = *(Model *)c;
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate s)
{
    Model *m = c, *saved = s;
    double memory = m->memory;
    if (ROGUE == HANGS_BACK)
        for (;;)
            pause();
    if (ROGUE == REFUSES_BACK)
        return fmi2Error;
    if (ROGUE != LIES)
        *m = *saved;
    if (ROGUE == NEARLY)
        m->x += 1e-6;
    if (ROGUE == FORGETS)
        m->memory = memory;
    return fmi2OK;
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *s)
{
    if (ROGUE == CRASHES_FREE)
        raise(SIGSEGV);
    free(*s);
    *s = NULL;
    return fmi2OK;
}

#ifndef WITHOUT_STEP
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no_way_back)
{
    Model *m = c;
    if (ROGUE == CRASH || (ROGUE == CRASHES_LATER && m->steps == AT))
        raise(SIGSEGV);
    if (ROGUE == EXITS_LATER && m->steps == AT)
        exit(3);
    if (ROGUE == HANG || (ROGUE == HANGS_LATER && m->steps == AT)) {
        (void)!write(2, "hangs\n", 6);
        for (;;)
            pause();
    }
    if (ROGUE == FAILS_STEP || (ROGUE == ONE_STEP && h != ONLY))
        return fmi2Error;
    if (ROGUE == LOUD)
        for (int i = 0; i < 100000; i++)
            puts("a line that nobody asked for, and many more of them");
    if (ROGUE == PRINTS)
        puts("a line that nobody asked for");
    m->memory += m->u;
    if (ROGUE == REPEATS && !no_way_back)
        m->x = m->before; /* takes it for the same step again */
    m->before = m->x;
    m->x =
        ROGUE == NAN_OUTPUT ? NAN : m->x + h * (m->u - m->x) + (ROGUE == FORGETS ? m->memory : 0.0);
    change(STEP);
    if (++m->steps == 3 && ROGUE == ROUNDS_FAILS)
        return fmi2Error;
    if (m->steps == 3 && ROGUE == ROUNDS_ENDS)
        return fmi2Discard;
    return ROGUE == WARNS ? fmi2Warning : fmi2OK;
}
#endif

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind k, fmi2Status *v)
{
    return fmi2Discard;
}
fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind k, fmi2Real *v)
{
    return fmi2Discard;
}
fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind k, fmi2Boolean *v)
{
    if (ROGUE == ROUNDS_ENDS && k == fmi2Terminated) {
        *v = fmi2True;
        return fmi2OK;
    }
    return fmi2Discard;
}
