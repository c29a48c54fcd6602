/* Explicit Runge-Kutta methods, step by step. */
#ifndef COSIM_RUNGE_KUTTA_H
#define COSIM_RUNGE_KUTTA_H

#include "cosim.h"

/* dx = f(t, x); 0: fine. Its own failures are negative: they end the call that needed it. */
typedef int32_t (*cosim_right_hand_side)(void *model, double t, const double *x, double *dx);

/* An explicit Runge-Kutta method with `stages` stages. Of its 1 + stages + extra slopes
 *     k_i = f(t + c_i h, x + h sum_j a_ij k_j),   j < i,
 * slope `stages` is the one at the end of the step, so that its row of a are the weights of the
 * step; the extra ones serve the dense output alone. */
typedef struct {
    int32_t stages, extra;
    int32_t dense;       /* rows of d */
    int32_t root;        /* the error of a step grows with h^root; 0: it is not estimated */
    const double *c;     /* (1 + stages + extra) */
    const double *a;     /* rows 1, 2, ... one behind the other, row i of i numbers */
    const double *e;     /* (1 + stages) error = h sum e_j k_j */
    const double *e_low; /* (1 + stages) of a second estimate of lower order; NULL: there is none */
    const double *d;     /* (dense, 1 + stages + extra) */
} cosim_method;
/* Write euler, rk4, RK23, RK45 or DOP853; COSIM_NO_VALUE: there is no such method. */
int32_t cosim_method_named(const char *name, cosim_method *method);

/* x' = f(t, x), integrated step by step. */
typedef struct {
    const cosim_method *method;
    cosim_right_hand_side f;
    void *model;
    int32_t n;           /* of states, at least 1 */
    double rtol;         /* not used where the method does not estimate its error */
    int64_t evaluations; /* of f, so far */
    double *memory;      /* its whole state */
} cosim_runge_kutta;
/* The number of doubles of `memory`. */
int64_t cosim_runge_kutta_memory(const cosim_method *method, int32_t n);
/* Begin at t with x; the absolute tolerance of a state is rtol times its nominal value. */
int32_t cosim_runge_kutta_start(void *self, double t, const double *x, const double *nominals);
/* Take one step, to t_end at most, and without an estimate of the error to t_end: f is evaluated at
 * no time beyond it. After a failure the step can be tried again. */
int32_t cosim_runge_kutta_step(void *self, double t_end, double *reached);
/* The step that its tolerance allows, after a step that may have been cut short. */
double cosim_runge_kutta_proposed(const cosim_runge_kutta *self);
/* x at a time within the last step. The first call may evaluate f; without an estimate of the error
 * each does, for x is that of a shorter step. */
int32_t cosim_runge_kutta_at(void *self, double t, double *x);

#endif
