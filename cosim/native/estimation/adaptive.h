#ifndef COSIM_ADAPTIVE_H
#define COSIM_ADAPTIVE_H

#include "regression.h"

/* Adaptive laws for the linear regression p = m'eta (26), normalized so that the unit of mu does
 * not matter; inputs and outputs are those of least squares. */
typedef struct {
    int32_t unknowns, groups, parameters, held;
    double start;      /* [s] */
    double gain;       /* [1/s] */
    double forgetting; /* time constant in which samples lose their weight [s]; of DREM */
    const cosim_recovery *recovery;
    double *memory;
} cosim_adaptive;
/* The gradient: eta' = gain m (p - m'eta) / m'm, from eta = 0. */
int64_t cosim_gradient_memory(const cosim_adaptive *self);
int32_t cosim_gradient_step(void *self, double t0, double t1, double h, const double *u0,
                            const double *u1, double *y);
/* Dynamic regressor extension and mixing (S. Aranovskiy, A. Bobtsov, R. Ortega, A. Pyrkin, IEEE
 * Trans. Automatic Control, 2017) with Kreisselmeier's extension. */
int64_t cosim_drem_memory(const cosim_adaptive *self);
int32_t cosim_drem_step(void *self, double t0, double t1, double h, const double *u0,
                        const double *u1, double *y);

#endif
