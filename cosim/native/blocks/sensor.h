#ifndef COSIM_SENSOR_H
#define COSIM_SENSOR_H

#include "cosim.h"

/* A measuring chain; sensor.py describes the effects and their order. Random numbers are drawn
 * ahead, a row a sample: COSIM_NO_VALUE where they are used up. */
typedef struct {
    int32_t size, depth;    /* elements; inputs before the time reached that are kept */
    int32_t period;         /* communication steps between two samples */
    int32_t drops;          /* there is the output `valid` */
    int32_t samples, stamps; /* the samples are outputs; their times are the sampling instants */
    int32_t quantizes;
    double h, begin; /* communication step, start of the run [s] */
    const uint8_t *held; /* (size) zero-order hold of this element of the input */
    const double *bias, *lower, *upper;                /* (size) */
    const double *origin, *resolution, *first, *last;  /* (size) levels origin + i resolution */
    int64_t drawn;
    /* (drawn, size): sampling instant minus t in communication steps; whether the sample is lost */
    const double *position, *noise, *lost;
    /* communication steps since the last sample, the period where one is due now; number of the
     * next row; the oldest of the inputs; y and `valid` before the time reached; inputs (depth,
     * size), a ring */
    double *memory;
} cosim_sensor;
int32_t cosim_sensor_step(void *self, double t0, double t1, double h, const double *u0,
                          const double *u1, double *y);
int32_t cosim_sensor_outputs(void *self, double t, const double *u, double *y);

#endif
