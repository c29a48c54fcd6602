/* Steps of components that only the master needs: no exported FMU has them. */
#ifndef COSIM_BLOCKS_H
#define COSIM_BLOCKS_H

#include "stage.h"

/* --- refresh.c --- */

/* The outputs of steps of cosim.h at the time reached, as cosim_outputs. */
int32_t cosim_expression_refresh(void *self, double t, const double *u, double *y);
int32_t cosim_delay_refresh(void *self, double t, const double *u, double *y);
int32_t cosim_integrator_refresh(void *self, double t, const double *u, double *y);
int32_t cosim_pid_refresh(void *self, double t, const double *u, double *y);
int32_t cosim_window_refresh(void *self, double t, const double *u, double *y);
int32_t cosim_regressor_refresh(void *self, double t, const double *u, double *y);

/* --- wrapping.c --- */

/* A component inside another one. */
typedef struct {
    cosim_step step;
    cosim_outputs outputs; /* NULL: not there */
    void *self;
} cosim_inner;

/* Outputs that stay what they are until the next step. */
typedef struct {
    cosim_inner inner;
    int32_t width;
    double *last; /* (width) */
} cosim_kept;
int32_t cosim_kept_step(void *self, double t0, double t1, double h, const double *u0,
                        const double *u1, double *y);
int32_t cosim_kept_outputs(void *self, double t, const double *u, double *y);

#endif
