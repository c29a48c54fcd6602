/* The native step: one C signature for everything that advances over communication steps.
 *
 * A step function advances its component from t0 to t1 (h seconds apart), with inputs u0 at t0 and
 * u1 at t1, and writes the outputs at t1. What it needs stands behind `self`: constants, and one
 * flat `memory` of doubles that holds the whole state, so that saving and restoring a component is
 * one copy. Arrays are row-major. No allocation, no globals, no input or output.
 *
 * Every sum runs in a fixed order and every file is compiled with -ffp-contract=off: the same
 * arithmetic gives the same bits in the package and in an exported FMU. */
#ifndef COSIM_H
#define COSIM_H

#include <stdint.h>

/* No value: the one NaN, so that equal runs have equal bits. */
static inline double cosim_no_value(void)
{
    const union {
        uint64_t bits;
        double value;
    } nothing = {UINT64_C(0x7FF8000000000000)};
    return nothing.value;
}

#define COSIM_OK 0
#define COSIM_NO_VALUE 1 /* an input that was needed carries no value (NaN) */
#define COSIM_STEP_TOO_SMALL 2 /* the tolerance needs a step below the spacing of numbers */
#define COSIM_SINGULAR 3 /* a matrix has no inverse */
#define COSIM_NOT_CONVERGED 4 /* an iteration has not reached its end */
#define COSIM_FULL 5 /* there is no room for more samples */
#define COSIM_OUTSIDE 6 /* a sample is said to be of an instant outside its communication step */

typedef int32_t (*cosim_step)(void *self, double t0, double t1, double h, const double *u0,
                              const double *u1, double *y);

/* Advance one component over `steps` communication steps: times t[0..steps], inputs u (one row a
 * time, `u_stride` doubles apart), outputs y (one row a step, `y_stride` doubles apart). Returns
 * the number of steps completed; *status says why it stopped early. */
int64_t cosim_cascade(cosim_step step, void *self, int64_t steps, const double *t, double h,
                      const double *u, int64_t u_stride, double *y, int64_t y_stride,
                      int32_t *status);

#endif
