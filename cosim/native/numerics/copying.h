/* Copies of values that are often few. */
#ifndef COSIM_COPYING_H
#define COSIM_COPYING_H

#include <stdint.h>
#include <string.h>

#define COSIM_FEW 8 /* below so many a call costs more than it does */

/* Few values go one by one: what was written a moment ago is there at once for a read of its own
 * size, but not for one of several values. */
static inline void cosim_copy_values(double *to, const double *from, int64_t count)
{
    volatile double *one_by_one = to; /* volatile: else the loop becomes a call */
    if (count >= COSIM_FEW) {
        memcpy(to, from, (size_t)count * sizeof *to);
        return;
    }
    for (int64_t i = 0; i < count; ++i)
        one_by_one[i] = from[i];
}

#endif
