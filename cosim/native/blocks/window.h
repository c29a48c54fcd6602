#ifndef COSIM_WINDOW_H
#define COSIM_WINDOW_H

#include "linear.h"

/* A discretized linear system, and weighted sums of the increments of other signals over the last
 * `taps` steps. The increment over a step is Jx x(t) + J0 u(t) + J1 u(t+h). Outputs: those of the
 * system, then the sums, which have no value (NaN) before `taps` steps were taken. */
typedef struct {
    cosim_linear linear;        /* its memory begins that of the whole */
    int32_t taps, width;        /* at least 1 */
    const double *Jx, *J0, *J1; /* (width, n), (width, m), (width, m) */
    const double *weights;      /* (taps) the oldest first */
    /* that of the system, number of steps taken, the newest increment without J1 u(t+h) (width),
     * ring (taps, width) */
    double *memory;
} cosim_window;
void cosim_window_outputs(const cosim_window *self, const double *u, double *y);
int32_t cosim_window_step(void *self, double t0, double t1, double h, const double *u0,
                          const double *u1, double *y);

#endif
