#ifndef COSIM_IDENTIFIER_H
#define COSIM_IDENTIFIER_H

#include "between.h"
#include "predictor.h"
#include "rayleigh.h"
#include "regression.h"
#include "start_grid.h"

/* A predictor in some modes w alone, x = V w, for samples that may be missing. */
typedef struct {
    cosim_predictor modes; /* of one interval */
    const double *V;       /* (states, modes) */
    const double *P;       /* (modes, modes) at the first sample */
} cosim_mode_predictor;

/* Output error online: every `period` samples theta is estimated from all of them, or from those of
 * a moving window. A start is searched on a grid by y itself, and, once mu counts, by the Rayleigh
 * quotient and improved on delta. The search is repeated when the samples have become so many more,
 * and the best of all fits counts, so that no local minimum stays for long. Its inputs are mu, the
 * signals among the alphas, delta, y and u, of which a step takes those at its beginning; its
 * outputs are theta, its standard errors, the deviation of the noise of each y, and the amplitudes
 * at the beginning of the window. Where the noise of several y is not known, its covariance is that
 * of the residual, and estimated again with every fit to all samples: at least as often as they
 * have become twice as many. Where y is sampled at instants of its own, the samples stand between y
 * and u in the inputs, and count in the place of y. Without on_y it ends with what was found on
 * delta, its outputs are theta and the amplitudes; without on_delta too with the quotient, its
 * inputs are mu and the signals and its output theta. */
typedef struct {
    int32_t period;
    int32_t width;    /* of the outputs */
    int32_t average;  /* samples of mu that make one row */
    int32_t weighs;   /* whether W is estimated, of several outputs; else it is that of on_y */
    int32_t disturbances; /* elements of delta */
    int32_t grids;        /* 0: none */
    int64_t window;   /* samples; 0: all */
    int64_t capacity; /* samples */
    double start;     /* first instant of which mu counts [s] */
    double settled;   /* first instant of which delta counts [s] */
    const cosim_regressor *products;
    const cosim_past_alphas *lagging; /* those of the components, as late as delta; one row */
    const cosim_rayleigh *rayleigh;
    const cosim_output_error *on_delta, *on_y; /* NULL: not fitted */
    const cosim_known_input *known;            /* of on_y */
    const double *lower, *upper, *scale; /* (parameters) as in cosim_fit */
    const double *threshold;             /* (components) */
    const double *deviations;            /* (outputs) of the noise that the W of on_y makes white */
    const cosim_start_grid *grid; /* (grids) of equal sizes, for longer and longer data */
    const int32_t *reach;         /* (grids) samples up to which each counts; the last for all */
    const cosim_between *between; /* NULL: y is sampled at the communication points */
    /* of y whose samples, of communication points alone, may be missing; NULL: its gain is K of
     * on_y */
    const cosim_mode_predictor *predictor;
    double *memory;
} cosim_identifier;
/* The number of doubles of `memory`, and of those before the samples, which are only appended. */
int64_t cosim_identifier_memory(const cosim_identifier *self);
int64_t cosim_identifier_state(const cosim_identifier *self);
/* The parts of the memory that the samples of a state fill: begin and length of each, in pairs;
 * returns how many. */
int64_t cosim_identifier_samples(const cosim_identifier *self, const double *state, int64_t *parts);
void cosim_identifier_start(cosim_identifier *self, double *y);
int32_t cosim_identifier_step(void *self, double t0, double t1, double h, const double *u0,
                              const double *u1, double *y);

#endif
