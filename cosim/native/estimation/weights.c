#include "weights.h"

#include <math.h>
#include <string.h>

#define LARGEST_CORRELATION (1.0 - 0x1p-20)

int32_t cosim_factorize(int32_t n, const double *C, double *L)
{
    memset(L, 0, (size_t)(n * n) * sizeof *L);
    for (int32_t i = 0; i < n; ++i)
        for (int32_t j = 0; j <= i; ++j) {
            double sum = C[i * n + j];
            for (int32_t k = 0; k < j; ++k)
                sum -= L[i * n + k] * L[j * n + k];
            if (i == j && !(sum > 0.0))
                return 0;
            L[i * n + j] = i == j ? sqrt(sum) : sum / L[j * n + j];
        }
    return 1;
}

/* Of outputs that are measured at different times the products may belong to no covariance. */
static void leave_out_correlations(int32_t n, double *covariance)
{
    for (int32_t i = 0; i < n; ++i)
        for (int32_t j = 0; j < n; ++j)
            if (j != i)
                covariance[i * n + j] = 0.0;
}

void cosim_noise_weights(int32_t n, double *covariance, const double *least, double *deviations,
                         double *L, double *W)
{
    for (int32_t i = 0; i < n; ++i) {
        double *variance = covariance + i * n + i;
        for (int32_t j = 0; j < n; ++j)
            if (j != i)
                covariance[i * n + j] *= LARGEST_CORRELATION;
        if (*variance < least[i] * least[i])
            *variance = least[i] * least[i];
        if (!(*variance > 0.0))
            *variance = 1.0;
        deviations[i] = sqrt(*variance);
    }
    if (!cosim_factorize(n, covariance, L)) {
        leave_out_correlations(n, covariance);
        cosim_factorize(n, covariance, L);
    }
    memset(W, 0, (size_t)(n * n) * sizeof *W);
    for (int32_t j = 0; j < n; ++j)
        for (int32_t i = j; i < n; ++i) {
            double sum = i == j ? 1.0 : 0.0;
            for (int32_t k = j; k < i; ++k)
                sum -= L[i * n + k] * W[k * n + j];
            W[i * n + j] = sum / L[i * n + i];
        }
}
