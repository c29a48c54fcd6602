/* The floor of lags in a loop: cosim's own kernel of a linear component, called in a plain loop.
 *
 *     lags COUNT GAIN OFFSET STEP_NS STEPS SAMPLES
 *
 * y' = u - y from y = 0; each lag is driven by the one before it, and the first by
 * OFFSET + GAIN y of the last, which it keeps from the start of the step (Gauss-Seidel). All inputs
 * and outputs of all steps are kept in memory that the loop touches first. */
#include "linear.h"
#include "program.h"

#define COLUMNS 2 /* of a lag: u, y */
#define U(i) (COLUMNS * (i))
#define Y(i) (COLUMNS * (i) + 1)

typedef struct {
    double Ad, B0, B1, memory[2];
    cosim_linear linear;
} Lag;

static const double A = -1.0, B = 1.0, C = 1.0, D = 0.0;

static Lag *prepare(int n, double h)
{
    double work[36];
    Lag *lags = calloc((size_t)n, sizeof(Lag));
    for (int i = 0; i < n; ++i) {
        Lag *lag = &lags[i];
        const uint8_t held = i == 0;
        cosim_first_order_hold(1, 1, &A, &B, h, &held, &lag->Ad, &lag->B0, &lag->B1, work);
        lag->linear =
            (cosim_linear){1, 1, 1, &lag->Ad, &lag->B0, &lag->B1, &C, &D, lag->memory};
    }
    return lags;
}

int main(int count, char **arguments)
{
    if (count != 7)
        fail("needed COUNT GAIN OFFSET STEP_NS STEPS SAMPLES");
    const int n = atoi(arguments[1]);
    const double gain = atof(arguments[2]), offset = atof(arguments[3]);
    const int64_t step_ns = atoll(arguments[4]), steps = atoll(arguments[5]);
    const size_t width = (size_t)(COLUMNS * n);
    const double h = (double)step_ns / 1e9;
    Lag *lags = prepare(n, h);

    const double began = now();
    double *rows = malloc(((size_t)steps + 1) * width * sizeof(double));
    memset(rows, 0, width * sizeof(double));
    rows[U(0)] = offset + gain * rows[Y(n - 1)];
    for (int64_t k = 0; k < steps; ++k) {
        double *before = rows + (size_t)k * width, *row = before + width;
        const double t0 = (double)(k * step_ns) / 1e9, t1 = (double)((k + 1) * step_ns) / 1e9;
        row[U(0)] = before[U(0)];
        for (int i = 0; i < n; ++i) {
            if (i > 0)
                row[U(i)] = row[Y(i - 1)];
            cosim_linear_step(&lags[i].linear, t0, t1, h, before + U(i), row + U(i), row + Y(i));
        }
        row[U(0)] = offset + gain * row[Y(n - 1)];
    }
    report(now() - began, arguments[6], rows, width, 1, COLUMNS);
    return 0;
}
