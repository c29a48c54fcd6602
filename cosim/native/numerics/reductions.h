/* Expressions over rows, and what is kept of their values: sums, extremes, the first and the last.
 *
 * The expressions of all reductions are one list of instructions, each of which computes a vector
 * of COSIM_CHUNK values at most from others; what several expressions have in common is computed
 * once. Sums run from row to row, whatever the chunks are. A value that is NaN is none. */
#ifndef COSIM_REDUCTIONS_H
#define COSIM_REDUCTIONS_H

#include "cosim.h"

#define COSIM_CHUNK 128 /* rows */

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
    double sum, squares;
    double shifted_sum, shifted_squares; /* of the differences to the first value */
    double integral;                     /* trapezoidal rule, between rows that follow each other */
    double before, t_before;             /* the row before; NaN: it has no value, or is not there */
    double *kept, *kept_times;           /* all values and their instants, with room for them */
} cosim_reduction;

typedef struct {
    const cosim_instruction *instructions;
    cosim_hold *holds;
    cosim_reduction *reductions;
    double *registers;
    int32_t n_instructions, n_reductions;
} cosim_reductions;

/* Go on over `count` rows, which begin `stride` doubles apart. */
void cosim_reduce_rows(cosim_reductions *s, int64_t count, const int64_t *time_ns, const double *t,
                       const double *rows, int64_t stride);

#endif
