#define _POSIX_C_SOURCE 200809L
#include "process.h"

#include <fenv.h>
#include <locale.h>
#include <stdbool.h>
#include <string.h>

#ifdef _WIN32
#include <direct.h>
#define getcwd _getcwd
#define chdir _chdir
#else
#include <fcntl.h>
#include <signal.h>
#include <unistd.h>
#endif

/* --- the floating-point unit --- */

typedef struct {
    uint32_t sse; /* MXCSR; FPCR of aarch64; else the rounding mode of C */
    uint16_t x87; /* its control word */
} Unit;

#if defined(__x86_64__) || defined(__i386__)

enum { ROUNDING = 0x6000, SUBNORMALS = 0x8040, TRAPS = 0x1F80 };            /* of MXCSR */
enum { X87_ROUNDING = 0x0C00, X87_PRECISION = 0x0300, X87_TRAPS = 0x003F }; /* of the word */

static uint16_t read_x87(void)
{
    uint16_t word;
    __asm__ volatile("fnstcw %0" : "=m"(word));
    return word;
}

static Unit read_unit(void)
{
    uint32_t sse; /* on its own: what is read back is as wide as what was written, so quick */
    __asm__ volatile("stmxcsr %0" : "=m"(sse));
    return (Unit){sse, read_x87()};
}

static void write_unit(Unit unit, Unit now)
{
    const uint32_t control = ROUNDING | SUBNORMALS | TRAPS;
    /* the flags of exceptions stay as they are */
    uint32_t sse = (now.sse & ~control) | (unit.sse & control);
    __asm__ volatile("ldmxcsr %0" : : "m"(sse));
    __asm__ volatile("fnclex\n\tfldcw %0" : : "m"(unit.x87)); /* else a flag could trap here */
}

static int32_t compare_units(Unit a, Unit b)
{
    const uint32_t sse = a.sse ^ b.sse, x87 = (uint32_t)(a.x87 ^ b.x87);
    int32_t changes = 0;
    if (!(sse & (ROUNDING | SUBNORMALS | TRAPS)) && !x87)
        return 0;
    if (sse & ROUNDING || x87 & (X87_ROUNDING | X87_PRECISION))
        changes |= COSIM_ROUNDING;
    if (sse & SUBNORMALS)
        changes |= COSIM_SUBNORMALS;
    if (sse & TRAPS || x87 & X87_TRAPS)
        changes |= COSIM_TRAPS;
    return changes;
}

#elif defined(__aarch64__)

enum { ROUNDING = 0xC00000, SUBNORMALS = 0x1080000, TRAPS = 0x9F00 }; /* of FPCR */

static uint16_t read_x87(void) { return 0; }

static Unit read_unit(void)
{
    uint64_t control;
    __asm__ volatile("mrs %0, fpcr" : "=r"(control));
    return (Unit){(uint32_t)control, 0};
}

static void write_unit(Unit unit, Unit now)
{
    uint64_t control = unit.sse;
    (void)now;
    __asm__ volatile("msr fpcr, %0" : : "r"(control));
}

static int32_t compare_units(Unit a, Unit b)
{
    const uint32_t differ = a.sse ^ b.sse;
    return (differ & ROUNDING ? COSIM_ROUNDING : 0) | (differ & SUBNORMALS ? COSIM_SUBNORMALS : 0) |
           (differ & TRAPS ? COSIM_TRAPS : 0);
}

#else

static uint16_t read_x87(void) { return 0; }

static Unit read_unit(void) { return (Unit){(uint32_t)fegetround(), 0}; }

static void write_unit(Unit unit, Unit now)
{
    (void)now;
    fesetround((int)unit.sse);
}

static int32_t compare_units(Unit a, Unit b) { return a.sse == b.sse ? 0 : COSIM_ROUNDING; }

#endif

/* --- what all threads share --- */

enum { STREAMS = 3 };
#ifndef _WIN32
static const int numbers[] = {SIGINT, SIGTERM};
enum { SIGNALS = sizeof numbers / sizeof numbers[0] };
#endif

typedef struct {
    Unit unit;
    const cosim_messages *called; /* the FMU that was called, if any */
    char locale[100], folder[4096]; /* empty: not known, and left alone */
#ifndef _WIN32
    struct sigaction handlers[SIGNALS];
    int open[STREAMS];
#endif
} State;

size_t cosim_process_size(void) { return sizeof(State); }

static const char *number_locale(void)
{
    const char *name = setlocale(LC_NUMERIC, NULL);
    return name ? name : "";
}

static void read_shared(State *state)
{
    const char *name = number_locale();
    state->locale[0] = 0;
    if (strlen(name) < sizeof state->locale)
        strcpy(state->locale, name);
    if (!getcwd(state->folder, sizeof state->folder))
        state->folder[0] = 0;
#ifndef _WIN32
    for (int i = 0; i < SIGNALS; i++)
        sigaction(numbers[i], NULL, &state->handlers[i]);
    for (int i = 0; i < STREAMS; i++)
        state->open[i] = fcntl(i, F_GETFD) != -1;
#endif
}

#ifndef _WIN32
static int32_t restore_handlers(const State *state)
{
    int32_t changes = 0;
    for (int i = 0; i < SIGNALS; i++) {
        struct sigaction now;
        sigaction(numbers[i], NULL, &now);
        if (now.sa_handler != state->handlers[i].sa_handler) {
            sigaction(numbers[i], &state->handlers[i], NULL);
            changes = COSIM_SIGNALS;
        }
    }
    return changes;
}

/* A stream that is closed would be the next file that is opened, and take what is printed. */
static int32_t restore_streams(const State *state)
{
    int32_t changes = 0;
    for (int i = 0; i < STREAMS; i++)
        if (state->open[i] && fcntl(i, F_GETFD) == -1) {
            int nowhere = open("/dev/null", O_RDWR);
            if (nowhere != -1 && nowhere != i) {
                dup2(nowhere, i);
                close(nowhere);
            }
            changes = COSIM_STREAMS;
        }
    return changes;
}
#endif

static int32_t restore_shared(const State *state)
{
    int32_t changes = 0;
    char folder[sizeof state->folder];
    if (state->locale[0] && strcmp(number_locale(), state->locale)) {
        setlocale(LC_NUMERIC, state->locale);
        changes |= COSIM_LOCALE;
    }
    /* the directory may have been removed, so that there is no name: that is no change of it */
    if (state->folder[0] && getcwd(folder, sizeof folder) && strcmp(folder, state->folder) &&
        !chdir(state->folder))
        changes |= COSIM_FOLDER;
#ifndef _WIN32
    changes |= restore_handlers(state) | restore_streams(state);
#endif
    return changes;
}

void cosim_process_save(void *state, int32_t shared, const cosim_messages *called)
{
    State *saved = state;
    saved->called = cosim_running;
    if (called)
        cosim_running = called;
    saved->unit = read_unit();
    if (shared)
        read_shared(saved);
}

int32_t cosim_process_restore(const void *state, int32_t shared)
{
    const State *saved = state;
    Unit now = read_unit();
    cosim_running = saved->called;
    int32_t changes = compare_units(now, saved->unit);
    if (changes)
        write_unit(saved->unit, now);
    return shared ? changes | restore_shared(saved) : changes;
}

/* --- steps --- */

/* Put back what a call that returned `status` changed; not inlined, as it is rare. */
__attribute__((noinline)) static int32_t put_back_changes(cosim_guarded *self, double t,
                                                          int32_t status, Unit now)
{
    const Unit before = ((const State *)self->process)->unit;
    const int32_t changes = compare_units(now, before);
    write_unit(before, now);
    if (!self->changes)
        self->time = t;
    self->changes |= changes;
    if (!(changes & COSIM_ROUNDING))
        return status;
    self->distrusted = status == COSIM_OK;
    return COSIM_NO_VALUE;
}

static inline int32_t put_back(cosim_guarded *self, double t, int32_t status)
{
    const Unit now = read_unit();
    if (!compare_units(now, ((const State *)self->process)->unit))
        return status;
    return put_back_changes(self, t, status, now);
}

int32_t cosim_guarded_step(void *self, double t0, double t1, double h, const double *u0,
                           const double *u1, double *y)
{
    cosim_guarded *guarded = self;
    cosim_running = guarded->called;
    return put_back(guarded, t0, guarded->step(guarded->self, t0, t1, h, u0, u1, y));
}

int32_t cosim_guarded_outputs(void *self, double t, const double *u, double *y)
{
    cosim_guarded *guarded = self;
    cosim_running = guarded->called;
    return put_back(guarded, t, guarded->outputs(guarded->self, t, u, y));
}

int32_t cosim_guarded_save(void *self)
{
    cosim_guarded *guarded = self;
    cosim_running = guarded->called;
    return put_back(guarded, guarded->time, guarded->save(guarded->self));
}

int32_t cosim_guarded_restore(void *self)
{
    cosim_guarded *guarded = self;
    cosim_running = guarded->called;
    return put_back(guarded, guarded->time, guarded->restore(guarded->self));
}
