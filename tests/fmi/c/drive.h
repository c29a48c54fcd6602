/* What both drivers need: exact heap arrays, so that the address sanitizer finds one element too
 * many. */
#ifndef DRIVE_H
#define DRIVE_H

#include "model.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define CHECK(condition)                                           \
    do {                                                           \
        if (!(condition)) {                                        \
            printf("%s:%d: %s\n", __FILE__, __LINE__, #condition); \
            exit(1);                                               \
        }                                                          \
    } while (0)

typedef struct {
    uint32_t *of;
    size_t count, elements;
} references;

/* The variables with references from `first` on, `elements` long together. */
static references take(int32_t first, int32_t elements)
{
    references r = {malloc(sizeof(uint32_t) * (size_t)(elements + 1)), 0, (size_t)elements};
    CHECK(r.of);
    for (int32_t k = first; k < first + elements; k += model_size[k] ? model_size[k] : 1)
        if (model_size[k])
            r.of[r.count++] = (uint32_t)k;
    return r;
}

static double *some(size_t count, double scale)
{
    double *values = malloc(sizeof(double) * (count ? count : 1));
    CHECK(values);
    for (size_t k = 0; k < count; ++k)
        values[k] = scale * sin(1.0 + (double)k);
    return values;
}

static double step_size(void) { return model_step > 0.0 ? model_step : 0.1; }

#endif
