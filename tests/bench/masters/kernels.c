/* The floor of a scenario: the kernels of its components in a plain loop, in the order in which
 * cosim calls them. A library for drivers/drive_kernels.py, which prepares them. */
#include "cosim.h"

#include <stddef.h>
#include <string.h>

typedef int32_t (*outputs_function)(void *self, double t, const double *u, double *y);

/* A column of a row and where its value comes from: a column of the same row, or, less the width of
 * a row, one of the row before. */
typedef struct {
    int64_t to, from;
} wire;

typedef struct {
    cosim_step advance;
    outputs_function refresh; /* NULL: it advances */
    void *self;
    int64_t u, y, first, count; /* columns; its wires */
} kernel;

/* Fill rows 1 to `steps`; return how many were filled before a kernel declined. */
int64_t kernels_run(int64_t steps, const double *t, double h, double *rows, int64_t width,
                    const kernel *kernels, int64_t n_kernels, const wire *wires,
                    const wire *last_wires, int64_t n_last_wires)
{
    for (int64_t k = 0; k < steps; ++k) {
        double *before = rows + k * width, *row = before + width;
        for (int64_t i = 0; i < n_kernels; ++i) {
            const kernel *c = &kernels[i];
            for (const wire *w = wires + c->first; w < wires + c->first + c->count; ++w)
                row[w->to] = row[w->from];
            const int32_t status =
                c->refresh ? c->refresh(c->self, t[k + 1], row + c->u, row + c->y)
                           : c->advance(c->self, t[k], t[k + 1], h, before + c->u, row + c->u,
                                        row + c->y);
            if (status != COSIM_OK)
                return k;
        }
        for (const wire *w = last_wires; w < last_wires + n_last_wires; ++w)
            row[w->to] = row[w->from];
    }
    return steps;
}

/* The same, of whose rows only the last one is kept, as row 0 of `rows` (block + 1, width), and sums
 * over all: how many values there are, their sum, and the sum of their squares. */
int64_t kernels_sum(int64_t steps, int64_t block, const double *t, double h, double *rows,
                    int64_t width, const kernel *kernels, int64_t n_kernels, const wire *wires,
                    const wire *last_wires, int64_t n_last_wires, double *counts, double *sums,
                    double *squares)
{
    for (int64_t k = 0; k < steps; k += block) {
        const int64_t count = steps - k < block ? steps - k : block;
        const int64_t done = kernels_run(count, t + k, h, rows, width, kernels, n_kernels, wires,
                                         last_wires, n_last_wires);
        if (done < count)
            return k + done;
        for (int64_t i = 1; i <= count; ++i)
            for (int64_t j = 0; j < width; ++j) {
                const double value = rows[i * width + j];
                const int has_value = value == value;
                counts[j] += has_value;
                sums[j] += has_value ? value : 0.0;
                squares[j] += has_value ? value * value : 0.0;
            }
        memcpy(rows, rows + count * width, (size_t)width * sizeof *rows);
    }
    return steps;
}
