/* Expressions in t. */
#ifndef COSIM_EXPRESSION_H
#define COSIM_EXPRESSION_H

#include "cosim.h"

/* An expression in t as a postfix program; see expression.py for the language. */
typedef struct {
    int32_t length;
    const int32_t *code;     /* operation, or number of operations + index of a constant */
    const double *constants; /* referred to by code */
} cosim_program;
#define COSIM_STACK 64
double cosim_evaluate(const cosim_program *program, double t);

typedef struct {
    int32_t count;
    const cosim_program *programs;
} cosim_expression;
int32_t cosim_expression_step(void *self, double t0, double t1, double h, const double *u0,
                              const double *u1, double *y);

#endif
