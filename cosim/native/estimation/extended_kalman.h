#ifndef COSIM_EXTENDED_KALMAN_H
#define COSIM_EXTENDED_KALMAN_H

#include "alphas.h"
#include "output_error.h"

/* The extended Kalman filter of x, the basis beta(t) and theta: inputs mu, which is not used, the
 * signals among the alphas, y and u, of which a step takes those at its beginning; outputs theta
 * and its standard errors. Over a step the transition is exact at the present theta, its derivative
 * that of the exact one. */
typedef struct {
    int32_t terms;                   /* of mu */
    const cosim_output_error *model; /* of one interval, without a predictor */
    const cosim_known_input *known;
    const cosim_alphas *alphas;      /* of the components */
    double deviation;                /* of the noise of the outputs, made white */
    double size;                     /* deviation of x and beta at first */
    const double *theta, *spread;    /* (parameters) at first, and its deviation */
    const double *threshold;         /* (components) statistic from which on it is no noise */
    double *memory;
} cosim_extended_kalman;
int64_t cosim_extended_kalman_memory(const cosim_extended_kalman *self);
void cosim_extended_kalman_start(cosim_extended_kalman *self, double *y);
int32_t cosim_extended_kalman_step(void *self, double t0, double t1, double h, const double *u0,
                                   const double *u1, double *y);

#endif
