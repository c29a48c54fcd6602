#include "refresh.h"
#include "control.h"
#include "regression.h"
#include "window.h"

#include <string.h>

int32_t cosim_expression_refresh(void *self, double t, const double *u, double *y)
{
    return cosim_expression_step(self, t, t, 0.0, u, u, y);
}

int32_t cosim_delay_refresh(void *self, double t, const double *u, double *y)
{
    (void)t, (void)u;
    const cosim_delay *s = self;
    const int32_t due = (int32_t)s->memory[0];
    memcpy(y, s->memory + 1 + due * s->width, (size_t)s->width * sizeof *y);
    return COSIM_OK;
}

int32_t cosim_integrator_refresh(void *self, double t, const double *u, double *y)
{
    (void)t, (void)u;
    const cosim_integrator *s = self;
    memcpy(y, s->memory, (size_t)s->width * sizeof *y);
    return COSIM_OK;
}

int32_t cosim_pid_refresh(void *self, double t, const double *u, double *y)
{
    (void)t;
    cosim_pid_outputs(self, u, y);
    return COSIM_OK;
}

int32_t cosim_window_refresh(void *self, double t, const double *u, double *y)
{
    (void)t;
    cosim_window_outputs(self, u, y);
    return COSIM_OK;
}

int32_t cosim_regressor_refresh(void *self, double t, const double *u, double *y)
{
    cosim_regressor_outputs(self, t, u, y);
    return COSIM_OK;
}
