/* What an FMU may change of the process that it runs in, and must not: read before a call of it, put
 * back after it. */
#ifndef COSIM_PROCESS_H
#define COSIM_PROCESS_H

#include <stddef.h>
#include <stdint.h>

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
 * all threads have in common. */
void cosim_process_save(void *state, int32_t shared);
/* Put back what differs from a state; return what did. */
int32_t cosim_process_restore(const void *state, int32_t shared);

#endif
