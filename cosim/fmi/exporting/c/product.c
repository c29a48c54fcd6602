/* Inputs multiplied and divided, element by element (cosim_product). */
#include "discrete.h"

extern const int32_t kernel_count;     /* of inputs, each of model_p elements */
extern const int32_t kernel_divides[]; /* y is divided by this input */

/* The product for one element, without one of the inputs. */
static double product_of_others(const double *u, int32_t element, int32_t without)
{
    double y = 1.0;
    for (int32_t k = 0; k < kernel_count; ++k) {
        const double factor = u[k * model_p + element];
        if (k != without)
            y = kernel_divides[k] ? y / factor : y * factor;
    }
    return y;
}

void kernel_initialize(double *memory, double t, const double *u, double *last)
{
    kernel_outputs(memory, t, u, last, last);
}

void kernel_outputs(double *memory, double t, const double *u, const double *last, double *y)
{
    (void)memory, (void)t, (void)last;
    cosim_product(kernel_count, model_p, kernel_divides, u, y);
}

const char *kernel_step(double *memory, double t0, double t1, double h, const double *u0,
                        const double *u1, double *y)
{
    (void)t0, (void)h, (void)u0;
    if (cosim_product_refuses(kernel_count, model_p, kernel_divides, u1))
        return "an input that y is divided by is 0; needed another value";
    kernel_outputs(memory, t1, u1, y, y);
    return NULL;
}

double kernel_by_input(double *memory, double *y, double t, const double *u, int32_t row,
                       int32_t input, int in_initialization)
{
    (void)memory, (void)y, (void)t, (void)in_initialization;
    if (input % model_p != row)
        return 0.0;
    const double others = product_of_others(u, row, input / model_p);
    return kernel_divides[input / model_p] ? -others / (u[input] * u[input]) : others;
}
