#ifndef COSIM_FUNCTIONS_H
#define COSIM_FUNCTIONS_H

#include "expression.h"
#include "wrapping.h"

/* A component without memory: its outputs are a function of t and the inputs then. The functions
 * that follow are such; where they are not defined they return COSIM_OUTSIDE. */
typedef struct {
    cosim_outputs at;
    void *self;
} cosim_instant;
int32_t cosim_instant_step(void *self, double t0, double t1, double h, const double *u0,
                           const double *u1, double *y);
int32_t cosim_instant_outputs(void *self, double t, const double *u, double *y);

/* y = sum_i sign_i u_i of inputs of `width` elements. */
typedef struct {
    int32_t count, width;
    const double *signs; /* (count) */
} cosim_signed_sum;
int32_t cosim_sum_at(void *self, double t, const double *u, double *y);

/* y = K u */
typedef struct {
    int32_t rows, columns;
    const double *K; /* (rows, columns) */
} cosim_gain;
int32_t cosim_gain_at(void *self, double t, const double *u, double *y);

/* cosim_limit */
typedef struct {
    int32_t width;
    double lower, upper;
} cosim_limits;
int32_t cosim_limit_at(void *self, double t, const double *u, double *y);

/* cosim_product */
typedef struct {
    int32_t count, width;
    const int32_t *divides; /* (count) */
} cosim_products;
int32_t cosim_product_at(void *self, double t, const double *u, double *y);

/* cosim_switch */
typedef struct {
    int32_t width;
    double threshold;
} cosim_threshold;
int32_t cosim_switch_at(void *self, double t, const double *u, double *y);

/* The number of the last point that is not after a value, of points that do not fall; -1: there is
 * none. The search begins at `near`, the result of the last one. */
int64_t cosim_last_not_after(const double *points, int64_t count, double value, int64_t *near);

/* y = f(u) or f(u1, u2), linear in each input between the points of a grid. */
#define COSIM_REFUSE 0 /* outside of the grid it is not defined, */
#define COSIM_HOLD 1   /* or its border counts, */
#define COSIM_GO_ON 2  /* or the border's cell goes on */
typedef struct {
    int64_t count; /* at least 2 */
    const double *points;
    int64_t near;
} cosim_axis;
typedef struct {
    int32_t inputs, outside;
    cosim_axis *axes;     /* (inputs) */
    const double *values; /* (points), or (points1, points2) */
} cosim_look_up;
int32_t cosim_look_up_at(void *self, double t, const double *u, double *y);

/* Values at instants: straight lines between them, or each until the next one. */
typedef struct {
    int32_t width, holds, extrapolates;
    int64_t count;
    const double *t, *y, *slopes; /* (count), (count, width), (count, width) */
    int64_t near;
} cosim_table;
int32_t cosim_table_at(void *self, double t, const double *u, double *y);

/* Rows of a recording, each from its instant on, the last one at its instant only. */
typedef struct {
    int32_t width;
    int64_t count, stride; /* rows; doubles from one to the next */
    const double *t, *rows;
    int64_t near;
} cosim_recorded;
int32_t cosim_recorded_at(void *self, double t, const double *u, double *y);

/* y_i = program_i(t) + sum over its terms of factor(t) c' exp(G t) beta. */
typedef struct {
    int32_t states, element;
    const cosim_program *factor;
    const double *G, *c, *beta; /* (states, states), (states), (states) */
} cosim_linear_response;
typedef struct {
    int32_t count, responses;
    const cosim_program *programs;      /* (count) */
    const cosim_linear_response *terms; /* (responses) */
    double *work;                       /* 4 n n for the most states n */
} cosim_linear_source;
int32_t cosim_linear_source_at(void *self, double t, const double *u, double *y);

/* The first outputs of a source, and each of the others multiplied by an input and added to one of
 * them. */
typedef struct {
    cosim_inner inner;
    int32_t width, products;
    const int32_t *element, *alpha; /* (products) of y, of u */
    double *values;                 /* (width + products) scratch */
} cosim_modulated;
int32_t cosim_modulated_at(void *self, double t, const double *u, double *y);

/* Rows that were drawn ahead, one a step; COSIM_NO_VALUE where none is left. */
typedef struct {
    int64_t count;
    int32_t width;
    const double *rows; /* (count, width) */
    double *next;       /* number of the next row, at least 1 */
} cosim_drawn;
int32_t cosim_drawn_step(void *self, double t0, double t1, double h, const double *u0,
                         const double *u1, double *y);
int32_t cosim_drawn_outputs(void *self, double t, const double *u, double *y);

#endif
