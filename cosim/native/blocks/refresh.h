#ifndef COSIM_REFRESH_H
#define COSIM_REFRESH_H

#include "cosim.h"

/* The outputs of some steps at the time reached, as cosim_outputs; exported FMUs do without. */
int32_t cosim_expression_refresh(void *self, double t, const double *u, double *y);
int32_t cosim_delay_refresh(void *self, double t, const double *u, double *y);
int32_t cosim_integrator_refresh(void *self, double t, const double *u, double *y);
int32_t cosim_pid_refresh(void *self, double t, const double *u, double *y);
int32_t cosim_window_refresh(void *self, double t, const double *u, double *y);
int32_t cosim_regressor_refresh(void *self, double t, const double *u, double *y);

#endif
