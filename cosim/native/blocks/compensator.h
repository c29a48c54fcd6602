#ifndef COSIM_COMPENSATOR_H
#define COSIM_COMPENSATOR_H

#include "cosim.h"

/* A compensator; compensator.py of the blocks has the equations. COSIM_NO_VALUE where the estimates
 * are not those that were checked last: then they are checked, and the gains made anew. */
typedef struct {
    int32_t n_u, n_w, known, regulated, parameters;
    int32_t follows;                           /* there is an internal model */
    int32_t reference, theta, standard_error;  /* first columns of these inputs */
    const int32_t *known_columns, *regulated_columns;
    const double *before;                      /* (n_u, known) */
    const double *lower, *upper;               /* (n_u) */
    const double *X, *minus_K_w, *generator;   /* (n_w, known), (n_u, n_w), (n_w, driving) */
    const double *checked;                      /* (2, parameters) theta and its standard errors */
    double *memory;                            /* u, w, whether it is active, theta in use */
    double *work; /* known + n_w + n_u + driving, which is n_w + regulated + n_u */
} cosim_compensator;
int32_t cosim_compensator_step(void *self, double t0, double t1, double h, const double *u0,
                               const double *u1, double *y);
int32_t cosim_compensator_outputs(void *self, double t, const double *u, double *y);

#endif
