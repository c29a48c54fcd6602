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

/* How many of n values are 1. */
static int64_t count_ones(int64_t n, const double *x)
{
    double ones[COSIM_LANES] = {0.0};
    int64_t k = 0;
    for (; k + COSIM_LANES <= n; k += COSIM_LANES)
        for (int32_t j = 0; j < COSIM_LANES; ++j)
            ones[j] += x[k + j] == 1.0 ? 1.0 : 0.0;
    for (; k < n; ++k)
        ones[0] += x[k] == 1.0;
    return (int64_t)((ones[0] + ones[1]) + (ones[2] + ones[3]));
}

static void fill(int64_t n, double value, double *r)
{
    for (int64_t k = 0; k < n; ++k)
        r[k] = value;
}

/* Of the next rows. */
typedef struct {
    const int64_t *time_ns; /* NULL: they are step_ns apart */
    int64_t first_ns, step_ns;
    const double *t;
} row_instants;

static int64_t instant(const row_instants *s, int64_t k)
{
    return s->time_ns ? s->time_ns[k] : s->first_ns + k * s->step_ns;
}

/* 1 where a condition has held for its duration up to that row, else 0. */
static void hold(cosim_hold *s, int64_t n, const row_instants *instants, const double *is_true,
                 double *r)
{
    const int64_t ones = count_ones(n, is_true);
    if (ones == 0) {
        s->is_holding = 0;
        fill(n, 0.0, r);
        return;
    }
    if (ones == n && s->is_holding && instant(instants, 0) - s->since_ns >= s->duration_ns) {
        fill(n, 1.0, r);
        return;
    }
    for (int64_t k = 0; k < n; ++k) {
        const int32_t holds = is_true[k] == 1.0;
        if (holds && !s->is_holding)
            s->since_ns = instant(instants, k);
        s->is_holding = holds;
        r[k] = holds && instant(instants, k) - s->since_ns >= s->duration_ns;
    }
}

static void where(int64_t n, const double *a, const double *is_true, double *restrict r)
{
    const double nothing = cosim_no_value();
    for (int64_t k = 0; k < n; ++k) {
        const double value = a[k];
        r[k] = is_true[k] == 1.0 ? value : nothing;
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

/* The cheap operations by name, so that each is a loop of its own. Comparisons are written as
 * operators, which compilers make vectors of; of NaN they are false all the same. */
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
    BINARY(EQUAL);
    BINARY(NOT_EQUAL);
    case LESS: EACH(a[k] < b[k] ? 1.0 : 0.0);
    case LESS_EQUAL: EACH(a[k] <= b[k] ? 1.0 : 0.0);
    BINARY(POWER);
    UNARY(NEGATE);
    UNARY(SQRT);
    UNARY(ABS);
    case WHERE: where(n, a, b, r); break;
    default: EACH(cosim_unary(operation, a[k]));
    }
}

static void run(const cosim_reductions *s, int64_t n, const row_instants *instants,
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
            memcpy(result, instants->t, (size_t)n * sizeof(double));
        else if (step->operation == HOLD)
            hold(&s->holds[step->b], n, instants, register_at(s, step->a), result);
        else
            apply(step->operation, n, register_at(s, step->a), register_at(s, step->b), result);
    }
}

static int64_t count_values(int64_t n, const double *x)
{
    double values[COSIM_LANES] = {0.0};
    int64_t k = 0;
    for (; k + COSIM_LANES <= n; k += COSIM_LANES)
        for (int32_t j = 0; j < COSIM_LANES; ++j)
            values[j] += x[k + j] == x[k + j] ? 1.0 : 0.0;
    for (; k < n; ++k)
        values[0] += x[k] == x[k];
    return (int64_t)((values[0] + values[1]) + (values[2] + values[3]));
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

/* The largest of n values and `high`, in lanes; of zeros with different signs any of them. */
static double highest(int64_t n, const double *x, double high)
{
    double lanes[COSIM_LANES] = {high, high, high, high};
    int64_t k = 0;
    for (; k + COSIM_LANES <= n; k += COSIM_LANES)
        for (int32_t j = 0; j < COSIM_LANES; ++j)
            lanes[j] = x[k + j] > lanes[j] ? x[k + j] : lanes[j]; /* false of NaN */
    for (; k < n; ++k)
        lanes[0] = x[k] > lanes[0] ? x[k] : lanes[0];
    for (int32_t j = 1; j < COSIM_LANES; ++j)
        lanes[0] = lanes[j] > lanes[0] ? lanes[j] : lanes[0];
    return lanes[0];
}

static double lowest(int64_t n, const double *x, double low)
{
    double lanes[COSIM_LANES] = {low, low, low, low};
    int64_t k = 0;
    for (; k + COSIM_LANES <= n; k += COSIM_LANES)
        for (int32_t j = 0; j < COSIM_LANES; ++j)
            lanes[j] = x[k + j] < lanes[j] ? x[k + j] : lanes[j];
    for (; k < n; ++k)
        lanes[0] = x[k] < lanes[0] ? x[k] : lanes[0];
    for (int32_t j = 1; j < COSIM_LANES; ++j)
        lanes[0] = lanes[j] < lanes[0] ? lanes[j] : lanes[0];
    return lanes[0];
}

/* Add terms to the lanes of their rows, the first of which has the number `first`. */
static void add_terms(double *lanes, int64_t first, int64_t n, const double *terms)
{
    int64_t k = 0;
    for (; k < n && (first + k) % COSIM_LANES; ++k)
        lanes[(first + k) % COSIM_LANES] += terms[k];
    double sums[COSIM_LANES] = {lanes[0], lanes[1], lanes[2], lanes[3]};
    for (; k + COSIM_LANES <= n; k += COSIM_LANES)
        for (int32_t j = 0; j < COSIM_LANES; ++j)
            sums[j] += terms[k + j];
    memcpy(lanes, sums, sizeof sums);
    for (; k < n; ++k)
        lanes[(first + k) % COSIM_LANES] += terms[k];
}

static void add_sums(cosim_reduction *s, int64_t first, int64_t n, const double *x)
{
    double terms[COSIM_CHUNK];
    if (s->parts & SUM) {
        for (int64_t k = 0; k < n; ++k)
            terms[k] = x[k] == x[k] ? x[k] : 0.0;
        add_terms(s->lanes[COSIM_SUM], first, n, terms);
    }
    if (s->parts & SQUARES) {
        for (int64_t k = 0; k < n; ++k)
            terms[k] = x[k] == x[k] ? x[k] * x[k] : 0.0;
        add_terms(s->lanes[COSIM_SQUARES], first, n, terms);
    }
    if (s->parts & SHIFTED) {
        for (int64_t k = 0; k < n; ++k)
            terms[k] = x[k] == x[k] ? x[k] - s->first : 0.0;
        add_terms(s->lanes[COSIM_SHIFTED], first, n, terms);
        for (int64_t k = 0; k < n; ++k)
            terms[k] *= terms[k];
        add_terms(s->lanes[COSIM_SHIFTED_SQUARES], first, n, terms);
    }
}

static void integrate(cosim_reduction *s, int64_t first, int64_t n, const double *t,
                      const double *x)
{
    double terms[COSIM_CHUNK];
    terms[0] = 0.5 * (t[0] - s->t_before) * (s->before + x[0]);
    for (int64_t k = 1; k < n; ++k)
        terms[k] = 0.5 * (t[k] - t[k - 1]) * (x[k - 1] + x[k]);
    /* none where one of both rows has no value; +inf and -inf have no integral */
    if (s->before != s->before || x[0] != x[0])
        terms[0] = 0.0;
    for (int64_t k = 1; k < n; ++k)
        terms[k] = x[k - 1] == x[k - 1] && x[k] == x[k] ? terms[k] : 0.0;
    add_terms(s->lanes[COSIM_INTEGRAL], first, n, terms);
    s->before = x[n - 1];
    s->t_before = t[n - 1];
}

static void reduce(cosim_reduction *s, int64_t first, int64_t n, const double *t, const double *x)
{
    if (s->parts & KEPT)
        memcpy(s->kept + first, x, (size_t)n * sizeof *x);
    if (s->parts & INTEGRAL)
        integrate(s, first, n, t, x);
    const int64_t count = count_values(n, x);
    if (count == 0)
        return;
    if (s->parts & ENDS)
        add_ends(s, n, x);
    if (s->parts & LOW)
        s->low = lowest(n, x, s->low);
    if (s->parts & HIGH)
        s->high = highest(n, x, s->high);
    if (s->parts & (SUM | SQUARES | SHIFTED))
        add_sums(s, first, n, x);
    s->count += count;
}

void cosim_begin_reductions(cosim_reductions *s)
{
    s->n_rows = 0;
    for (int32_t i = 0; i < s->n_holds; ++i)
        s->holds[i].is_holding = 0;
    for (int32_t i = 0; i < s->n_reductions; ++i) {
        cosim_reduction *reduction = &s->reductions[i];
        reduction->count = 0;
        reduction->low = INFINITY;
        reduction->high = -INFINITY;
        reduction->before = reduction->t_before = cosim_no_value();
        memset(reduction->sums, 0, sizeof reduction->sums);
        memset(reduction->lanes, 0, sizeof reduction->lanes);
    }
}

static void add_up(cosim_reduction *s)
{
    for (int32_t i = 0; i < COSIM_SUMS; ++i)
        s->sums[i] = (s->lanes[i][0] + s->lanes[i][1]) + (s->lanes[i][2] + s->lanes[i][3]);
}

void cosim_reduce_rows(cosim_reductions *s, int64_t count, const int64_t *time_ns, int64_t first_ns,
                       int64_t step_ns, const double *t, const double *rows, int64_t stride)
{
    row_instants instants = {time_ns, first_ns, step_ns, t};
    int64_t done = 0;
    while (done < count) {
        /* chunks end where their number of rows is whole, so that lanes begin with the first */
        const int64_t rest = COSIM_CHUNK - s->n_rows % COSIM_CHUNK;
        const int64_t n = count - done < rest ? count - done : rest;
        run(s, n, &instants, rows + done * stride, stride);
        for (int32_t i = 0; i < s->n_reductions; ++i)
            reduce(&s->reductions[i], s->n_rows, n, instants.t,
                   register_at(s, s->reductions[i].values));
        done += n;
        s->n_rows += n;
        instants.t += n;
        if (instants.time_ns)
            instants.time_ns += n;
        instants.first_ns += n * instants.step_ns;
    }
    for (int32_t i = 0; i < s->n_reductions; ++i)
        add_up(&s->reductions[i]);
}

/* Whether one of COSIM_CHUNK values is farther than a band from `center`. */
static int is_outside(const double *x, double center, double band)
{
    double outside[COSIM_LANES] = {0.0};
    for (int64_t k = 0; k < COSIM_CHUNK; k += COSIM_LANES)
        for (int32_t j = 0; j < COSIM_LANES; ++j)
            outside[j] += fabs(x[k + j] - center) > band ? 1.0 : 0.0;
    return (outside[0] + outside[1]) + (outside[2] + outside[3]) > 0.0;
}

int64_t cosim_settled(int64_t count, const double *x, double center, double band)
{
    int64_t k = count;
    while (k >= COSIM_CHUNK && !is_outside(x + k - COSIM_CHUNK, center, band))
        k -= COSIM_CHUNK;
    while (k > 0 && !(fabs(x[k - 1] - center) > band))
        --k;
    while (k < count && isnan(x[k]))
        ++k;
    return k;
}
