#include "reductions.h"
#include "operations.h"

#include <string.h>

/* The order is that of ROW_OPERATIONS in reductions.py. */
enum { COLUMN = OPERATIONS, WHERE, HOLD };

/* The bits of PARTS in reductions.py. */
enum {
    ENDS = 1, LOW = 2, HIGH = 4, SUM = 8, SQUARES = 16, SHIFTED = 32, INTEGRAL = 64, KEPT = 128
};

static double *register_at(const cosim_reductions *s, int32_t number)
{
    return s->registers + (int64_t)number * COSIM_CHUNK;
}

/* 1 where a condition has held for its duration up to that row, else 0. */
static void hold(cosim_hold *s, int64_t n, const int64_t *time_ns, const double *is_true, double *r)
{
    for (int64_t k = 0; k < n; ++k) {
        const int32_t holds = is_true[k] == 1.0;
        if (holds && !s->is_holding)
            s->since_ns = time_ns[k];
        s->is_holding = holds;
        r[k] = holds && time_ns[k] - s->since_ns >= s->duration_ns;
    }
}

#define EACH(value)                       \
    for (int64_t k = 0; k < n; ++k)       \
        r[k] = (value);                   \
    break
#define BINARY(operation) \
    case operation: EACH(cosim_binary(operation, a[k], b[k]))
#define UNARY(operation) \
    case operation: EACH(cosim_unary(operation, a[k]))

/* The cheap operations by name, so that each is a loop of its own. */
static void apply(int32_t operation, int64_t n, const double *a, const double *b,
                  double *restrict r)
{
    switch (operation) {
    BINARY(ADD);
    BINARY(SUBTRACT);
    BINARY(MULTIPLY);
    BINARY(DIVIDE);
    BINARY(MINIMUM);
    BINARY(MAXIMUM);
    BINARY(LESS);
    BINARY(LESS_EQUAL);
    BINARY(EQUAL);
    BINARY(NOT_EQUAL);
    BINARY(POWER);
    UNARY(NEGATE);
    UNARY(SQRT);
    UNARY(ABS);
    case WHERE: EACH(b[k] == 1.0 ? a[k] : cosim_no_value());
    default: EACH(cosim_unary(operation, a[k]));
    }
}

static void run(const cosim_reductions *s, int64_t n, const int64_t *time_ns, const double *t,
                const double *rows, int64_t stride)
{
    for (int32_t i = 0; i < s->n_instructions; ++i) {
        const cosim_instruction *step = &s->instructions[i];
        double *result = register_at(s, step->result);
        if (step->operation == COLUMN) {
            const double *column = rows + step->a;
            for (int64_t k = 0; k < n; ++k)
                result[k] = column[k * stride];
        } else if (step->operation == T)
            memcpy(result, t, (size_t)n * sizeof *t);
        else if (step->operation == HOLD)
            hold(&s->holds[step->b], n, time_ns, register_at(s, step->a), result);
        else
            apply(step->operation, n, register_at(s, step->a), register_at(s, step->b), result);
    }
}

static int64_t count_values(int64_t n, const double *x)
{
    int64_t count = 0;
    for (int64_t k = 0; k < n; ++k)
        count += x[k] == x[k];
    return count;
}

static void add_ends(cosim_reduction *s, int64_t n, const double *x)
{
    int64_t k = 0;
    if (s->count == 0) {
        while (isnan(x[k]))
            ++k;
        s->first = x[k];
    }
    k = n - 1;
    while (isnan(x[k]))
        --k;
    s->last = x[k];
}

static void add_extremes(cosim_reduction *s, int64_t n, const double *x)
{
    double low = s->low;
    double high = s->high;
    if (s->parts & LOW)
        for (int64_t k = 0; k < n; ++k)
            low = x[k] < low ? x[k] : low; /* false of NaN */
    if (s->parts & HIGH)
        for (int64_t k = 0; k < n; ++k)
            high = x[k] > high ? x[k] : high;
    s->low = low;
    s->high = high;
}

static void add_sums(cosim_reduction *s, int64_t n, const double *x)
{
    double sum = s->sum;
    double squares = s->squares;
    if (s->parts & SUM)
        for (int64_t k = 0; k < n; ++k)
            sum += isnan(x[k]) ? 0.0 : x[k];
    if (s->parts & SQUARES)
        for (int64_t k = 0; k < n; ++k)
            squares += isnan(x[k]) ? 0.0 : x[k] * x[k];
    s->sum = sum;
    s->squares = squares;
}

static void add_shifted(cosim_reduction *s, int64_t n, const double *x)
{
    double sum = s->shifted_sum;
    double squares = s->shifted_squares;
    for (int64_t k = 0; k < n; ++k) {
        const double difference = isnan(x[k]) ? 0.0 : x[k] - s->first;
        sum += difference;
        squares += difference * difference;
    }
    s->shifted_sum = sum;
    s->shifted_squares = squares;
}

static void integrate(cosim_reduction *s, int64_t n, const double *t, const double *x)
{
    double integral = s->integral;
    double before = s->before;
    double t_before = s->t_before;
    for (int64_t k = 0; k < n; ++k) {
        const double part = 0.5 * (t[k] - t_before) * (before + x[k]);
        integral += isnan(part) ? 0.0 : part;
        before = x[k];
        t_before = t[k];
    }
    s->integral = integral;
    s->before = before;
    s->t_before = t_before;
}

static void keep(cosim_reduction *s, int64_t n, const double *t, const double *x)
{
    int64_t count = s->count;
    for (int64_t k = 0; k < n; ++k) {
        if (isnan(x[k]))
            continue;
        s->kept[count] = x[k];
        s->kept_times[count++] = t[k];
    }
}

static void reduce(cosim_reduction *s, int64_t n, const double *t, const double *x)
{
    const int64_t count = count_values(n, x);
    if (s->parts & INTEGRAL)
        integrate(s, n, t, x);
    if (count == 0)
        return;
    if (s->parts & ENDS)
        add_ends(s, n, x);
    if (s->parts & (LOW | HIGH))
        add_extremes(s, n, x);
    if (s->parts & (SUM | SQUARES))
        add_sums(s, n, x);
    if (s->parts & SHIFTED)
        add_shifted(s, n, x);
    if (s->parts & KEPT)
        keep(s, n, t, x);
    s->count += count;
}

void cosim_reduce_rows(cosim_reductions *s, int64_t count, const int64_t *time_ns, const double *t,
                       const double *rows, int64_t stride)
{
    for (int64_t first = 0; first < count; first += COSIM_CHUNK) {
        const int64_t n = count - first < COSIM_CHUNK ? count - first : COSIM_CHUNK;
        run(s, n, time_ns + first, t + first, rows + first * stride, stride);
        for (int32_t i = 0; i < s->n_reductions; ++i)
            reduce(&s->reductions[i], n, t + first, register_at(s, s->reductions[i].values));
    }
}
