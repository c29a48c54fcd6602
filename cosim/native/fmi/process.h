/* What an FMU may change of the process that it runs in, and must not: read before a call of it,
 * put back after it. */
#ifndef COSIM_PROCESS_H
#define COSIM_PROCESS_H

#include <stddef.h>
#include <stdint.h>

#include "running.h"
#include "stage.h"

enum { /* what differed */
    COSIM_ROUNDING = 1,   /* rounding mode, or the precision of x87 */
    COSIM_SUBNORMALS = 2, /* flush to zero, denormals are zero */
    COSIM_TRAPS = 4,      /* floating-point exceptions that end the process */
    COSIM_LOCALE = 8,     /* of numbers */
    COSIM_FOLDER = 16,    /* the working directory */
    COSIM_SIGNALS = 32,   /* handlers of SIGINT and SIGTERM */
    COSIM_STREAMS = 64    /* stdin, stdout or stderr is closed */
};

/* Bytes of a state. */
size_t cosim_process_size(void);
/* Read the state: of the floating-point unit, which is the thread's own, and with `shared` of what
 * all threads have in common. From then on the FMU with these messages is called (NULL: as before),
 * up to when the state is put back. */
void cosim_process_save(void *state, int32_t shared, const cosim_messages *called);
/* Put back what differs from a state; return what did. */
int32_t cosim_process_restore(const void *state, int32_t shared);

/* A step after which the floating-point unit is put back, which is the thread's own. Reading
 * its registers costs nothing where steps divide; computing with a subnormal number to see whether
 * it counts costs 50 ns on Intel. */
typedef struct {
    const void *process; /* the state before the first of many steps */
    const cosim_messages *called; /* the FMU */
    cosim_step step;
    cosim_outputs outputs; /* NULL: there are none */
    /* how the component goes back; NULL: it does not, in compiled code */
    int32_t (*save)(void *self), (*restore)(void *self);
    void *self;
    /* what was put back and is not reported yet: bits, and the time of the first change [s] */
    int32_t changes;
    double time;
    /* a step or outputs that ended well with another rounding mode: not to be relied on */
    int32_t distrusted;
} cosim_guarded;
/* A cosim_step and a cosim_outputs: COSIM_NO_VALUE after a change of the rounding mode. */
int32_t cosim_guarded_step(void *self, double t0, double t1, double h, const double *u0,
                           const double *u1, double *y);
int32_t cosim_guarded_outputs(void *self, double t, const double *u, double *y);
int32_t cosim_guarded_save(void *self);
int32_t cosim_guarded_restore(void *self);

#endif
