/* Expressions in t, and over the values of a row. */
#ifndef COSIM_EXPRESSION_H
#define COSIM_EXPRESSION_H

#include "cosim.h"

/* The values of an expression in t alone, in the order in which a run asks for them. */
typedef struct {
    int64_t room, count, next; /* values at most; values; the one that is asked for next */
    int64_t misses;            /* instants in a row that were not among the next ones */
    double *t, *values;        /* (room) */
} cosim_program_cache;

/* An expression as a postfix program; see expression.py for the language. */
typedef struct {
    int32_t length;
    const int32_t *code;        /* operation, or number of operations + index of a constant, or
                                   -1 - column of the row */
    const double *constants;    /* referred to by code */
    cosim_program_cache *cache; /* NULL: every value is computed */
} cosim_program;
#define COSIM_STACK 64
double cosim_evaluate(const cosim_program *program, double t); /* of t alone */
double cosim_evaluate_row(const cosim_program *program, double t, const double *row);
/* At the instants t (count), each with a row; rows begin `stride` doubles apart. */
void cosim_evaluate_rows(const cosim_program *program, int64_t count, const double *t,
                         const double *rows, int64_t stride, double *values);

/* Outputs that are expressions, over the inputs as a row. */
typedef struct {
    int32_t count;
    const cosim_program *programs;
} cosim_expression;
int32_t cosim_expression_step(void *self, double t0, double t1, double h, const double *u0,
                              const double *u1, double *y);

#endif
