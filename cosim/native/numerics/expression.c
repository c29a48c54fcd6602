#include "expression.h"
#include "elementary.h"

#include <math.h>
#include <stddef.h>

/* The order is that of OPERATIONS in expression.py. */
enum {
    T, ADD, SUBTRACT, MULTIPLY, DIVIDE, POWER, MINIMUM, MAXIMUM,
    LESS, LESS_EQUAL, EQUAL, NOT_EQUAL, NEGATE,
    SIN, COS, TAN, ASIN, ACOS, ATAN, SINH, COSH, TANH, EXP, LOG, SQRT, ABS, SIGN, STEP,
    OPERATIONS
};

static double binary(int32_t operation, double a, double b)
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

static double unary(int32_t operation, double a)
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

double cosim_evaluate(const cosim_program *program, double t)
{
    return cosim_evaluate_row(program, t, NULL);
}

double cosim_evaluate_row(const cosim_program *program, double t, const double *row)
{
    double stack[COSIM_STACK];
    int32_t top = -1;
    for (int32_t i = 0; i < program->length; ++i) {
        const int32_t code = program->code[i];
        if (code < 0)
            stack[++top] = row[-1 - code];
        else if (code >= OPERATIONS)
            stack[++top] = program->constants[code - OPERATIONS];
        else if (code == T)
            stack[++top] = t;
        else if (code < NEGATE) {
            stack[top - 1] = binary(code, stack[top - 1], stack[top]);
            --top;
        } else
            stack[top] = unary(code, stack[top]);
    }
    return stack[0];
}

void cosim_evaluate_rows(const cosim_program *program, int64_t count, const double *t,
                         const double *rows, int64_t stride, double *values)
{
    for (int64_t k = 0; k < count; ++k)
        values[k] = cosim_evaluate_row(program, t[k], rows + k * stride);
}

int32_t cosim_expression_step(void *self, double t0, double t1, double h, const double *u0,
                              const double *u1, double *y)
{
    (void)t0, (void)h, (void)u0;
    const cosim_expression *s = self;
    for (int32_t i = 0; i < s->count; ++i)
        y[i] = cosim_evaluate_row(&s->programs[i], t1, u1);
    return COSIM_OK;
}
