#include "kalman.h"
#include "householder.h"
#include "linear.h"

#include <math.h>
#include <string.h>

void cosim_kalman_predict(int32_t n, const double *Phi, int32_t rows, const double *noise,
                          double *R, double *work)
{
    double *block = work, *scratch = block + (n + rows) * n;
    for (int32_t a = 0; a < n; ++a)
        cosim_multiply(n, n, Phi, R + a * n, block + a * n);
    memcpy(block + n * n, noise, (size_t)(rows * n) * sizeof *noise);
    memset(R, 0, (size_t)(n * n) * sizeof *R);
    cosim_householder(n, R, n + rows, block, scratch);
}

void cosim_kalman_correct(int32_t n, const double *row, double variance, double innovation,
                          double *x, double *R, double *work)
{
    double *phi = work, *gain = work + n;
    double total = variance;
    cosim_multiply(n, n, R, row, phi);
    for (int32_t a = 0; a < n; ++a)
        total += phi[a] * phi[a];
    const double factor = 1.0 / (total + sqrt(variance * total));
    for (int32_t b = 0; b < n; ++b) {
        double sum = 0.0;
        for (int32_t a = 0; a < n; ++a)
            sum += R[a * n + b] * phi[a];
        gain[b] = sum;
        x[b] += sum * (innovation / total);
    }
    for (int32_t a = 0; a < n; ++a)
        for (int32_t b = 0; b < n; ++b)
            R[a * n + b] -= factor * phi[a] * gain[b];
}

double cosim_kalman_variance(int32_t n, const double *R, int32_t state)
{
    double sum = 0.0;
    for (int32_t a = 0; a < n; ++a)
        sum += R[a * n + state] * R[a * n + state];
    return sum;
}
