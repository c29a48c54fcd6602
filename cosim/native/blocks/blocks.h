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
    /* communication steps since its own step began, time and inputs (n_u) then, outputs that are
     * held (n_y) */
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

/* --- functions.c --- */

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
    cosim_program factor;
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

/* --- field_data.c --- */

/* Samples at instants of their own: at a communication point the values on the straight lines
 * between those of each element, then the samples since the point before, `most` places for each
 * element and for their instants. COSIM_OUTSIDE where an element is not measured, or the places do
 * not suffice. */
typedef struct {
    int64_t count; /* of the samples of an element */
    const double *t, *values;
    int64_t near;
} cosim_line;
typedef struct {
    int32_t elements, most;
    cosim_line *lines; /* (elements) */
    int64_t count;     /* of all instants */
    /* (elements + 1, count): samples, NaN where there is none; in the last row their instants */
    const double *columns;
    double end;     /* the last instant at which all is measured */
    double *before; /* the communication point before the last */
    int64_t near;
} cosim_field_data;
int32_t cosim_field_data_step(void *self, double t0, double t1, double h, const double *u0,
                              const double *u1, double *y);

/* --- sensor.c --- */

/* A measuring chain; sensor.py describes the effects and their order. Random numbers are drawn
 * ahead, a row a sample: COSIM_NO_VALUE where they are used up. */
typedef struct {
    int32_t size, depth;    /* elements; inputs before the time reached that are kept */
    int32_t period;         /* communication steps between two samples */
    int32_t drops;          /* there is the output `valid` */
    int32_t samples, stamps; /* the samples are outputs; their times are the sampling instants */
    int32_t quantizes;
    double h, begin; /* communication step, start of the run [s] */
    const uint8_t *held; /* (size) zero-order hold of this element of the input */
    const double *bias, *lower, *upper;                /* (size) */
    const double *origin, *resolution, *first, *last;  /* (size) levels origin + i resolution */
    int64_t drawn;
    /* (drawn, size): sampling instant minus t in communication steps; whether the sample is lost */
    const double *position, *noise, *lost;
    /* communication steps since the last sample, the period where one is due now; number of the
     * next row; the oldest of the inputs; y and `valid` before the time reached; inputs (depth,
     * size), a ring */
    double *memory;
} cosim_sensor;
int32_t cosim_sensor_step(void *self, double t0, double t1, double h, const double *u0,
                          const double *u1, double *y);
int32_t cosim_sensor_outputs(void *self, double t, const double *u, double *y);

/* --- compensator.c --- */

/* A compensator; compensator.py of the blocks has the equations. COSIM_NO_VALUE where the estimates
 * are not those that were judged last: then they are judged, and the gains made anew. */
typedef struct {
    int32_t n_u, n_w, known, regulated, parameters;
    int32_t follows;                           /* there is an internal model */
    int32_t reference, theta, standard_error;  /* first columns of these inputs */
    const int32_t *known_columns, *regulated_columns;
    const double *before;                      /* (n_u, known) */
    const double *lower, *upper;               /* (n_u) */
    const double *X, *minus_K_w, *generator;   /* (n_w, known), (n_u, n_w), (n_w, driving) */
    const double *judged;                      /* (2, parameters) theta and its standard errors */
    double *memory;                            /* u, w, whether it is active, theta in use */
    double *work; /* known + n_w + n_u + driving, which is n_w + regulated + n_u */
} cosim_compensator;
int32_t cosim_compensator_step(void *self, double t0, double t1, double h, const double *u0,
                               const double *u1, double *y);
int32_t cosim_compensator_outputs(void *self, double t, const double *u, double *y);

/* --- late_samples.c --- */

/* A component that takes its inputs at the beginning of a step, held back by so many steps until
 * their samples have come. COSIM_OUTSIDE where a sample has no place among the rows. */
typedef struct {
    cosim_inner inner;
    int32_t steps, n_u, n_y; /* inputs and outputs of the component */
    int32_t shown_samples, shown_times, samples, times; /* first columns, as shown and of it */
    int32_t values, most;  /* outputs that are sampled; places for a sample of each in its inputs */
    const int32_t *source; /* (n_u) column that is shown; -1: a place for a sample */
    /* rows that are held back, the oldest of them, time of the last one before, outputs (n_y), rows
     * (steps + 1, 1 + n_u), a ring */
    double *memory;
} cosim_late_samples;
int32_t cosim_late_samples_step(void *self, double t0, double t1, double h, const double *u0,
                                const double *u1, double *y);
int32_t cosim_late_samples_outputs(void *self, double t, const double *u, double *y);

#endif
