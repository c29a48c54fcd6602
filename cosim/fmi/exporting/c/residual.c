/* The descriptor form of a linear model: x', y and the residual are sums of x, z and u times
 * constants. */
#include "residual.h"

/* Rows of the descriptor form, from `first` on. */
static void rows(int32_t first, int32_t count, const double *x, const double *z, const double *u,
                 double *result)
{
    const int32_t n_z = model_residual_form->n_z;
    cosim_multiply(count, model_n, residual_by_x + first * model_n, x, result);
    cosim_multiply_add(count, n_z, residual_by_z + first * n_z, z, result);
    cosim_multiply_add(count, model_m, residual_by_u + first * model_m, u, result);
}

void residual_outputs(const double *x, const double *z, const double *u, double *dx, double *y)
{
    rows(0, model_n, x, z, u, dx);
    rows(model_n, model_p, x, z, u, y);
}

void residual_values(const double *x, const double *z, const double *u, double *r)
{
    rows(model_n + model_p, model_residual_form->n_z, x, z, u, r);
}

double residual_partial(model_unknown of, int32_t row, model_known by, int32_t column)
{
    if (of == MODEL_OUTPUT)
        row += model_n;
    else if (of == MODEL_RESIDUAL)
        row += model_n + model_p;
    if (by == MODEL_BY_STATE)
        return residual_by_x[row * model_n + column];
    if (by == MODEL_BY_ALGEBRAIC)
        return residual_by_z[row * model_residual_form->n_z + column];
    return residual_by_u[row * model_m + column];
}
