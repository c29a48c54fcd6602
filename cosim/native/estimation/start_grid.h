#ifndef COSIM_START_GRID_H
#define COSIM_START_GRID_H

#include "output_error.h"

#define COSIM_MOST_STARTS 16

/* Starts of theta from y alone. The model has, for every component, one component for each point of
 * a grid of its theta, without parameters: one pass over the samples makes the R of all of them,
 * and a combination of points is then a choice of columns. Where these are too many to try each,
 * one component after the other is added at its best point, then points are chosen anew two by
 * two. */
typedef struct {
    int32_t components;
    int32_t beside; /* whether the last point of each component is that of a fit, beside the grid */
    const cosim_output_error *model;
    const int32_t *size, *count; /* (components) V_i of one point, and parameters */
    const int32_t *points;       /* (components) */
    const int32_t *alike;        /* (components) last interchangeable one before it; -1: none */
    const uint8_t *even;         /* (parameters) whether the negative makes the same signals */
    const double *theta;         /* (points_i, count_i) of one component behind the other */
} cosim_start_grid;
/* The number of doubles of `memory` for so many records. */
int64_t cosim_start_grid_memory(const cosim_start_grid *self, int32_t records);
/* Insert a value among the smallest ones of a grid, which stand in ascending order with their
 * points; infinity and NaN are none. Returns how many there are then, at most `most`. */
int32_t cosim_keep_smallest(double value, int64_t point, int32_t found, int32_t most,
                            double *values, int64_t *points);
/* The number of combinations of points; 0: too many to try each. */
int64_t cosim_start_grid_points(const cosim_start_grid *self);
/* The least squares of every combination, where each can be tried, summed over records; R: those of
 * the model, (records, columns, columns). */
void cosim_start_grid_squares(const cosim_start_grid *self, int32_t records, const double *R,
                              double *memory, double *squares);
/* The combinations that no neighbor betters, the best first, at most `most` of them: theta of shape
 * (most, parameters). Returns how many there are. */
int32_t cosim_start_grid_search(const cosim_start_grid *self, int32_t records, const double *R,
                                double *memory, int32_t most, double *theta);

/* Starts beside a fit whose theta are the last points: points of one component or of two that no
 * neighbor betters, the others as they are there. They lead to optima that a part of the signal
 * tells apart, which the distance of points of the other parts would hide. */
int32_t cosim_start_grid_beside(const cosim_start_grid *self, const double *R, double *memory,
                                int32_t most, double *theta);

/* Of all theta of the same model the one that is reported: even parameters positive,
 * interchangeable components by their last parameter, the largest first. */
void cosim_start_grid_order(const cosim_start_grid *self, double *theta);

#endif
