#include "cosim.h"

int64_t cosim_cascade(cosim_step step, void *self, int64_t steps, const double *t, double h,
                      const double *u, int64_t u_stride, double *y, int64_t y_stride,
                      int32_t *status)
{
    for (int64_t k = 0; k < steps; ++k) {
        const double *u0 = u + k * u_stride;
        *status = step(self, t[k], t[k + 1], h, u0, u0 + u_stride, y + k * y_stride);
        if (*status != COSIM_OK)
            return k;
    }
    *status = COSIM_OK;
    return steps;
}
