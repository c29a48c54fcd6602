#ifndef COSIM_WRAPPING_H
#define COSIM_WRAPPING_H

#include "stage.h"

/* A component inside another one. */
typedef struct {
    cosim_step step;
    cosim_outputs outputs; /* NULL: not there */
    void *self;
} cosim_inner;
static inline int32_t cosim_inner_outputs(const cosim_inner *inner, double t, const double *u,
                                          double *y)
{
    return inner->outputs ? inner->outputs(inner->self, t, u, y) : COSIM_NO_VALUE;
}

/* Outputs that stay what they are until the next step. */
typedef struct {
    cosim_inner inner;
    int32_t width;
    double *last; /* (width) */
} cosim_kept;
int32_t cosim_kept_step(void *self, double t0, double t1, double h, const double *u0,
                        const double *u1, double *y);
int32_t cosim_kept_outputs(void *self, double t, const double *u, double *y);

/* A component that advances by steps of so many communication steps, each `h` long: its outputs
 * change where one has ended, and are those for the inputs then. */
typedef struct {
    cosim_inner inner;
    int32_t steps, n_u, n_y;
    double h; /* [s] */
    /* communication steps since its own step began, negative before the first, time and inputs
     * (n_u) then, outputs that are held (n_y) */
    double *memory;
} cosim_sampled;
int32_t cosim_sampled_step(void *self, double t0, double t1, double h, const double *u0,
                           const double *u1, double *y);
int32_t cosim_sampled_outputs(void *self, double t, const double *u, double *y);

/* A component that advances by communication steps, and whose outputs change in one of so many. */
typedef struct {
    cosim_inner inner;
    int32_t steps, n_y;
    double *memory; /* steps since the last sample, outputs that are held (n_y), scratch (n_y) */
} cosim_decimated;
int32_t cosim_decimated_step(void *self, double t0, double t1, double h, const double *u0,
                             const double *u1, double *y);
int32_t cosim_decimated_outputs(void *self, double t, const double *u, double *y);

/* A component with other ports: its inputs are picked from those shown, the outputs that are shown
 * from its own, each converted as in cosim_sum where it `converts`. */
typedef struct {
    int32_t from, converts;
    double factor1, offset1, offset2, factor2;
} cosim_element;
typedef struct {
    cosim_inner inner;
    int32_t n_u, n_y;                      /* its inputs, and the outputs that are shown */
    const cosim_element *inputs, *outputs; /* (n_u), (n_y) */
    double *work;                          /* its inputs at both ends, its outputs */
} cosim_ports;
int32_t cosim_ports_step(void *self, double t0, double t1, double h, const double *u0,
                         const double *u1, double *y);
int32_t cosim_ports_outputs(void *self, double t, const double *u, double *y);

/* Components side by side, each with some of the inputs; their outputs stand one behind the other.
 * None of them ever declines a step: the others would have taken it. */
typedef struct {
    cosim_inner inner;
    int32_t n_u, n_y;
    const int32_t *columns; /* (n_u) */
    double *u;              /* (2, n_u) scratch */
} cosim_part;
typedef struct {
    int32_t count;
    const cosim_part *parts;
} cosim_parts;
int32_t cosim_parts_step(void *self, double t0, double t1, double h, const double *u0,
                         const double *u1, double *y);
int32_t cosim_parts_outputs(void *self, double t, const double *u, double *y);

#endif
