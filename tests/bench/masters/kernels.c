/* The floor of a scenario: the kernels of its components in a plain loop, in the order in which
 * cosim calls them. A library for drivers/drive_kernels.py, which prepares them. */
#include "cosim.h"

#include <stddef.h>

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
