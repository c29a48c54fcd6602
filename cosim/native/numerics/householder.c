#include "householder.h"

#include <math.h>

/* A sum of squares below it is none: what rounding leaves of rows that say what others do shrinks
 * from column to column, and its reciprocal must not overflow. */
#define SMALLEST 0x1p-960

#define TOGETHER 4 /* rows whose columns are passed through once, each after the one before it */

/* sums[c] += v_i row_i[c] for rows i in their order, v_i = row_i[j], c > j. */
static void add_products(int32_t n, int32_t j, int32_t rows, const double *restrict block,
                         double *restrict sums)
{
    int32_t i = 0;
    for (; i + TOGETHER <= rows; i += TOGETHER) {
        const double *a = block + i * n, *b = a + n, *c = b + n, *d = c + n;
        const double va = a[j], vb = b[j], vc = c[j], vd = d[j];
        for (int32_t k = j + 1; k < n; ++k)
            sums[k] = (((sums[k] + va * a[k]) + vb * b[k]) + vc * c[k]) + vd * d[k];
    }
    for (; i < rows; ++i) {
        const double *a = block + i * n;
        for (int32_t k = j + 1; k < n; ++k)
            sums[k] += a[j] * a[k];
    }
}

/* One reflection a column: it maps (R_jj, block_0j, block_1j, ...) to (-+norm, 0, 0, ...). */
void cosim_householder(int32_t n, double *R, int32_t rows, double *block, double *work)
{
    for (int32_t j = 0; j < n; ++j) {
        double *r = R + (int64_t)j * n;
        double squares = 0.0;
        for (int32_t i = 0; i < rows; ++i)
            squares += block[i * n + j] * block[i * n + j];
        if (squares < SMALLEST)
            continue;
        const double norm = sqrt(r[j] * r[j] + squares);
        const double reflected = r[j] > 0.0 ? -norm : norm;
        const double v = r[j] - reflected;
        const double factor = 1.0 / (norm * (norm + fabs(r[j])));
        for (int32_t c = j + 1; c < n; ++c)
            work[c] = v * r[c];
        add_products(n, j, rows, block, work);
        for (int32_t c = j + 1; c < n; ++c) {
            work[c] *= factor;
            r[c] -= v * work[c];
        }
        for (int32_t i = 0; i < rows; ++i) {
            double *restrict row = block + i * n;
            const double *restrict projection = work;
            const double vi = row[j];
            for (int32_t c = j + 1; c < n; ++c)
                row[c] -= vi * projection[c];
        }
        r[j] = reflected;
    }
}

void cosim_solve_upper(int32_t n, int32_t stride, const double *R, const double *b,
                       int32_t b_stride, double *x)
{
    for (int32_t i = n - 1; i >= 0; --i) {
        double sum = b[i * b_stride];
        for (int32_t j = i + 1; j < n; ++j)
            sum -= R[i * stride + j] * x[j];
        x[i] = sum / R[i * stride + i];
    }
}

void cosim_covariance(int32_t n, int32_t stride, const double *R, double *covariance, double *work)
{
    double *column = work, *inverse = work + n;
    for (int32_t j = 0; j < n; ++j) {
        for (int32_t i = 0; i < n; ++i)
            column[i] = i == j ? 1.0 : 0.0;
        cosim_solve_upper(n, stride, R, column, 1, inverse + j * n);
    }
    for (int32_t a = 0; a < n; ++a)
        for (int32_t b = 0; b < n; ++b) {
            double sum = 0.0;
            for (int32_t j = 0; j < n; ++j)
                sum += inverse[j * n + a] * inverse[j * n + b];
            covariance[a * n + b] = sum;
        }
}
