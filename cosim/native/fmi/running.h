/* Which FMU is being called: what a process that dies in it, or hangs, says of that.
 *
 * It costs a store a call. The time is that of the FMU's messages; the name of the function is
 * looked for on the stack, where the process dies. */
#ifndef COSIM_RUNNING_H
#define COSIM_RUNNING_H

#include <stddef.h>
#include <stdint.h>

#include "callbacks.h"

#ifdef __linux__
#define COSIM_QUICK_TLS __attribute__((tls_model("initial-exec")))
#else
#define COSIM_QUICK_TLS
#endif
/* The FMU that this thread calls, by its messages; NULL: none. */
extern COSIM_QUICK_TLS _Thread_local const cosim_messages *cosim_running;

/* From now on say on stderr where the process crashes, or is ended by `exit`, in an FMU: the first
 * call does, from the thread that `cosim_running_text` is about. */
void cosim_report_deaths(void);
/* Where the log of the run is; NULL: there is none. It is copied. */
void cosim_report_log(const char *path);
/* Write which FMU that thread calls, and at what time: `motor, at t = 0.5 s`; 0: none. */
int32_t cosim_running_text(char *text, size_t size);

#endif
