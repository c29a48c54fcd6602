/* Reductions over rows that come in blocks of some sizes, each a heap block of exactly its size, so
 * that one element too many is found. Prints count, ends, extremes and sums of each reduction, and
 * the place where the values kept settle. Compiled with sanitizers by test_sanitizers.py. */
#include "operations.h"
#include "reductions.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { COLUMN = OPERATIONS, WHERE, HOLD };
enum { ROWS = 1000, WIDTH = 3, REGISTERS = 8, ALL = 255, STEP_NS = 1000000 };

static double *copy(const double *values, size_t n)
{
    double *block = malloc(n * sizeof *block);
    memcpy(block, values, n * sizeof *block);
    return block;
}

int main(void)
{
    static double rows[ROWS * WIDTH], t[ROWS];
    for (int k = 0; k < ROWS; ++k) {
        t[k] = (double)((int64_t)k * STEP_NS) / 1e9;
        rows[k * WIDTH + 1] = (double)(k * k % 97) - 48.0;
        rows[k * WIDTH + 2] = k % 7 ? 1.0 / (1.0 + k) : cosim_no_value();
    }
    /* registers: y, gap, t, y + gap, 0, 0 < y, held for 2 ms, gap where held */
    const cosim_instruction instructions[] = {
        {COLUMN, 0, 1, 0}, {COLUMN, 1, 2, 0}, {T, 2, 0, 0},    {ADD, 3, 0, 1},
        {LESS, 5, 4, 0},   {HOLD, 6, 5, 0},   {WHERE, 7, 1, 6},
    };
    cosim_hold holds[] = {{.duration_ns = 2 * STEP_NS}};
    double *registers = calloc(REGISTERS * COSIM_CHUNK, sizeof *registers);
    double *kept[3];
    cosim_reduction reductions[3] = {{.values = 0}, {.values = 3}, {.values = 7}};
    for (int i = 0; i < 3; ++i) {
        reductions[i].parts = ALL;
        reductions[i].kept = kept[i] = malloc(ROWS * sizeof(double));
    }
    cosim_reductions s = {instructions, holds, reductions, registers, 7, 1, 3, 0};
    for (int run = 0; run < 2; ++run) {
        cosim_begin_reductions(&s);
        for (int first = 0, size = 1; first < ROWS; first += size, size = size * 3 % 389 + run) {
            if (size > ROWS - first)
                size = ROWS - first;
            double *block = copy(rows + first * WIDTH, (size_t)size * WIDTH);
            double *times = copy(t + first, (size_t)size);
            cosim_reduce_rows(&s, size, NULL, (int64_t)first * STEP_NS, STEP_NS, times, block,
                              WIDTH);
            free(block);
            free(times);
        }
        for (int i = 0; i < 3; ++i) {
            const cosim_reduction *r = &reductions[i];
            printf("%lld %a %a %a %a", (long long)r->count, r->first, r->last, r->low, r->high);
            for (int j = 0; j < COSIM_SUMS; ++j)
                printf(" %a", r->sums[j]);
            printf(" %lld\n", (long long)cosim_settled(ROWS, kept[i], r->last, 1e-3));
        }
    }
    for (int i = 0; i < 3; ++i)
        free(kept[i]);
    free(registers);
    return 0;
}
