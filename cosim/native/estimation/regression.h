/* The regression (21)-(25), and its least squares. */
#ifndef COSIM_REGRESSION_H
#define COSIM_REGRESSION_H

#include "alphas.h"

/* The products mu of (21)-(25): mu_c = sign_c delta(t - D_row) prod alpha_b(t - D_i). Its inputs
 * are delta, and the signals among the alphas. */
typedef struct {
    /* delays, q + 1, alpha factors of one term */
    int32_t rows, terms, factors;
    const int32_t *steps;            /* (rows) delays in communication steps */
    const cosim_past_alphas *alphas; /* the distinct ones, one a group, at t - D_j */
    const int32_t *row;              /* (terms) row of delta */
    const int32_t *factor;           /* (terms, factors) group * rows + row */
    const double *sign;              /* (terms) */
    /* number of samples before now, ring of the longest delay, (groups, rows) of scratch, ring of
     * the alphas */
    double *memory;
} cosim_regressor;
int32_t cosim_regressor_step(void *self, double t0, double t1, double h, const double *u0,
                             const double *u1, double *y);
void cosim_regressor_outputs(const cosim_regressor *self, double t, const double *u, double *y);

/* How theta of one group follows from the estimates: the recurrence sum_k c_k f(t - D - k spacing)
 * = 0. */
#define COSIM_EXPONENTIAL 1  /* V = 1: one exponential */
#define COSIM_EXPONENTIALS 2 /* V = 2: two exponentials, the larger parameter first */
#define COSIM_SINE 3         /* V = 2: one sine */
#define COSIM_DAMPED_SINE 4  /* V = 2: one damped sine, decay and rate */
#define COSIM_T_EXPONENTIAL 5 /* V = 2: one t exp, a double root */
typedef struct {
    int32_t kind;
    int32_t index[3]; /* which chi; 0 is the normalizer */
    int32_t theta[2]; /* where the results belong */
    double sign[3];
    double spacing; /* [s] */
} cosim_recovery;

/* Least squares (33)-(34) in information form: R'R = prior + integral of m m' dt, accumulated by
 * Givens rotations. */
typedef struct {
    int32_t unknowns, groups, parameters, held;
    double start; /* [s] */
    double prior; /* square root of 1 / P0; 0: none */
    const cosim_recovery *recovery;
    double *memory; /* R (q+1, q+1), then q + 1 of scratch */
} cosim_least_squares;
int32_t cosim_least_squares_step(void *self, double t0, double t1, double h, const double *u0,
                                 const double *u1, double *y);
void cosim_least_squares_start(cosim_least_squares *self, double *y);

/* theta of one group from eta; no value (NaN) where there is none. */
void cosim_recover(const cosim_recovery *recovery, const double *eta, double *theta);

#endif
