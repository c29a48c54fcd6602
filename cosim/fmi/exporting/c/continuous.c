/* A linear model, x' = A x + B u, y = C x + D u, x = X0 + Xu u initially. A step is exact for
 * inputs that are linear in time; its discretization is computed again only where the communication
 * step size changes. memory: x, then scratch. */
#include "continuous.h"

void model_initialize(double *memory, const double *x0, double t, const double *u)
{
    (void)t;
    cosim_multiply(model_n, model_m, model_Xu, u, memory);
    for (int32_t k = 0; k < model_n; ++k)
        memory[k] = x0[k] + memory[k];
}

void model_outputs(double *memory, double t, const double *u, double *y)
{
    (void)t;
    cosim_multiply(model_p, model_n, model_C, memory, y);
    cosim_multiply_add(model_p, model_m, model_D, u, y);
}

void model_derivatives(const double *memory, double t, const double *u, double *dx)
{
    (void)t;
    cosim_multiply(model_n, model_n, model_A, memory, dx);
    cosim_multiply_add(model_n, model_m, model_B, u, dx);
}

/* work: h of the discretization, Ad (n, n), B0 (n, m), B1 (n, m), scratch. */
const char *model_advance(double *memory, double *work, double t0, double t1, double h,
                          const double *u0, const double *u1, double *y)
{
    double *Ad = work + 1, *B0 = Ad + model_n * model_n, *B1 = B0 + model_n * model_m,
           *scratch = B1 + model_n * model_m;
    cosim_linear step = {model_n, model_m, model_p, Ad, B0,   B1,
                         model_C, model_D, memory,  NULL, 0,  NULL};
    if (work[0] != h) {
        cosim_first_order_hold(model_n, model_m, model_A, model_B, h, model_free, Ad, B0, B1,
                               scratch);
        work[0] = h;
    }
    cosim_linear_step(&step, t0, t1, h, u0, u1, y);
    return NULL;
}

/* d(row . x)/du_j in initialization mode, where x = X0 + Xu u. */
static double through_initial_state(const double *row, int32_t j)
{
    double sum = 0.0;
    for (int32_t k = 0; k < model_n; ++k)
        sum += row[k] * model_Xu[k * model_m + j];
    return sum;
}

double model_by_input(double *memory, double *work, double t, const double *u, model_unknown of,
                      int32_t row, int32_t input, int in_initialization)
{
    (void)memory, (void)work, (void)t, (void)u;
    if (of == MODEL_STATE)
        return in_initialization ? model_Xu[row * model_m + input] : 0.0;
    const double *of_x = (of == MODEL_OUTPUT ? model_C : model_A) + row * model_n;
    const double *of_u = (of == MODEL_OUTPUT ? model_D : model_B) + row * model_m;
    return of_u[input] + (in_initialization ? through_initial_state(of_x, input) : 0.0);
}

double model_by_state(model_unknown of, int32_t row, int32_t state)
{
    if (of == MODEL_STATE)
        return row == state ? 1.0 : 0.0;
    return (of == MODEL_OUTPUT ? model_C : model_A)[row * model_n + state];
}
