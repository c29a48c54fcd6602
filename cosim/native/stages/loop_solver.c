#include "loop_solver.h"

#include <float.h>
#include <math.h>
#include <stdbool.h>

#include "copying.h"

#define GOAL 2e-13                  /* residual that is a solution, relative to the unknown */
#define LIMIT 1e-9                  /* one that is, where it does not fall any more ... */
#define ROUNDING (64 * DBL_EPSILON) /* ... and what rounding leaves, by the largest value */
#define DIFFERENCE (-20) /* power of two, relative: rounding leaves 2^-32 in a derivative */
#define SINGULAR 1e-8    /* smallest pivot, relative to its row, or 1 */
#define FALLS 0.25       /* the residual by one correction, where a matrix is kept */
#define CORRECTIONS 50   /* points of one step, at most */
#define HALVINGS 30      /* of one correction */

typedef cosim_loop_solver Solver;

static inline double larger(double a, double b)
{
    return a > b ? a : b;
}

static double *largest_of(const Solver *s)
{
    return s->memory + 1;
}

static double *scales_of(const Solver *s)
{
    return s->memory + 1 + s->n;
}

static double *factors_of(const Solver *s)
{
    return s->memory + 1 + 2 * s->n;
}

static double *order_of(const Solver *s)
{
    return s->memory + 1 + 2 * s->n + s->n * s->n;
}

/* Look at the residual; the worst, in units of GOAL. */
static double measure(Solver *s, const double *w)
{
    double worst = 0.0;
    s->worst = 0;
    s->residual = 0.0;
    for (int64_t i = 0; i < s->n; ++i) {
        const double residual = fabs(w[i] - s->v[i]);
        const double size = larger(fabs(s->v[i]), fabs(w[i]));
        const double tolerance = larger(GOAL * size, DBL_MIN);
        if (!(residual <= DBL_MAX)) {
            s->worst = i;
            s->residual = residual;
            return NAN;
        }
        if (residual > worst * tolerance) {
            worst = residual / tolerance;
            s->worst = i;
            s->residual = residual;
            s->tolerance = tolerance;
        }
    }
    return worst;
}

/* Whether the residual may be all that rounding leaves. */
static bool is_all_rounding(const Solver *s, const double *w, double largest)
{
    for (int64_t i = 0; i < s->n; ++i) {
        const double size = larger(fabs(s->v[i]), fabs(w[i]));
        if (fabs(w[i] - s->v[i]) > LIMIT * size + ROUNDING * largest)
            return false;
    }
    return true;
}

/* The power of two by which an unknown is measured. */
static double scale_of(const Solver *s, int64_t i)
{
    const double *v = s->point, *w = v + s->n;
    const double size = larger(larger(fabs(v[i]), fabs(w[i])), largest_of(s)[i]);
    int exponent = 0;
    frexp(size, &exponent);
    return size > 0.0 ? ldexp(1.0, exponent) : 1.0;
}

/* Shift one unknown, from the point. */
static int32_t shift(Solver *s, int64_t column)
{
    s->column = column;
    cosim_copy_values(s->v, s->point, s->n);
    s->v[column] += copysign(ldexp(scales_of(s)[column], DIFFERENCE), s->v[column]);
    return COSIM_SWEEP;
}

/* Take a column of 1 - dw/dv, scaled. */
static void take_column(Solver *s, const double *w)
{
    const int64_t n = s->n, j = s->column;
    const double *point_w = s->point + n, *scales = scales_of(s);
    const double taken = s->v[j] - s->point[j]; /* the difference to the last bit */
    double *matrix = factors_of(s);
    for (int64_t i = 0; i < n; ++i) {
        const double slope = (w[i] - point_w[i]) / taken;
        matrix[i * n + j] = (i == j ? 1.0 : 0.0) - slope * scales[j] / scales[i];
    }
}

static void swap_rows(double *matrix, int64_t n, int64_t i, int64_t j)
{
    for (int64_t k = 0; k < n; ++k) {
        const double value = matrix[i * n + k];
        matrix[i * n + k] = matrix[j * n + k];
        matrix[j * n + k] = value;
    }
}

/* Factorize the matrix in place, with partial pivoting; whether that is possible. */
static bool factorize(Solver *s)
{
    const int64_t n = s->n;
    double *matrix = factors_of(s), *order = order_of(s);
    for (int64_t k = 0; k < n; ++k) {
        int64_t pivot = k;
        double row_size = 1.0;
        for (int64_t i = k + 1; i < n; ++i)
            if (fabs(matrix[i * n + k]) > fabs(matrix[pivot * n + k]))
                pivot = i;
        order[k] = (double)pivot;
        if (pivot != k)
            swap_rows(matrix, n, k, pivot);
        for (int64_t j = 0; j < n; ++j)
            row_size = larger(row_size, fabs(matrix[k * n + j]));
        if (!(fabs(matrix[k * n + k]) > SINGULAR * row_size))
            return false;
        for (int64_t i = k + 1; i < n; ++i) {
            const double factor = matrix[i * n + k] / matrix[k * n + k];
            matrix[i * n + k] = factor;
            for (int64_t j = k + 1; j < n; ++j)
                matrix[i * n + j] -= factor * matrix[k * n + j];
        }
    }
    return true;
}

/* v <- v + (1 - dw/dv)^-1 (w - v), from the point. */
static int32_t correct(Solver *s)
{
    const int64_t n = s->n;
    const double *v = s->point, *w = v + n;
    const double *scales = scales_of(s), *matrix = factors_of(s), *order = order_of(s);
    double *x = s->v;
    for (int64_t i = 0; i < n; ++i)
        x[i] = (w[i] - v[i]) / scales[i];
    for (int64_t k = 0; k < n; ++k) {
        const int64_t pivot = (int64_t)order[k];
        const double value = x[pivot];
        x[pivot] = x[k];
        x[k] = value;
    }
    for (int64_t k = 0; k < n; ++k)
        for (int64_t i = k + 1; i < n; ++i)
            x[i] -= matrix[i * n + k] * x[k];
    for (int64_t i = n - 1; i >= 0; --i) {
        for (int64_t j = i + 1; j < n; ++j)
            x[i] -= matrix[i * n + j] * x[j];
        x[i] /= matrix[i * n + i];
    }
    for (int64_t i = 0; i < n; ++i)
        x[i] = v[i] + x[i] * scales[i];
    s->column = -1;
    return COSIM_SWEEP;
}

/* Begin to take the matrix by differences. */
static int32_t take_matrix(Solver *s)
{
    double *scales = scales_of(s);
    s->memory[0] = 0.0;
    s->is_new = 1;
    for (int64_t i = 0; i < s->n; ++i)
        scales[i] = scale_of(s, i);
    return shift(s, 0);
}

static int32_t accept(Solver *s)
{
    double *largest = largest_of(s);
    for (int64_t i = 0; i < s->n; ++i)
        largest[i] = larger(largest[i], fabs(s->v[i]));
    return COSIM_SOLVED;
}

/* v <- the last recorded row that is not behind t. */
static void take_recorded(Solver *s, double t)
{
    int64_t low = 0, high = s->n_rows;
    while (high - low > 1) {
        const int64_t middle = low + (high - low) / 2;
        if (s->times[middle] <= t)
            low = middle;
        else
            high = middle;
    }
    cosim_copy_values(s->v, s->rows + low * s->n, s->n);
}

void cosim_loop_solver_begin(cosim_loop_solver *s, double t1)
{
    if (s->n_rows) {
        take_recorded(s, t1);
        return;
    }
    s->sweeps = 0;
    s->column = -1;
    s->is_new = 0;
    s->halvings = 0;
    s->is_last = 0;
    s->before = INFINITY;
}

/* Go half as far from the point as with the last candidate. */
static int32_t halve(Solver *s)
{
    ++s->halvings;
    for (int64_t i = 0; i < s->n; ++i)
        s->v[i] = s->point[i] + 0.5 * (s->v[i] - s->point[i]);
    return COSIM_SWEEP;
}

/* Take the point itself: rounding leaves no matrix, and no more than rounding is left. */
static int32_t go_back(Solver *s)
{
    cosim_copy_values(s->v, s->point, s->n);
    s->column = -1;
    s->is_last = 1;
    return COSIM_SWEEP;
}

/* What follows the sweep with a candidate. */
static int32_t judge(Solver *s, const double *w, double largest)
{
    const double excess = measure(s, w);
    const bool falls = excess <= FALLS * s->before, keeps = s->memory[0] != 0.0 && falls;
    if (isnan(excess))
        return COSIM_INVALID;
    if (excess <= 1.0 || s->is_last)
        return accept(s);
    if (!keeps && isnan(largest))
        return COSIM_ASK;
    const bool is_rounding = !keeps && is_all_rounding(s, w, largest);
    if (s->is_new && !falls && is_rounding)
        return accept(s); /* as near as differences and rounding let it come */
    if (s->is_new && excess > s->before && s->halvings < HALVINGS)
        return halve(s);
    if (++s->sweeps > CORRECTIONS)
        return COSIM_UNSOLVED;
    s->before = excess;
    s->halvings = 0;
    cosim_copy_values(s->point, s->v, s->n);
    cosim_copy_values(s->point + s->n, w, s->n);
    s->point_is_rounding = is_rounding;
    if (keeps) {
        s->is_new = 0;
        return correct(s);
    }
    return take_matrix(s);
}

static int32_t repeat(Solver *s, const double *w)
{
    if (++s->sweeps >= s->iterations)
        return COSIM_SOLVED;
    cosim_copy_values(s->v, w, s->n);
    return COSIM_SWEEP;
}

int32_t cosim_loop_solver_next(cosim_loop_solver *s, const double *w, double largest)
{
    if (s->n_rows)
        return COSIM_SOLVED;
    if (s->iterations)
        return repeat(s, w);
    if (s->column < 0)
        return judge(s, w, largest);
    take_column(s, w);
    if (s->column + 1 < s->n)
        return shift(s, s->column + 1);
    if (!factorize(s))
        return s->point_is_rounding ? go_back(s) : COSIM_UNDECIDED;
    s->memory[0] = 1.0;
    return correct(s);
}
