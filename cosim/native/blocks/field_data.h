#ifndef COSIM_FIELD_DATA_H
#define COSIM_FIELD_DATA_H

#include "cosim.h"

/* Samples at instants of their own: at a communication point the values on the straight lines
 * between those of each element, or the last of them, then the samples since the point before,
 * `most` places for each element and for their instants. COSIM_OUTSIDE where an element is not
 * measured, or the places do not suffice. */
typedef struct {
    int64_t count; /* of the samples of an element */
    const double *t, *values;
    int64_t near;
} cosim_line;
typedef struct {
    int32_t elements, most;
    int32_t hold; /* a zero-order hold between samples, no straight lines */
    cosim_line *lines; /* (elements) */
    int64_t count;     /* of all instants */
    /* (elements + 1, count): samples, NaN where there is none; in the last row their instants */
    const double *columns;
    double end;     /* the last instant at which all is measured */
    double *before; /* the communication point before the last */
    int64_t near;
} cosim_field_data;
int32_t cosim_field_data_step(void *self, double t0, double t1, double h, const double *u0,
                              const double *u1, double *y);

#endif
