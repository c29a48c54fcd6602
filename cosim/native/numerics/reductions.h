/* Expressions over rows, and what is kept of their values: sums, extremes, the first and the last.
 *
 * The expressions of all reductions are one list of instructions, each of which computes a vector
 * of COSIM_CHUNK values at most from others; what several expressions have in common is computed
 * once. A value that is NaN is none.
 *
 * A sum has COSIM_LANES parts, each of the rows whose numbers have the same rest; they run from row
 * to row and are added up at the end: the bits do not depend on how the rows come, and a processor
 * adds to several parts at once. */
#ifndef COSIM_REDUCTIONS_H
#define COSIM_REDUCTIONS_H

#include "cosim.h"

#define COSIM_CHUNK 128 /* rows */
#define COSIM_LANES 4

enum { COSIM_SUM, COSIM_SQUARES, COSIM_SHIFTED, COSIM_SHIFTED_SQUARES, COSIM_INTEGRAL, COSIM_SUMS };

/* Operations beside those of expressions, behind them (COSIM_COLUMN and so on in reductions.c). */
typedef struct {
    int32_t operation;
    int32_t result; /* numbers of registers, of COSIM_CHUNK values each */
    int32_t a;      /* or the number of a column */
    int32_t b;      /* or the number of a hold */
} cosim_instruction;

/* A condition that has to hold without a break for a time. */
typedef struct {
    int64_t duration_ns;
    int64_t since_ns;
    int32_t is_holding;
} cosim_hold;

/* What is kept of the values of a register; the parts are those of PARTS in reductions.py. */
typedef struct {
    int32_t values; /* number of a register */
    int32_t parts;  /* bits */
    int64_t count;  /* how many values there are */
    double first, last;
    double low, high;
    double sums[COSIM_SUMS]; /* of values, of squares; of differences to the first value, of their
                                squares; trapezoidal rule, between rows that follow each other */
    double lanes[COSIM_SUMS][COSIM_LANES];
    double before, t_before; /* the row before; NaN: it has no value, or is not there */
    double *kept;            /* the values of all rows, NaN too, with room for them */
} cosim_reduction;

typedef struct {
    const cosim_instruction *instructions;
    cosim_hold *holds;
    cosim_reduction *reductions;
    double *registers;
    int32_t n_instructions, n_holds, n_reductions;
    int64_t n_rows; /* so far */
} cosim_reductions;

/* Forget all rows. */
void cosim_begin_reductions(cosim_reductions *s);

/* Go on over `count` rows, which begin `stride` doubles apart, at the instants t [s]. These are
 * time_ns in nanoseconds; where it is NULL, they are step_ns apart from first_ns on. */
void cosim_reduce_rows(cosim_reductions *s, int64_t count, const int64_t *time_ns, int64_t first_ns,
                       int64_t step_ns, const double *t, const double *rows, int64_t stride);

/* The place of the first value behind the last one that is farther than a band from `center`; NaN
 * is no value; `count`: there is none. */
int64_t cosim_settled(int64_t count, const double *x, double center, double band);

#endif
