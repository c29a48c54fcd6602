/* The unknowns of a loop at the end of a step: w(v) = v.
 *
 * v are the inputs at which the loop is torn. A sweep advances its components from the start of the
 * step with v at its end, and gives back w(v), what drives these inputs then. The solver is called
 * in turns with sweeps: it names the next v, the caller answers with w. So it is the same for
 * components in compiled code and in Python.
 *
 * Of a loop that is replayed v is recorded, and nothing is solved for. With a fixed number of
 * iterations v is what the sweep before gave, solution or not. Else it is Newton's method:
 * the matrix 1 - dw/dv is taken by differences, a sweep an element, and kept for as long as it
 * converges, over many steps. */
#ifndef COSIM_LOOP_SOLVER_H
#define COSIM_LOOP_SOLVER_H

#include "cosim.h"

/* What is next. */
#define COSIM_SOLVED 0    /* v is the solution; the components have advanced with it */
#define COSIM_SWEEP 1     /* another sweep, with v */
#define COSIM_UNDECIDED 2 /* 1 - dw/dv is singular: no solution, or more than one */
#define COSIM_UNSOLVED 3  /* no solution was found */
#define COSIM_INVALID 4   /* w is not finite */
#define COSIM_ASK 5       /* to be called again with the largest value */

typedef struct {
    int64_t n;
    /* recorded v (n_rows, n) and their instants (n_rows); n_rows 0: they are solved for */
    int64_t n_rows;
    const double *times, *rows;
    int64_t iterations; /* sweeps of a step, each with what the one before gave; 0: Newton */
    /* what is kept over steps: whether there is a matrix; the largest |v| so far (n); scales of the
     * unknowns (n); the factors of the matrix in these scales (n, n); their order of rows (n) */
    double *memory;
    double *v; /* (n) what the next sweep takes */
    /* scratch: v and w at the point (2 n); the residual (n) */
    double *point;
    /* of this step: points so far, the column that is differenced, or -1; whether the matrix is one
     * of this step's points; how often the correction was halved; whether the next sweep is the
     * last; whether rounding may be all that is left at the point; the residual there in units of
     * its tolerance */
    int64_t sweeps, column, is_new, halvings, is_last, point_is_rounding;
    double before;
    /* of the candidate: the worst element, its residual and what is allowed */
    int64_t worst;
    double residual, tolerance;
} cosim_loop_solver;

/* Begin a step that ends at t1; v is filled: a guess. */
void cosim_loop_solver_begin(cosim_loop_solver *self, double t1);

/* Take w (n) of the sweep with v; `largest`: of all values involved, for what rounding leaves. That
 * is rarely needed: it may be NaN, and where it is needed then, nothing is done yet. */
int32_t cosim_loop_solver_next(cosim_loop_solver *self, const double *w, double largest);

#endif
