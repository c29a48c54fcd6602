#include "rayleigh.h"
#include "householder.h"
#include "linear.h"
#include "start_grid.h"

#include <math.h>
#include <string.h>

#define ITERATIONS 60
#define STARTS 4              /* best points of the grid that are minimized from */
#define DIFFERENCE 0x1p-17    /* of the numerical derivative, relative to the range of theta */
#define SMALL_STEP 0x1p-20    /* relative to the range of theta */
#define MOST_FIT_ROWS (COSIM_MOST_TERMS + COSIM_MOST_PARAMETERS)
#define MOST_WIDTH (COSIM_MOST_PARAMETERS + 1)
#define MOST_ENTRIES (COSIM_MOST_ROWS * COSIM_MOST_ROWS)

/* The columns of each group among those of all. */
typedef struct {
    int32_t first[COSIM_MOST_ROWS], width[COSIM_MOST_ROWS];
    int32_t all;
} columns;

static columns columns_of(const cosim_rayleigh *s)
{
    columns c = {.all = 0};
    for (int32_t b = 0; b < s->groups; ++b) {
        c.first[b] = c.all;
        c.width[b] = 0;
        for (int32_t i = 0; i < s->components; ++i)
            if (s->group[i] == b)
                c.width[b] += s->size[i];
        c.all += c.width[b];
    }
    return c;
}

/* c' expm(-G D) of every component at every delay: (rows, all), one group beside the other. */
static void make_rows(const cosim_rayleigh *s, const double *theta, columns at, double *K)
{
    const double *c = s->c, *G0 = s->G0, *G1 = s->G1;
    double G[MOST_ENTRIES], M[MOST_ENTRIES], E[MOST_ENTRIES], work[2 * MOST_ENTRIES];
    for (int32_t i = 0; i < s->components; ++i) {
        const int32_t V = s->size[i], column = at.first[s->group[i]];
        cosim_system_matrix(V, s->count[i], G0, G1, theta, G);
        for (int32_t j = 0; j < s->rows; ++j) {
            for (int32_t k = 0; k < V * V; ++k)
                M[k] = -s->delays[j] * G[k];
            cosim_exponential(V, M, E, work);
            for (int32_t k = 0; k < V; ++k) {
                double sum = 0.0;
                for (int32_t a = 0; a < V; ++a)
                    sum += c[a] * E[a * V + k];
                K[j * at.all + column + k] = sum;
            }
        }
        at.first[s->group[i]] += V;
        c += V, G0 += V * V, G1 += s->count[i] * V * V, theta += s->count[i];
    }
}

static double determinant(int32_t n, double *M)
{
    double product = 1.0;
    for (int32_t k = 0; k < n; ++k) {
        int32_t pivot = k;
        for (int32_t i = k + 1; i < n; ++i)
            if (fabs(M[i * n + k]) > fabs(M[pivot * n + k]))
                pivot = i;
        if (M[pivot * n + k] == 0.0)
            return 0.0;
        if (pivot != k) {
            product = -product;
            for (int32_t j = k; j < n; ++j) {
                const double m = M[k * n + j];
                M[k * n + j] = M[pivot * n + j], M[pivot * n + j] = m;
            }
        }
        product *= M[k * n + k];
        for (int32_t i = k + 1; i < n; ++i) {
            const double factor = M[i * n + k] / M[k * n + k];
            for (int32_t j = k; j < n; ++j)
                M[i * n + j] -= factor * M[k * n + j];
        }
    }
    return product;
}

/* The constants (25), scaled to length one. */
static void make_chi(const cosim_rayleigh *s, const double *theta, double *chi)
{
    double K[MOST_ENTRIES], minor[MOST_ENTRIES];
    const columns at = columns_of(s);
    make_rows(s, theta, at, K);
    double squares = 0.0;
    for (int32_t c = 0; c < s->terms; ++c) {
        const int32_t *rows = s->parts + c * (s->rows - 1);
        chi[c] = 1.0;
        for (int32_t b = 0; b < s->groups; ++b) {
            const int32_t V = at.width[b];
            for (int32_t i = 0; i < V; ++i)
                for (int32_t k = 0; k < V; ++k)
                    minor[i * V + k] = K[rows[i] * at.all + at.first[b] + k];
            chi[c] *= determinant(V, minor);
            rows += V;
        }
        squares += chi[c] * chi[c];
    }
    const double length = sqrt(squares);
    for (int32_t c = 0; c < s->terms; ++c)
        chi[c] /= length;
}

/* The residual R chi / sqrt(chi' N chi), whose squares are the quotient. */
static void residual(const cosim_rayleigh *s, const double *R, const double *N, const double *theta,
                     double *rho)
{
    double chi[COSIM_MOST_TERMS];
    make_chi(s, theta, chi);
    double noise = 0.0;
    for (int32_t a = 0; a < s->terms; ++a)
        for (int32_t b = 0; b < s->terms; ++b)
            noise += chi[a] * N[a * s->terms + b] * chi[b];
    const double scale = 1.0 / sqrt(noise);
    for (int32_t a = 0; a < s->terms; ++a) {
        double sum = 0.0;
        for (int32_t b = a; b < s->terms; ++b)
            sum += R[a * s->terms + b] * chi[b];
        rho[a] = scale * sum;
    }
}

static double squares_of(int32_t n, const double *v)
{
    double sum = 0.0;
    for (int32_t i = 0; i < n; ++i)
        sum += v[i] * v[i];
    return sum;
}

static double within(double value, double lower, double upper)
{
    if (value < lower)
        return lower;
    return value > upper ? upper : value;
}

/* The derivatives of the residual by theta, by central differences, and the residual beside
 * them. */
static void make_regression(const cosim_rayleigh *s, const double *R, const double *N,
                            const double *theta, const double *rho, double *rows)
{
    const int32_t P = s->parameters, n = s->terms, width = P + 1;
    double point[COSIM_MOST_PARAMETERS], above[COSIM_MOST_TERMS], below[COSIM_MOST_TERMS];
    memcpy(point, theta, (size_t)P * sizeof *theta);
    for (int32_t j = 0; j < P; ++j) {
        const double difference = DIFFERENCE * (s->upper[j] - s->lower[j]);
        point[j] = theta[j] + difference;
        residual(s, R, N, point, above);
        point[j] = theta[j] - difference;
        residual(s, R, N, point, below);
        point[j] = theta[j];
        for (int32_t i = 0; i < n; ++i)
            rows[i * width + j] =
                difference > 0.0 ? (above[i] - below[i]) / (2.0 * difference) : 0.0;
    }
    for (int32_t i = 0; i < n; ++i)
        rows[i * width + P] = -rho[i];
}

/* The rows of Levenberg and Marquardt: one a parameter, as long as its column. */
static void add_damping(int32_t n, int32_t P, double damping, double *rows)
{
    const int32_t width = P + 1;
    double *damped = rows + n * width;
    memset(damped, 0, (size_t)(P * width) * sizeof *damped);
    for (int32_t j = 0; j < P; ++j) {
        double sum = 0.0;
        for (int32_t i = 0; i < n; ++i)
            sum += rows[i * width + j] * rows[i * width + j];
        damped[j * width + j] = sqrt(damping) * (sum > 0.0 ? sqrt(sum) : 1.0);
    }
}

/* Where the step leads, within the box and at most a quarter of it away; returns how far that is,
 * relative to the box. */
static double move(const cosim_rayleigh *s, const double *theta, const double *step,
                   double *reached)
{
    double largest = 0.0;
    for (int32_t j = 0; j < s->parameters; ++j) {
        const double range = s->upper[j] - s->lower[j];
        const double limited = within(step[j], -0.25 * range, 0.25 * range);
        reached[j] = within(theta[j] + limited, s->lower[j], s->upper[j]);
        const double moved = range > 0.0 ? fabs(reached[j] - theta[j]) / range : 0.0;
        largest = moved > largest ? moved : largest;
    }
    return largest;
}

int32_t cosim_rayleigh_minimize(const cosim_rayleigh *s, const double *R, const double *N,
                                double *theta, double *value)
{
    const int32_t P = s->parameters, n = s->terms, width = P + 1;
    double rho[COSIM_MOST_TERMS], trial_rho[COSIM_MOST_TERMS];
    double trial[COSIM_MOST_PARAMETERS], step[COSIM_MOST_PARAMETERS];
    double rows[MOST_FIT_ROWS * MOST_WIDTH], T[MOST_WIDTH * MOST_WIDTH], work[MOST_WIDTH];
    double damping = 1e-3;
    residual(s, R, N, theta, rho);
    *value = squares_of(n, rho);
    if (!(*value >= 0.0 && *value < INFINITY))
        return COSIM_NO_VALUE;
    for (int32_t iteration = 0; iteration < ITERATIONS; ++iteration) {
        make_regression(s, R, N, theta, rho, rows);
        add_damping(n, P, damping, rows);
        memset(T, 0, sizeof T);
        cosim_householder(width, T, n + P, rows, work);
        cosim_solve_upper(P, width, T, T + P, width, step);
        const double moved = move(s, theta, step, trial);
        residual(s, R, N, trial, trial_rho);
        const double reached = squares_of(n, trial_rho);
        if (reached < *value) {
            memcpy(theta, trial, (size_t)P * sizeof *theta);
            memcpy(rho, trial_rho, (size_t)n * sizeof *rho);
            *value = reached;
            damping *= 0.1;
        } else {
            damping *= 10.0;
        }
        if (moved <= SMALL_STEP || damping > 1e12)
            return COSIM_OK;
    }
    return COSIM_NOT_CONVERGED;
}

/* The middle of a cell of the grid. */
static void write_point(const cosim_rayleigh *s, int64_t k, double *theta)
{
    for (int32_t j = 0; j < s->parameters; ++j) {
        const double fraction = ((double)(k % s->points) + 0.5) / s->points;
        theta[j] = s->lower[j] + fraction * (s->upper[j] - s->lower[j]);
        k /= s->points;
    }
}

int32_t cosim_rayleigh_search(const cosim_rayleigh *s, const double *R, const double *N,
                              double *theta, double *value)
{
    const int32_t P = s->parameters;
    double point[COSIM_MOST_PARAMETERS], rho[COSIM_MOST_TERMS], values[STARTS];
    int64_t best[STARTS], count = 1;
    int32_t found = 0;
    for (int32_t j = 0; j < P; ++j)
        count *= s->points;
    for (int64_t k = 0; k < count; ++k) {
        write_point(s, k, point);
        residual(s, R, N, point, rho);
        found = cosim_keep_smallest(squares_of(s->terms, rho), k, found, STARTS, values, best);
    }
    *value = INFINITY;
    int32_t status = COSIM_NO_VALUE;
    for (int32_t i = 0; i < found; ++i) {
        double reached;
        write_point(s, best[i], point);
        const int32_t result = cosim_rayleigh_minimize(s, R, N, point, &reached);
        if (result != COSIM_NO_VALUE && reached < *value) {
            *value = reached;
            status = result;
            memcpy(theta, point, (size_t)P * sizeof *theta);
        }
    }
    return status;
}
