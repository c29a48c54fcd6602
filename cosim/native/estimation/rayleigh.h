#ifndef COSIM_RAYLEIGH_H
#define COSIM_RAYLEIGH_H

#include "cosim.h"

#define COSIM_MOST_TERMS 128
#define COSIM_MOST_ROWS 48 /* delays: one more than the basis functions of all groups */

/* The regression (25) as a function of theta: mu' chi(theta) = 0, with noise of covariance N in
 * mu. */
typedef struct {
    int32_t components, parameters, rows, groups, terms;
    const int32_t *size, *count; /* (components) */
    const int32_t *group;        /* (components) which group b it belongs to */
    const double *c, *G0, *G1;   /* as in cosim_output_error */
    const double *delays;        /* (rows) D_j [s] */
    const int32_t *parts;        /* (terms, rows - 1) the rows R_b of all groups */
    const double *lower, *upper; /* (parameters) of the grid of starts, and of theta */
    int32_t points;              /* of the grid in every direction */
} cosim_rayleigh;
/* Minimize chi' R'R chi / chi' N chi from theta; R, N of shape (terms, terms). */
int32_t cosim_rayleigh_minimize(const cosim_rayleigh *self, const double *R, const double *N,
                                double *theta, double *value);
/* The same from the best points of the grid. */
int32_t cosim_rayleigh_search(const cosim_rayleigh *self, const double *R, const double *N,
                              double *theta, double *value);

#endif
