#include "start_grid.h"
#include "householder.h"
#include "linear.h"

#include <math.h>
#include <string.h>

#define EXHAUSTIVE 4096 /* combinations of points up to which each is tried */
#define MOST_PAIRS 16384 /* points of two components up to which both are chosen together */
#define SWEEPS 12
#define DEPENDENT 0x1p-18 /* length of a column beside others over its own: below it, it is none */

/* What a search works on. */
typedef struct {
    int32_t columns;           /* of the points, and the residual */
    int32_t width;             /* columns of one point of each component, and the residual */
    double *R;                 /* (records, columns, columns): x(0) and the offset are eliminated */
    double *rows;              /* (columns of the model, the same), of rotations */
    double *chosen, *T, *work; /* (columns, width), (width, width), of rotations */
    double *squares;           /* of all combinations, where these are few */
    double *free;              /* as R, column by column, without what others explain */
    double *lengths;           /* (records, columns) of the columns of R */
    double *basis;             /* (width, columns) orthonormal columns of others */
    double *squared, *along;   /* (records, columns) products of free with itself, the residual */
    double *scanned;           /* squares of all points of one component or two beside a fit */
    int64_t size;
} parts;

/* How many points of a component are of the grid. */
static int32_t regular(const cosim_start_grid *s, int32_t component)
{
    return s->points[component] - (s->beside && s->count[component] > 0);
}

int64_t cosim_start_grid_points(const cosim_start_grid *s)
{
    int64_t points = 1;
    for (int32_t i = 0; i < s->components; ++i) {
        points *= regular(s, i);
        if (points > EXHAUSTIVE)
            return 0;
    }
    return points;
}

/* The most points of one component, or of two that are scanned together. */
static int64_t most_scanned(const cosim_start_grid *s)
{
    int64_t most = 0;
    for (int32_t i = 0; i < s->components; ++i)
        for (int32_t j = i; j < s->components; ++j) {
            const int64_t own = regular(s, i);
            const int64_t points = i == j ? own : own * regular(s, j);
            if (points > most && (i == j || points <= MOST_PAIRS))
                most = points;
        }
    return most;
}

static parts parts_of(const cosim_start_grid *s, int32_t records, double *memory)
{
    const int64_t all = cosim_output_error_columns(s->model);
    parts p = {.columns = 1, .width = 1};
    for (int32_t i = 0; i < s->components; ++i) {
        p.columns += s->points[i] * s->size[i];
        p.width += s->size[i];
    }
    const int64_t points = cosim_start_grid_points(s), columns = p.columns;
    const int64_t few = points && !s->beside ? 1 : 0;
    int64_t next = 0;
    /* at first with x(0) and the offset before them */
    p.R = cosim_place(memory, &next, (records - 1) * columns * columns + all * all);
    p.rows = cosim_place(memory, &next, all * all);
    p.chosen = cosim_place(memory, &next, columns * p.width);
    p.T = cosim_place(memory, &next, p.width * p.width);
    p.work = cosim_place(memory, &next, all);
    p.squares = cosim_place(memory, &next, points);
    p.free = cosim_place(memory, &next, (1 - few) * records * columns * columns);
    p.lengths = cosim_place(memory, &next, (1 - few) * records * columns);
    p.basis = cosim_place(memory, &next, (1 - few) * columns * p.width);
    p.squared = cosim_place(memory, &next, (1 - few) * records * columns);
    p.along = cosim_place(memory, &next, (1 - few) * records * columns);
    p.scanned = cosim_place(memory, &next, s->beside ? most_scanned(s) : 0);
    p.size = next;
    return p;
}

int64_t cosim_start_grid_memory(const cosim_start_grid *s, int32_t records)
{
    return parts_of(s, records, NULL).size;
}

/* Rotate x(0) and the offset to the front; what stands below them is the regression without
 * them. */
static void eliminate(const cosim_start_grid *s, const parts *p, const double *R, double *to)
{
    const int32_t all = cosim_output_error_columns(s->model);
    const int32_t basis = p->columns - 1, others = all - p->columns;
    for (int32_t i = 0; i < all; ++i) {
        double *row = p->rows + (int64_t)i * all;
        memcpy(row, R + (int64_t)i * all + basis, (size_t)others * sizeof *row);
        memcpy(row + others, R + (int64_t)i * all, (size_t)basis * sizeof *row);
        row[all - 1] = R[(int64_t)i * all + all - 1];
    }
    memset(to, 0, (size_t)all * (size_t)all * sizeof *to);
    cosim_householder(all, to, all, p->rows, p->work);
    for (int32_t i = 0; i < p->columns; ++i)
        memmove(to + (int64_t)i * p->columns, to + (int64_t)(i + others) * all + others,
                (size_t)p->columns * sizeof *to);
}

static void eliminate_all(const cosim_start_grid *s, const parts *p, int32_t records,
                          const double *R)
{
    const int64_t all = cosim_output_error_columns(s->model), columns = p->columns;
    for (int32_t e = 0; e < records; ++e)
        eliminate(s, p, R + e * all * all, p->R + e * columns * columns);
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

static double squares_at(const cosim_start_grid *s, const parts *p, const double *R, int64_t point)
{
    const double *from = R;
    double *to = p->chosen;
    for (int32_t i = 0; i < s->components; ++i) {
        const int32_t V = s->size[i];
        copy_columns(p, V, from + next_digit(&point, regular(s, i)) * V, to);
        from += s->points[i] * V, to += V;
    }
    copy_columns(p, 1, from, to);
    memset(p->T, 0, (size_t)(p->width * p->width) * sizeof *p->T);
    cosim_householder(p->width, p->T, p->columns, p->chosen, p->work);
    const double residual = p->T[p->width * p->width - 1];
    return residual * residual;
}

/* The way to the neighbors of a point along one component: 0 at an end of the grid. */
typedef struct {
    int64_t down, up;
} steps;

static steps steps_along(const cosim_start_grid *s, int64_t point, int32_t component)
{
    int64_t stride = 1, rest = point;
    for (int32_t i = 0; i < component; ++i) {
        next_digit(&rest, regular(s, i));
        stride *= regular(s, i);
    }
    const int32_t points = regular(s, component), digit = next_digit(&rest, points);
    return (steps){digit > 0 ? -stride : 0, digit < points - 1 ? stride : 0};
}

/* Whether no neighbor along one component or two is better: valleys are seldom along one. */
static int is_minimum(const cosim_start_grid *s, const double *squares, int64_t point)
{
    const double here = squares[point];
    for (int32_t i = 0; i < s->components; ++i) {
        const steps a = steps_along(s, point, i);
        const int64_t along[] = {a.down, 0, a.up};
        for (int32_t j = i; j < s->components; ++j) {
            const steps b = j == i ? (steps){0, 0} : steps_along(s, point, j);
            const int64_t beside[] = {b.down, 0, b.up};
            for (int k = 0; k < 9; ++k)
                if (squares[point + along[k / 3] + beside[k % 3]] < here)
                    return 0;
        }
    }
    return 1;
}

static void write_theta(const cosim_start_grid *s, int64_t point, double *theta)
{
    const double *from = s->theta;
    for (int32_t i = 0; i < s->components; ++i) {
        const int32_t count = s->count[i], digit = next_digit(&point, regular(s, i));
        memcpy(theta, from + digit * count, (size_t)count * sizeof *theta);
        from += s->points[i] * count, theta += count;
    }
}

int32_t cosim_keep_smallest(double value, int64_t point, int32_t found, int32_t most,
                            double *values, int64_t *points)
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

static void make_squares(const cosim_start_grid *s, const parts *p, int32_t records,
                         double *squares)
{
    const int64_t points = cosim_start_grid_points(s), columns = p->columns;
    for (int64_t k = 0; k < points; ++k) {
        squares[k] = 0.0;
        for (int32_t e = 0; e < records; ++e)
            squares[k] += squares_at(s, p, p->R + e * columns * columns, k);
    }
}

void cosim_start_grid_squares(const cosim_start_grid *s, int32_t records, const double *R,
                              double *memory, double *squares)
{
    const parts p = parts_of(s, records, memory);
    eliminate_all(s, &p, records, R);
    make_squares(s, &p, records, squares);
}

/* The combinations that no neighbor betters, the best first. */
static int32_t write_best(const cosim_start_grid *s, const double *squares, int32_t most,
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

/* --- many combinations: one component after the other, then two by two --- */

/* A choice of one point for each component; -1: none yet. */
typedef struct {
    int32_t digit[COSIM_MOST_COLUMNS];
    double squares;
} choice;

static int32_t first_column(const cosim_start_grid *s, int32_t component, int32_t digit)
{
    int32_t column = 0;
    for (int32_t i = 0; i < component; ++i)
        column += s->points[i] * s->size[i];
    return column + digit * s->size[component];
}

static double product_of(int32_t n, const double *a, const double *b)
{
    double sum = 0.0;
    for (int32_t i = 0; i < n; ++i)
        sum += a[i] * b[i];
    return sum;
}

static void subtract(int32_t n, double factor, const double *a, double *b)
{
    for (int32_t i = 0; i < n; ++i)
        b[i] -= factor * a[i];
}

/* Append a column to `count` orthonormal ones, less what these explain; returns how many there are
 * then. `length`: of the column before others were taken from it. */
static int32_t append(int32_t n, int32_t count, double *basis, const double *column, double length)
{
    double *last = basis + (int64_t)count * n;
    memcpy(last, column, (size_t)n * sizeof *last);
    for (int twice = 0; twice < 2; ++twice)
        for (int32_t k = 0; k < count; ++k)
            subtract(n, product_of(n, basis + (int64_t)k * n, last), basis + (int64_t)k * n, last);
    const double left = sqrt(product_of(n, last, last));
    if (!(left > DEPENDENT * length))
        return count;
    for (int32_t i = 0; i < n; ++i)
        last[i] /= left;
    return count + 1;
}

static void transpose_all(const parts *p, int32_t records)
{
    const int64_t n = p->columns;
    for (int32_t e = 0; e < records; ++e)
        for (int64_t j = 0; j < n; ++j) {
            const double *R = p->R + e * n * n;
            double *column = p->free + (e * n + j) * n;
            for (int64_t i = 0; i < n; ++i)
                column[i] = i <= j ? R[i * n + j] : 0.0;
            p->lengths[e * n + j] = sqrt(product_of(p->columns, column, column));
        }
}

/* All columns less what the chosen points explain, but for those of components i and j. */
static void free_columns(const cosim_start_grid *s, const parts *p, int32_t records,
                         const choice *c, int32_t i, int32_t j)
{
    const int32_t n = p->columns;
    transpose_all(p, records);
    for (int32_t e = 0; e < records; ++e) {
        double *columns = p->free + (int64_t)e * n * n;
        int32_t count = 0;
        for (int32_t k = 0; k < s->components; ++k) {
            if (k == i || k == j || c->digit[k] < 0)
                continue;
            const int32_t first = first_column(s, k, c->digit[k]);
            for (int32_t v = 0; v < s->size[k]; ++v)
                count = append(n, count, p->basis, columns + (int64_t)(first + v) * n,
                               p->lengths[e * n + first + v]);
        }
        for (int32_t column = 0; column < n; ++column)
            for (int32_t k = 0; k < count; ++k) {
                const double *q = p->basis + (int64_t)k * n;
                double *of = columns + (int64_t)column * n;
                subtract(n, product_of(n, q, of), q, of);
            }
        const double *residual = columns + (int64_t)(n - 1) * n;
        for (int32_t column = 0; column < n; ++column) {
            const double *of = columns + (int64_t)column * n;
            p->squared[e * n + column] = product_of(n, of, of);
            p->along[e * n + column] = product_of(n, of, residual);
        }
    }
}

/* By how much the squares of record e fall with these columns beside the others. */
static double explained_by(const parts *p, int32_t e, int32_t count, const int32_t *column)
{
    const int32_t n = p->columns;
    const double *free = p->free + (int64_t)e * n * n;
    double L[COSIM_MOST_COLUMNS * COSIM_MOST_COLUMNS], z[COSIM_MOST_COLUMNS], explained = 0.0;
    for (int32_t r = 0; r < count; ++r) {
        double *row = L + r * count, pivot = p->squared[e * n + column[r]];
        const double length = DEPENDENT * p->lengths[e * n + column[r]];
        z[r] = p->along[e * n + column[r]];
        for (int32_t c = 0; c < r; ++c) {
            const double *left = free + (int64_t)column[r] * n;
            double sum = product_of(n, left, free + (int64_t)column[c] * n);
            for (int32_t k = 0; k < c; ++k)
                sum -= row[k] * L[c * count + k];
            row[c] = L[c * count + c] > 0.0 ? sum / L[c * count + c] : 0.0;
            pivot -= row[c] * row[c];
            z[r] -= row[c] * z[c];
        }
        row[r] = pivot > length * length ? sqrt(pivot) : 0.0;
        z[r] = row[r] > 0.0 ? z[r] / row[r] : 0.0;
        explained += z[r] * z[r];
    }
    return explained;
}

static int32_t list_columns(const cosim_start_grid *s, int32_t component, int32_t digit,
                            int32_t *column)
{
    const int32_t first = first_column(s, component, digit);
    for (int32_t v = 0; v < s->size[component]; ++v)
        column[v] = first + v;
    return s->size[component];
}

/* The squares with a point of component j beside one of i, or without it where a is -1. */
static double squares_with(const cosim_start_grid *s, const parts *p, int32_t records, int32_t i,
                           int32_t a, int32_t j, int32_t b)
{
    int32_t column[COSIM_MOST_COLUMNS];
    const int32_t first = a < 0 ? 0 : list_columns(s, i, a, column);
    const int32_t count = first + list_columns(s, j, b, column + first);
    double squares = 0.0;
    for (int32_t e = 0; e < records; ++e) {
        const double all = p->squared[e * p->columns + p->columns - 1];
        squares += all - explained_by(p, e, count, column);
    }
    return squares > 0.0 ? squares : 0.0;
}

static void choose_beside(const cosim_start_grid *s, const parts *p, int32_t records, int32_t i,
                          int32_t a, int32_t j, choice *best)
{
    for (int32_t b = 0; b < regular(s, j); ++b) {
        const double squares = squares_with(s, p, records, i, a, j, b);
        if (squares < best->squares) {
            best->squares = squares;
            best->digit[j] = b;
            if (a >= 0)
                best->digit[i] = a;
        }
    }
}

/* Add the component that explains most at its best point; `forced` is added whatever it
 * explains. */
static void add_component(const cosim_start_grid *s, const parts *p, int32_t records,
                          int32_t forced, choice *c)
{
    choice best = *c;
    best.squares = INFINITY;
    free_columns(s, p, records, c, -1, -1);
    for (int32_t j = 0; j < s->components; ++j) {
        choice trial = *c;
        trial.squares = INFINITY;
        if (c->digit[j] >= 0 || (forced >= 0 && j != forced))
            continue;
        choose_beside(s, p, records, -1, -1, j, &trial);
        if (trial.squares < best.squares)
            best = trial;
    }
    *c = best;
}

/* Choose points anew, of two components together where they are not too many. */
static void sweep(const cosim_start_grid *s, const parts *p, int32_t records, choice *c)
{
    for (int32_t i = 0; i < s->components; ++i)
        for (int32_t j = i == 0 ? 0 : i; j < s->components; ++j) {
            const int single = i == j, few = regular(s, i) * regular(s, j) <= MOST_PAIRS;
            if ((!single && !few) || (single && regular(s, i) == 1))
                continue;
            choice best = *c;
            best.squares = c->squares * (1.0 - 0x1p-40); /* rounding is no progress */
            free_columns(s, p, records, c, i, j);
            if (single)
                choose_beside(s, p, records, -1, -1, i, &best);
            else
                for (int32_t a = 0; a < regular(s, i); ++a)
                    choose_beside(s, p, records, i, a, j, &best);
            if (memcmp(best.digit, c->digit, sizeof best.digit))
                *c = best;
        }
}

/* Interchangeable components in the order of their points. */
static void order(const cosim_start_grid *s, choice *c)
{
    for (int32_t pass = 0; pass < s->components; ++pass)
        for (int32_t i = 0; i < s->components; ++i) {
            const int32_t k = s->alike[i];
            if (k < 0 || c->digit[k] >= c->digit[i])
                continue;
            const int32_t digit = c->digit[k];
            c->digit[k] = c->digit[i];
            c->digit[i] = digit;
        }
}

static choice choose(const cosim_start_grid *s, const parts *p, int32_t records, int32_t forced)
{
    choice c = {.squares = INFINITY};
    for (int32_t i = 0; i < COSIM_MOST_COLUMNS; ++i)
        c.digit[i] = i < s->components && regular(s, i) == 1 ? 0 : -1;
    for (int32_t i = 0; i < s->components; ++i) {
        int32_t left = 0;
        for (int32_t k = 0; k < s->components; ++k)
            left += c.digit[k] < 0;
        if (!left)
            break;
        const int is_first = forced >= 0 && c.digit[forced] < 0;
        add_component(s, p, records, is_first ? forced : -1, &c);
        if (c.squares == INFINITY)
            break;
    }
    for (int32_t k = 0; k < SWEEPS && c.squares < INFINITY; ++k) {
        const choice before = c;
        sweep(s, p, records, &c);
        if (!memcmp(before.digit, c.digit, sizeof c.digit))
            break;
    }
    order(s, &c);
    return c;
}

/* Insert a choice among the best ones, each of which is there once; returns how many there are. */
static int32_t keep_choice(choice c, int32_t most, int32_t count, choice *found)
{
    int32_t place = 0;
    if (!(c.squares < INFINITY))
        return count;
    for (int32_t i = 0; i < count; ++i) {
        if (!memcmp(found[i].digit, c.digit, sizeof c.digit))
            return count;
        place += found[i].squares <= c.squares;
    }
    if (place == most)
        return count;
    const int32_t left = count < most ? count : most - 1;
    for (int32_t i = left; i > place; --i)
        found[i] = found[i - 1];
    found[place] = c;
    return left + 1;
}

/* The best choice with the points of two components exchanged: what tells alphas apart that are
 * nearly the same is less than what the distance of points costs. */
static int32_t exchange(const cosim_start_grid *s, const parts *p, int32_t records, int32_t most,
                        int32_t count, choice *found)
{
    if (!count)
        return 0;
    const choice best = found[0];
    for (int32_t i = 0; i < s->components; ++i)
        for (int32_t j = i + 1; j < s->components; ++j) {
            if (s->points[i] != s->points[j] || s->size[i] != s->size[j])
                continue;
            choice c = best;
            c.digit[i] = best.digit[j];
            c.digit[j] = best.digit[i];
            free_columns(s, p, records, &c, i, j);
            c.squares = squares_with(s, p, records, i, c.digit[i], j, c.digit[j]);
            order(s, &c);
            count = keep_choice(c, most, count, found);
        }
    return count;
}

static void write_choices(const cosim_start_grid *s, int32_t count, const choice *found,
                          double *theta)
{
    for (int32_t k = 0; k < count; ++k) {
        const double *from = s->theta;
        for (int32_t i = 0; i < s->components; ++i) {
            const size_t bytes = (size_t)s->count[i] * sizeof *theta;
            memcpy(theta, from + found[k].digit[i] * s->count[i], bytes);
            from += s->points[i] * s->count[i];
            theta += s->count[i];
        }
    }
}

static int32_t search_by_turns(const cosim_start_grid *s, const parts *p, int32_t records,
                               int32_t most, double *theta)
{
    choice found[COSIM_MOST_STARTS];
    int32_t count = 0;
    for (int32_t k = 0; k <= s->components; ++k)
        count = keep_choice(choose(s, p, records, k - 1), most, count, found);
    count = exchange(s, p, records, most, count, found);
    write_choices(s, count, found, theta);
    return count;
}

/* --- beside a fit --- */

static const double *theta_at(const cosim_start_grid *s, int32_t component, int32_t digit)
{
    const double *theta = s->theta;
    for (int32_t i = 0; i < component; ++i)
        theta += s->points[i] * s->count[i];
    return theta + digit * s->count[component];
}

/* Whether a number is between two others, or is one of them. */
static int is_between(double value, double a, double b)
{
    return (a <= value && value <= b) || (b <= value && value <= a);
}

/* Whether there is no point of the grid between one of component i and the fit of component k. */
static int is_next_to_fit(const cosim_start_grid *s, int32_t i, int32_t digit, int32_t k)
{
    const double *point = theta_at(s, i, digit), *fit = theta_at(s, k, s->points[k] - 1);
    for (int32_t other = 0; other < regular(s, i); ++other) {
        const double *theta = theta_at(s, i, other);
        int between = other != digit;
        for (int32_t j = 0; between && j < s->count[i]; ++j)
            between = is_between(theta[j], point[j], fit[j]);
        if (between)
            return 0;
    }
    return 1;
}

static int are_alike(const cosim_start_grid *s, int32_t i, int32_t j)
{
    while (j > i)
        j = s->alike[j];
    return i == j;
}

/* Whether a fit from there would only go back. */
static int leads_back(const cosim_start_grid *s, const choice *c, int32_t i, int32_t j)
{
    const int32_t a = c->digit[i], b = c->digit[j];
    if (is_next_to_fit(s, i, a, i) && (i == j || is_next_to_fit(s, j, b, j)))
        return 1;
    return i != j && are_alike(s, i, j) && is_next_to_fit(s, i, a, j) && is_next_to_fit(s, j, b, i);
}

static int is_lowest(int32_t rows, int32_t columns, const double *squares, int32_t a, int32_t b)
{
    for (int32_t r = a > 0 ? a - 1 : 0; r <= a + 1 && r < rows; ++r)
        for (int32_t c = b > 0 ? b - 1 : 0; c <= b + 1 && c < columns; ++c)
            if (squares[r * columns + c] < squares[a * columns + b])
                return 0;
    return 1;
}

/* Add the best points of component i, or of i and j, the others as in the fit. */
static int32_t scan(const cosim_start_grid *s, const parts *p, const choice *fit, int32_t i,
                    int32_t j, int32_t most, int32_t count, choice *found)
{
    const int32_t rows = regular(s, i), columns = i == j ? 1 : regular(s, j);
    if (rows < 2 || (i != j && (columns < 2 || rows * columns > MOST_PAIRS)))
        return count;
    free_columns(s, p, 1, fit, i, j);
    for (int32_t a = 0; a < rows; ++a)
        for (int32_t b = 0; b < columns; ++b)
            p->scanned[a * columns + b] = i == j ? squares_with(s, p, 1, -1, -1, i, a)
                                                 : squares_with(s, p, 1, i, a, j, b);
    for (int32_t a = 0; a < rows; ++a)
        for (int32_t b = 0; b < columns; ++b) {
            choice c = *fit;
            c.digit[j] = b;
            c.digit[i] = a;
            c.squares = p->scanned[a * columns + b];
            if (is_lowest(rows, columns, p->scanned, a, b) && !leads_back(s, &c, i, j))
                count = keep_choice(c, most, count, found);
        }
    return count;
}

int32_t cosim_start_grid_beside(const cosim_start_grid *s, const double *R, double *memory,
                                int32_t most, double *theta)
{
    const parts p = parts_of(s, 1, memory);
    choice fit = {.squares = INFINITY}, found[COSIM_MOST_STARTS];
    int32_t count = 0;
    eliminate_all(s, &p, 1, R);
    for (int32_t i = 0; i < s->components; ++i)
        fit.digit[i] = s->points[i] - 1;
    for (int32_t i = 0; i < s->components; ++i)
        for (int32_t j = i; j < s->components; ++j)
            count = scan(s, &p, &fit, i, j, most, count, found);
    write_choices(s, count, found, theta);
    return count;
}

static int32_t first_parameter(const cosim_start_grid *s, int32_t component)
{
    int32_t first = 0;
    for (int32_t i = 0; i < component; ++i)
        first += s->count[i];
    return first;
}

void cosim_start_grid_order(const cosim_start_grid *s, double *theta)
{
    const int32_t parameters = first_parameter(s, s->components);
    for (int32_t j = 0; j < parameters; ++j)
        if (s->even[j])
            theta[j] = fabs(theta[j]);
    for (int32_t pass = 0; pass < s->components; ++pass)
        for (int32_t i = 0; i < s->components; ++i) {
            const int32_t count = s->count[i];
            if (s->alike[i] < 0 || !count)
                continue;
            double *upper = theta + first_parameter(s, s->alike[i]);
            double *lower = theta + first_parameter(s, i);
            for (int32_t k = 0; k < count && upper[count - 1] < lower[count - 1]; ++k) {
                /* the last one decides, and is exchanged last */
                const double value = upper[k];
                upper[k] = lower[k];
                lower[k] = value;
            }
        }
}

int32_t cosim_start_grid_search(const cosim_start_grid *s, int32_t records, const double *R,
                                double *memory, int32_t most, double *theta)
{
    const parts p = parts_of(s, records, memory);
    eliminate_all(s, &p, records, R);
    if (!cosim_start_grid_points(s))
        return search_by_turns(s, &p, records, most, theta);
    make_squares(s, &p, records, p.squares);
    return write_best(s, p.squares, most, theta);
}
