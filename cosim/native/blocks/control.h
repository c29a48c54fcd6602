/* Controllers, and integrators with limits. */
#ifndef COSIM_CONTROL_H
#define COSIM_CONTROL_H

#include "cosim.h"

/* x' = u, except where x is at a limit and u points outwards: exact for inputs that are straight
 * lines. y = x; memory: x. */
typedef struct {
    int32_t width;
    double lower, upper;
    const uint8_t *held; /* (width) zero-order hold of this input at the start of the step */
    double *memory;
} cosim_integrator;
int32_t cosim_integrator_step(void *self, double t0, double t1, double h, const double *u0,
                              const double *u1, double *y);

/* A PID controller of the setpoint r = u[0] and the measurement z = u[1], after Astrom and Hagglund
 * (2006), with its outputs y and I:
 *     v = gain (setpoint_weight r - z) + I + D,   y = v within its limits,
 *     I' = integral_gain (r - z) + tracking_rate (y - v),
 *     D = d - w,   w' = filter_rate (d - w),   d = derivative_gain (derivative_weight r - z). */
typedef struct {
    double gain, integral_gain, derivative_gain;
    double setpoint_weight, derivative_weight;
    double filter_rate, tracking_rate; /* tracking_rate 0: there are no limits */
    double lower, upper;
    double initial_integral;
    const uint8_t *held; /* (2) zero-order hold of this input at the start of the step */
    double *memory;      /* I, w */
} cosim_pid;
void cosim_pid_start(const cosim_pid *self, const double *u);
void cosim_pid_outputs(const cosim_pid *self, const double *u, double *y);
int32_t cosim_pid_step(void *self, double t0, double t1, double h, const double *u0,
                       const double *u1, double *y);
/* The same of a digital controller: I and w by Euler's methods from sample to sample, forward for I
 * and backward for w, the inputs those at the start of the step. */
int32_t cosim_sampled_pid_step(void *self, double t0, double t1, double h, const double *u0,
                               const double *u1, double *y);

#endif
