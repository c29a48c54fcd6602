/* What the operations of expressions compute. */
#ifndef COSIM_OPERATIONS_H
#define COSIM_OPERATIONS_H

#include "elementary.h"

#include <math.h>
#include <stdint.h>

/* The order is that of OPERATIONS in expression.py. */
enum {
    T, ADD, SUBTRACT, MULTIPLY, DIVIDE, POWER, MINIMUM, MAXIMUM,
    LESS, LESS_EQUAL, EQUAL, NOT_EQUAL, NEGATE,
    SIN, COS, TAN, ASIN, ACOS, ATAN, SINH, COSH, TANH, EXP, LOG, SQRT, ABS, SIGN, STEP,
    OPERATIONS
};

static inline double cosim_binary(int32_t operation, double a, double b)
{
    switch (operation) {
    case ADD: return a + b;
    case SUBTRACT: return a - b;
    case MULTIPLY: return a * b;
    case DIVIDE: return a / b;
    case POWER: return cosim_pow(a, b);
    case MINIMUM: return isnan(a) || a < b ? a : b; /* NaN stays NaN, so that the run stops there */
    case MAXIMUM: return isnan(a) || a > b ? a : b;
    case LESS: return isless(a, b); /* of NaN every comparison is false, also the last one */
    case LESS_EQUAL: return islessequal(a, b);
    case EQUAL: return a == b;
    default: return islessgreater(a, b);
    }
}

static inline double cosim_unary(int32_t operation, double a)
{
    switch (operation) {
    case NEGATE: return -a;
    case SIN: return cosim_sin(a);
    case COS: return cosim_cos(a);
    case TAN: return cosim_tan(a);
    case ASIN: return cosim_asin(a);
    case ACOS: return cosim_acos(a);
    case ATAN: return cosim_atan(a);
    case SINH: return cosim_sinh(a);
    case COSH: return cosim_cosh(a);
    case TANH: return cosim_tanh(a);
    case EXP: return cosim_exp(a);
    case LOG: return cosim_ln(a);
    case SQRT: return sqrt(a);
    case ABS: return fabs(a);
    case SIGN: return isnan(a) ? a : (a > 0.0) - (a < 0.0);
    default: return isnan(a) ? a : (a >= 0.0 ? 1.0 : 0.0);
    }
}

#endif
