/* A linear model behind the calls for model exchange, with its exact solver, in compiled steps. */
#ifndef COSIM_EXACT_H
#define COSIM_EXACT_H

#include "linear.h"

/* `events` are the inputs that change in events only: where one of them has changed, the step is
 * declined, and the caller's ordinary step does it from the state that stands here. */
typedef struct {
    cosim_linear linear;
    int32_t allowed;        /* 0: every call is declined */
    int32_t moved;          /* set by each step; the caller clears it */
    int32_t n_events;
    const int32_t *events;  /* (n_events) */
    double t;               /* the time reached */
    double *inputs;         /* (m) there, those of events as the model has them */
} cosim_exact;
int32_t cosim_exact_step(void *self, double t0, double t1, double h, const double *u0,
                         const double *u1, double *y);
int32_t cosim_exact_outputs(void *self, double t, const double *u, double *y);

#endif
