#include "noise.h"
#include "elementary.h"

#include <math.h>

/* 2 pi rounded; u of (0, 1] and v of [0, 1) have the 53 leading bits of their words */
#define TURN_ANGLE 0x1.921fb54442d18p2

void cosim_normal(int64_t count, const uint64_t *words, double *y)
{
    for (int64_t i = 0; i < count; ++i) {
        const double u = (double)((words[2 * i] >> 11) + 1) * 0x1p-53;
        const double v = (double)(words[2 * i + 1] >> 11) * 0x1p-53;
        y[i] = sqrt(-2.0 * cosim_ln(u)) * cosim_cos(TURN_ANGLE * v);
    }
}
