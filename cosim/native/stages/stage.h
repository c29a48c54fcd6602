/* Components that advance together: one call for many of them and many communication steps.
 *
 * The signals of a graph stand in rows, one a communication point; each component has its columns,
 * its inputs and behind them its outputs. A stage is a list of operations that fills the next row,
 * done once for every step; those of one segment for some steps before the next one does them,
 * which keeps code and rows in the caches.
 *
 * It has two ends: the last row wanted, and an operation that is not done here. Then the cursor
 * shows that operation; whoever called does it, and calls again. So components without a native
 * step take part, and what is rare in a native step (an event, an error) is left to code that is
 * written to be read. */
#ifndef COSIM_STAGE_H
#define COSIM_STAGE_H

#include "cosim.h"
#include "loop_solver.h"

/* Outputs at t, the time reached, for inputs u; changes no state. 0: fine. */
typedef int32_t (*cosim_outputs)(void *self, double t, const double *u, double *y);

/* A column that is copied. */
typedef struct {
    int32_t to, from;
} cosim_copy;

/* Many that follow each other. */
typedef struct {
    int32_t to, from, count;
} cosim_wide_copy;

typedef struct {
    int32_t from;
    double gain;
} cosim_term;

/* One column: ((v factor1 + offset1) - offset2) / factor2 where it `converts`, of
 * v = offset + sum_j gain_j value_j, or of the value of its only term where it has `plain` set. */
typedef struct {
    const cosim_term *terms;
    int32_t to, n_terms, plain, converts;
    double offset;
    double factor1, offset1, offset2, factor2;
} cosim_sum;

/* Copies and puts back the state of a component; 0: done. */
typedef int32_t (*cosim_rollback_call)(void *self);

/* How a component goes back to the start of a step: by its functions, or, where these are NULL, as
 * its state is all in one memory. */
typedef struct {
    cosim_rollback_call save, restore;
    double *memory, *saved; /* (count) */
    int64_t count;
    int32_t is_saved; /* here; else by the caller */
} cosim_rollback;

/* An output that jumps: its column, and that of its left limit; -1: that is its value in the row
 * before, as it is discrete. */
typedef struct {
    int32_t column, limit;
} cosim_jump;

/* A component in its place. */
typedef struct {
    cosim_step advance;    /* NULL: left to the caller */
    cosim_outputs outputs; /* NULL: left to the caller */
    void *self;
    int32_t u, n_u, y, n_y;  /* first column and number of its inputs, and of its outputs */
    int32_t n_copies, n_wide, n_sums, n_torn; /* what feeds its inputs */
    int32_t takes_latest; /* over a step its inputs have the values that they have at its end */
    const cosim_copy *copies;
    const cosim_wide_copy *wide_copies; /* (n_wide) */
    const cosim_sum *sums;
    const uint8_t *optional; /* (n_u + n_y) where NaN means "no value yet" */
    double *seconds;         /* wall time of its calls is added to it; NULL: it is not measured */
    /* inputs that are overridden: how many, then their columns; and gain and value of each. Where
     * the gain is 0 it has the value; else the gain times what its source gives, plus the value. */
    const int32_t *overridden;
    const double *gains, *overrides;
    /* inputs that a loop solves for, or keeps for a step (n_torn): their columns, and what is tried
     * for them, or kept */
    const int32_t *torn;
    double *tried;
    cosim_rollback *rollback; /* NULL: left to the caller */
    /* what jumps: outputs, of whatever member, whose left limits it takes at the end of a step, and
     * memory for so many right ones; and where the left limits of its own outputs are kept, by the
     * caller for what is left to him */
    const cosim_jump *jumps; /* (n_jumps) */
    double *right;
    const cosim_copy *limits;
    int32_t n_jumps, n_limits;
    /* of its own jumps: whether there are any at the end of the step, and all outputs
     * before them; NULL: it has none */
    const int32_t *has_jumped;
    const double *left_outputs; /* (n_y) */
} cosim_member;

/* What an operation does to a member, or to `count` of them: */
#define COSIM_KEEP 0    /* outputs of the new row <- those of the row before */
#define COSIM_GATHER 1  /* inputs of the new row <- their sources in it */
#define COSIM_ADVANCE 2 /* gather; outputs <- advance */
#define COSIM_REFRESH 3 /* gather; outputs <- outputs for the inputs that are there now */
#define COSIM_CHECK 4   /* left to the caller where a value of the new row is not finite */
/* and in a loop that iterates: */
#define COSIM_SAVE 5    /* copy the state */
#define COSIM_BEGIN 6   /* begin to solve for the torn inputs: on to `sweep` */
#define COSIM_RESTORE 7 /* put the copied state back */
#define COSIM_SOLVE 8   /* on behind it, or to `restore` for another sweep; or left to the caller */
/* and where components advance together: */
#define COSIM_GATHER_TOGETHER 9   /* gather; keep what is to be kept of it */
#define COSIM_ADVANCE_TOGETHER 10 /* outputs <- advance, with the inputs that are there */
#define COSIM_RECORD 11           /* gather, also what was kept */
/* and of members with jumps, whose inputs are gathered from left limits to advance or refresh: */
#define COSIM_RIGHT 12 /* where one of these is no right limit, refresh for the right ones */

typedef struct {
    const cosim_member *members;
    int32_t kind, count;
} cosim_operation;

/* What a loop solves for. */
typedef struct {
    cosim_loop_solver *solver;
    double *w;              /* (n) what a sweep gave */
    int64_t sweep, restore; /* the operations with which a sweep begins, and going back */
    int32_t status;         /* what the solver said last */
    int32_t stopped;        /* whether a component has stopped in the sweep, with its row */
} cosim_unknowns;

/* Operations that follow each other: one component outside every loop, or a loop. None of them
 * reads what a later segment writes at the same step or before it. */
typedef struct {
    const cosim_operation *operations;
    int64_t count, first; /* of them, and the number of the first one */
    int64_t cascade;      /* one component outside every loop: advance and check */
    cosim_unknowns *unknowns; /* NULL: it does not iterate */
} cosim_segment;

typedef struct {
    const cosim_segment *segments;
    int64_t n_segments;
    int64_t width; /* columns of a row */
    int64_t tile;  /* steps that a segment does before the next one does them */
    /* the block */
    const double *t; /* (steps + 1) [s] */
    double *rows;    /* (steps + 1, width), row 0 filled */
    double h;        /* [s] */
    /* the cursor: steps that all segments have completed, the segment, the steps that it has
     * completed, and its operation that is next */
    int64_t completed, segment, step, operation;
    /* of this step of the segment: whether an output that was advanced or refreshed, or a sum, was
     * not finite; column of the first such output, -1: none; and its value then */
    int64_t suspicious, origin;
    double origin_value;
} cosim_stage;

/* What the caller has done about the operation that was left to it. */
#define COSIM_HERE 0 /* nothing: the cursor shows what is next */
#define COSIM_DONE 1 /* the operation is done */
#define COSIM_OVER 2 /* its segment goes no further; the others do, up to `end` */

/* Do the operations from the cursor on, until `end` steps are completed: 0; or one is left to the
 * caller: its number among all operations, counted from 1. */
int64_t cosim_stage_run(cosim_stage *self, int64_t end, int32_t answer);

/* Add up rows (n_rows, width) one after the other: of each column how many have a value, their sum
 * and the sum of their squares. */
void cosim_accumulate(int64_t n_rows, int64_t width, const double *rows, double *counts,
                      double *sums, double *squares);

/* A step whose function does not know of inputs with a zero-order hold: it gets their values at the
 * start of the step at both ends, and the outputs are evaluated for those at the end. */
typedef struct {
    cosim_step step;
    cosim_outputs outputs;
    void *self;
    int32_t n_u;
    const uint8_t *held; /* (n_u) */
    double *u;           /* (n_u) scratch */
} cosim_held;
int32_t cosim_held_step(void *self, double t0, double t1, double h, const double *u0,
                        const double *u1, double *y);
int32_t cosim_held_outputs(void *self, double t, const double *u, double *y);

#endif
