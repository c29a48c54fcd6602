#include "static.h"

void cosim_limit(int32_t width, double lower, double upper, const double *u, double *y)
{
    for (int32_t k = 0; k < width; ++k) {
        y[k] = u[k];
        if (u[k] < lower)
            y[k] = lower;
        else if (u[k] > upper)
            y[k] = upper;
    }
}

void cosim_product(int32_t count, int32_t width, const int32_t *divides, const double *u,
                   double *y)
{
    for (int32_t k = 0; k < width; ++k) {
        y[k] = 1.0;
        for (int32_t i = 0; i < count; ++i) {
            const double factor = u[i * width + k];
            y[k] = divides[i] ? y[k] / factor : y[k] * factor;
        }
    }
}

int32_t cosim_product_refuses(int32_t count, int32_t width, const int32_t *divides, const double *u)
{
    for (int32_t j = 0; j < count * width; ++j)
        if (divides[j / width] && u[j] == 0.0)
            return 1;
    return 0;
}

void cosim_switch(int32_t width, double threshold, const double *u, double *y)
{
    const double *chosen = u[2 * width] >= threshold ? u : u + width;
    for (int32_t k = 0; k < width; ++k)
        y[k] = chosen[k];
}
