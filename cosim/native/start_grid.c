#include "cosim.h"

#include <math.h>
#include <string.h>

/* The sum of squares at a point of the grid, and the points themselves, one digit a component. */
typedef struct {
    int32_t columns;             /* of the points, and the residual */
    int32_t width;               /* columns of one point, and the residual */
    double *R;                   /* (columns, columns): x(0) and the offset are eliminated */
    double *rows;                /* (columns of the model, the same), of rotations */
    double *chosen, *T, *work;   /* (columns, width), (width, width), of rotations */
    int64_t size;
} parts;

int64_t cosim_start_grid_points(const cosim_start_grid *s)
{
    int64_t points = 1;
    for (int32_t i = 0; i < s->components; ++i)
        points *= s->points[i];
    return points;
}

static parts parts_of(const cosim_start_grid *s, double *memory)
{
    const int64_t all = cosim_output_error_columns(s->model);
    parts p = {.columns = 1, .width = 1};
    for (int32_t i = 0; i < s->components; ++i) {
        p.columns += s->points[i] * s->size[i];
        p.width += s->size[i];
    }
    int64_t next = 0;
    p.R = cosim_place(memory, &next, all * all); /* at first with x(0) and the offset before them */
    p.rows = cosim_place(memory, &next, all * all);
    p.chosen = cosim_place(memory, &next, (int64_t)p.columns * p.width);
    p.T = cosim_place(memory, &next, p.width * p.width);
    p.work = cosim_place(memory, &next, all);
    p.size = next;
    return p;
}

int64_t cosim_start_grid_memory(const cosim_start_grid *s) { return parts_of(s, NULL).size; }

/* Rotate x(0) and the offset to the front; what stands below them is the regression without them. */
static void eliminate(const cosim_start_grid *s, const parts *p, const double *R)
{
    const int32_t all = cosim_output_error_columns(s->model);
    const int32_t basis = p->columns - 1, others = all - p->columns;
    for (int32_t i = 0; i < all; ++i) {
        double *row = p->rows + (int64_t)i * all;
        memcpy(row, R + (int64_t)i * all + basis, (size_t)others * sizeof *row);
        memcpy(row + others, R + (int64_t)i * all, (size_t)basis * sizeof *row);
        row[all - 1] = R[(int64_t)i * all + all - 1];
    }
    memset(p->R, 0, (size_t)all * (size_t)all * sizeof *p->R);
    cosim_householder(all, p->R, all, p->rows, p->work);
    for (int32_t i = 0; i < p->columns; ++i)
        memmove(p->R + (int64_t)i * p->columns,
                p->R + (int64_t)(i + others) * all + others, (size_t)p->columns * sizeof *p->R);
}

/* Take the next digit of a point: which point of the next component it is. */
static int32_t next_digit(int64_t *point, int32_t points)
{
    const int32_t digit = (int32_t)(*point % points);
    *point /= points;
    return digit;
}

static void copy_columns(const parts *p, int32_t count, const double *from, double *to)
{
    for (int64_t r = 0; r < p->columns; ++r)
        memcpy(to + r * p->width, from + r * p->columns, (size_t)count * sizeof *to);
}

static double squares_at(const cosim_start_grid *s, const parts *p, int64_t point)
{
    const double *from = p->R;
    double *to = p->chosen;
    for (int32_t i = 0; i < s->components; ++i) {
        const int32_t V = s->size[i];
        copy_columns(p, V, from + next_digit(&point, s->points[i]) * V, to);
        from += s->points[i] * V, to += V;
    }
    copy_columns(p, 1, from, to);
    memset(p->T, 0, (size_t)(p->width * p->width) * sizeof *p->T);
    cosim_householder(p->width, p->T, p->columns, p->chosen, p->work);
    const double residual = p->T[p->width * p->width - 1];
    return residual * residual;
}

/* Whether no neighbor along a component is better. */
static int is_minimum(const cosim_start_grid *s, const double *squares, int64_t point)
{
    const double here = squares[point];
    int64_t stride = 1, rest = point;
    for (int32_t i = 0; i < s->components; ++i) {
        const int32_t digit = next_digit(&rest, s->points[i]);
        if (digit > 0 && squares[point - stride] < here)
            return 0;
        if (digit < s->points[i] - 1 && squares[point + stride] < here)
            return 0;
        stride *= s->points[i];
    }
    return 1;
}

static void write_theta(const cosim_start_grid *s, int64_t point, double *theta)
{
    const double *from = s->theta;
    for (int32_t i = 0; i < s->components; ++i) {
        const int32_t count = s->count[i], digit = next_digit(&point, s->points[i]);
        memcpy(theta, from + digit * count, (size_t)count * sizeof *theta);
        from += s->points[i] * count, theta += count;
    }
}

int32_t cosim_keep_smallest(double value, int64_t point, int32_t found, int32_t most, double *values,
                            int64_t *points)
{
    int32_t place = found;
    while (place > 0 && value < values[place - 1])
        --place;
    if (place == most || !(value < INFINITY))
        return found;
    const int32_t count = found < most ? found + 1 : most;
    for (int32_t i = count - 1; i > place; --i) {
        values[i] = values[i - 1];
        points[i] = points[i - 1];
    }
    values[place] = value;
    points[place] = point;
    return count;
}

void cosim_start_grid_squares(const cosim_start_grid *s, const double *R, double *memory,
                              double *squares)
{
    const parts p = parts_of(s, memory);
    const int64_t points = cosim_start_grid_points(s);
    eliminate(s, &p, R);
    for (int64_t k = 0; k < points; ++k)
        squares[k] = squares_at(s, &p, k);
}

int32_t cosim_start_grid_best(const cosim_start_grid *s, const double *squares, int32_t most,
                              double *theta)
{
    const int64_t points = cosim_start_grid_points(s);
    double values[COSIM_MOST_STARTS];
    int64_t best[COSIM_MOST_STARTS];
    int32_t parameters = 0, found = 0;
    for (int32_t i = 0; i < s->components; ++i)
        parameters += s->count[i];
    for (int64_t k = 0; k < points; ++k)
        if (is_minimum(s, squares, k))
            found = cosim_keep_smallest(squares[k], k, found, most, values, best);
    for (int32_t i = 0; i < found; ++i)
        write_theta(s, best[i], theta + i * parameters);
    return found;
}
