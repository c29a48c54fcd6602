/* Output error: the model that is fitted, passes over its samples, and the fit. */
#ifndef COSIM_OUTPUT_ERROR_H
#define COSIM_OUTPUT_ERROR_H

#include "cosim.h"

/* Of a model that is fitted, and so of its components, each of which has a column. */
#define COSIM_MOST_COLUMNS 48
#define COSIM_MOST_PARAMETERS 16

/* The outputs of a linear plant under a disturbance of the class (4)-(5), as a regression:
 *     x' = A x + sum_i B_i alpha_i f_i,   y = C x + sum_i D_i alpha_i f_i + offset,
 *     f_i = c_i' expm(G_i t) beta_i,      G_i = G0_i + sum_j theta_ij G1_ij,
 * linear in beta_i = beta_i(0), x(0) and the offset. The disturbance is a straight line between
 * samples. */
typedef struct {
    int32_t states, outputs, components;
    int32_t sources;       /* known factors alpha, each with its B and D */
    int32_t offset;        /* whether a constant on every output is unknown */
    int32_t ar;            /* order of the filter that whitens the noise */
    int32_t average;       /* steps, the mean of whose samples is one row; more than 1 without ar */
    const int32_t *size;   /* (components) V_i */
    const int32_t *count;  /* (components) parameters in theta_i */
    const int32_t *source; /* (components) which of them each has */
    const double *c;       /* c_i one behind the other */
    const double *G0, *G1; /* G0_i, and G1_i1, G1_i2, ..., each (V_i, V_i) */
    const double *step;    /* (intervals) length of an interval between samples [s] */
    const double *Ad;      /* (intervals, states, states) */
    const double *B0, *B1; /* (intervals, sources, states) for both ends of the interval */
    const double *K;       /* (intervals, states, outputs) gain of the predictor, in Ad, B0 */
    const double *L;       /* (intervals, outputs, outputs) lower triangle: L e has the covariance
                            * of the noise, e is what is predicted wrong at the interval's end */
    const double *C;       /* (outputs, states) */
    const double *D;       /* (sources, outputs) */
    const double *W;       /* (outputs, outputs) makes the noise of the outputs white */
    const double *a;       /* (outputs, ar) W e is white, e(k) = v(k) - a_1 v(k-1) - ..., where v is
                            * y less the fit */
    const double *every;   /* (outputs) time from one value to the next that `a` is for [s] */
    double forgetting;     /* weight of the square of a row over that of the next sample */
} cosim_output_error;

/* Samples between those of the grid, in the order of time. The row of an output is (C, D0, D1): it
 * is C x + D0 d0 + D1 d1, with the state at the beginning of the step and the disturbances at both
 * ends. */
typedef struct {
    int64_t count;
    double *place;    /* (count) sample of the grid at the end of the step */
    double *rows;     /* (count, outputs, states + 2 sources) */
    double *residual; /* (count, outputs) as that of the grid */
} cosim_between_record;

typedef struct {
    int64_t first, end;      /* samples of the window */
    const double *residual;  /* (samples, outputs) y less its known part; NaN: not measured */
    const double *alpha;     /* (samples, sources) */
    const int32_t *interval; /* (samples) which one ends at the sample; NULL: 0 for all */
    const cosim_between_record *between; /* NULL: none; only without ar and K */
} cosim_record;

/* What the outputs would be without disturbance, from x(0) = 0: with the gain K of a predictor,
 *     x' = Ad x + B0 u0 + B1 u1 + K y,   y = C x + D u,   B0 less K D. */
typedef struct {
    int32_t inputs;
    const double *B0, *B1;   /* (intervals, states, inputs) */
    const double *D;         /* (outputs, inputs) */
    const uint8_t *predicts; /* (intervals) whether K is used: there is a y */
} cosim_known_input;
/* y less that, for samples begin..end-1; x: the state at sample begin - 1, and as much scratch. */
void cosim_output_error_residual(const cosim_output_error *self, const cosim_known_input *known,
                                 int64_t begin, int64_t end, const double *u, const double *y,
                                 const int32_t *interval, double *x, double *residual);

/* E_i = expm(G_i h) of all components, and F_ij, their derivatives by theta, one behind the other;
 * `work` has 6 V V doubles for the largest V. */
void cosim_output_error_basis(const cosim_output_error *self, const double *theta, double h,
                              double *E, double *F, double *work);

/* A pass over samples makes the upper triangle R of [basis, x(0), offset, d basis/d theta,
 * residual] at the beginning of `work`. `start` begins at the first sample of a window, `take` goes
 * on. */
int64_t cosim_output_error_memory(const cosim_output_error *self);
int32_t cosim_output_error_columns(const cosim_output_error *self);
void cosim_output_error_start(const cosim_output_error *self, const double *theta, double *work);
void cosim_output_error_take(const cosim_output_error *self, const double *theta,
                             const cosim_record *record, int64_t begin, int64_t end, double *work);
/* The products of the outputs' residuals, (outputs, outputs), summed over the window, at theta and
 * the linear unknowns; `work` is used. */
void cosim_output_error_products(const cosim_output_error *self, const double *theta,
                                 const double *unknowns, const cosim_record *record, double *work,
                                 double *products);
/* The rows of every sample of the window, (samples, outputs, columns), neither filtered nor
 * weighed. */
void cosim_output_error_rows(const cosim_output_error *self, const double *theta,
                             const cosim_record *record, double *work, double *rows);

/* What became of a parameter. */
#define COSIM_ESTIMATED 0
#define COSIM_FIXED 1     /* its bounds are equal */
#define COSIM_ABSENT 2    /* noise alone explains its component */
#define COSIM_DEPENDENT 3 /* other parameters have the same effect */
#define COSIM_AT_BOUND 4

typedef struct {
    const cosim_output_error *model;
    cosim_record record;
    double *work;       /* cosim_output_error_memory doubles */
    double *amplitudes; /* beta, x(0), offset */
} cosim_experiment;

/* Variable projection: the linear unknowns of every experiment are eliminated by orthogonal
 * rotations, theta is found by Gauss-Newton on what remains (G. Golub and V. Pereyra, SIAM J.
 * Numerical Analysis, 1973; L. Kaufman, BIT, 1975). */
typedef struct {
    int32_t experiments, components, parameters;
    int32_t most_iterations, iterations;
    const cosim_experiment *experiment;
    const int32_t *count;        /* (components) */
    const double *lower, *upper; /* (parameters) */
    const double *scale;         /* (parameters) longest step */
    const double *threshold;     /* (components) statistic from which on it is no noise */
    double accuracy;             /* of a row: what is smaller is rounding */
    double tolerance;            /* of update, in units of the step that is small enough */
    double most_squares;         /* predicted after a few steps; a fit with more is given up */
    double *theta;               /* (parameters) where the regression is linearized */
    double *estimate;            /* (parameters) */
    double *covariance;          /* (parameters, parameters) of the estimate */
    double *statistics;          /* (components) beta' C^-1 beta, C of unit variance */
    uint8_t *state;              /* (parameters) */
    double variance;             /* of a row */
    double freedom;              /* rows less unknowns */
} cosim_fit;
/* Iterate from theta to the least squares. The last step moves the linear unknowns to first
 * order. */
int32_t cosim_output_error_fit(cosim_fit *self);
/* Pass over all samples at the estimate: the linear unknowns, the variance and R are then those
 * there. */
void cosim_output_error_settle(cosim_fit *self);
/* One step with the R that is there, for samples that were taken since. */
int32_t cosim_output_error_update(cosim_fit *self);

#endif
