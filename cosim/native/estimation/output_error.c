#include "output_error.h"
#include "householder.h"
#include "linear.h"

#include <float.h>
#include <math.h>
#include <string.h>

#define BLOCK 64              /* rows that are gathered before they are rotated into R */
#define DEPENDENT 0x1p-40     /* pivot over the length of its column: below it, that is dependent */
#define FEW_STEPS 3           /* after which a fit is given up that does not promise as much */
#define IN_LINE 0.45          /* of the usual distance of values: what the next one may be off it */
#define HALVINGS 12           /* of a step that does not reduce the sum of squares */
#define SMALL_STEP 0.05       /* in standard errors: what Gauss-Newton leaves then is its square */
#define SMALLEST_STEP 0x1p-43 /* relative to theta: rounding */

/* --- the columns of the regression matrix, and where things stand in `work` --- */

typedef struct {
    int32_t basis;       /* columns of the amplitudes beta_i(0) */
    int32_t linear;      /* these, x(0) and the offset */
    int32_t derivatives; /* of the basis by theta */
    int32_t columns;     /* linear, derivatives, and the residual */
    int32_t parameters;
    int32_t largest; /* V_i */
    int32_t E, F;    /* doubles of all E and F */
} layout;

static layout layout_of(const cosim_output_error *s)
{
    layout l = {0};
    for (int32_t i = 0; i < s->components; ++i) {
        const int32_t V = s->size[i];
        l.basis += V;
        l.derivatives += s->count[i] * V;
        l.parameters += s->count[i];
        l.largest = V > l.largest ? V : l.largest;
        l.E += V * V;
        l.F += s->count[i] * V * V;
    }
    l.linear = l.basis + s->states + (s->offset ? s->outputs : 0);
    l.columns = l.linear + l.derivatives + 1;
    return l;
}

typedef struct {
    double *R;                     /* (columns, columns), first: others read it */
    double *rows, *interval;       /* rows in R; interval of E */
    double *lag, *passed;          /* (outputs) values in the ring; time since the last one */
    double *X, *next;              /* (states, columns) responses */
    double *input0, *input1;       /* (columns) disturbances of the columns at both ends */
    double *basis, *advanced;      /* (basis + derivatives) c' expm(G t) and its derivatives */
    double *E, *F;                 /* expm(G h), and its derivatives */
    double *ring;                  /* (ar, outputs, columns) rows before the filter */
    double *pairs;                 /* (outputs, outputs) samples behind a product of residuals */
    double *steps, *summed, *sums; /* of means: steps, (outputs) rows, (outputs, columns) sums */
    double *R_squared;             /* (columns, columns) of rows with squares of their weights */
    double *block, *block_squared; /* (BLOCK + outputs, columns) */
    double *scratch;
    int64_t size;
} parts;

/* Whether rows weigh differently, so that the errors of theta need R_squared too. */
static int forgets(const cosim_output_error *s, layout l)
{
    return s->forgetting < 1.0 && l.parameters > 0;
}

static parts parts_of(const cosim_output_error *s, layout l, double *work)
{
    const int64_t M = l.columns, N = 2 * l.largest;
    const int64_t squared = forgets(s, l) ? M : 0;
    const int64_t exponential = 4 * N * N, rows = s->outputs * (2 * M + s->outputs);
    parts p;
    int64_t next = 0;
    p.R = cosim_place(work, &next, M * M);
    p.rows = cosim_place(work, &next, 1);
    p.interval = cosim_place(work, &next, 1);
    p.lag = cosim_place(work, &next, s->outputs);
    p.passed = cosim_place(work, &next, s->outputs);
    p.X = cosim_place(work, &next, s->states * M);
    p.next = cosim_place(work, &next, s->states * M);
    p.input0 = cosim_place(work, &next, M);
    p.input1 = cosim_place(work, &next, M);
    p.basis = cosim_place(work, &next, l.basis + l.derivatives);
    p.advanced = cosim_place(work, &next, l.basis + l.derivatives);
    p.E = cosim_place(work, &next, l.E);
    p.F = cosim_place(work, &next, l.F);
    p.ring = cosim_place(work, &next, (int64_t)s->ar * s->outputs * M);
    p.steps = cosim_place(work, &next, 1);
    p.summed = cosim_place(work, &next, s->outputs);
    p.sums = cosim_place(work, &next, s->outputs * M);
    p.pairs = cosim_place(work, &next, s->outputs * s->outputs);
    p.R_squared = cosim_place(work, &next, squared * M);
    p.block = cosim_place(work, &next, (BLOCK + s->outputs) * M);
    p.block_squared = cosim_place(work, &next, (BLOCK + s->outputs) * squared);
    p.scratch = cosim_place(work, &next, exponential > rows ? exponential : rows);
    p.size = next;
    return p;
}

int64_t cosim_output_error_memory(const cosim_output_error *s)
{
    return parts_of(s, layout_of(s), NULL).size;
}

int32_t cosim_output_error_columns(const cosim_output_error *s) { return layout_of(s).columns; }

/* --- the known part of the outputs --- */

/* x += K y; an output that was not measured has no gain. */
static void correct(int32_t n, int32_t outputs, const double *K, const double *y, double *x)
{
    for (int32_t a = 0; a < n; ++a) {
        double sum = 0.0;
        for (int32_t o = 0; o < outputs; ++o)
            if (K[a * outputs + o] != 0.0)
                sum += K[a * outputs + o] * y[o];
        x[a] += sum;
    }
}

/* rows = L rows, in place: of the covariance of the noise, not of that of predictions. */
static void restore_noise(int32_t outputs, int32_t width, const double *L, double *rows)
{
    for (int32_t o = outputs - 1; o >= 0; --o) {
        double *row = rows + o * width;
        const double *of = L + o * outputs;
        if (of[o] != 1.0)
            for (int32_t c = 0; c < width; ++c)
                row[c] *= of[o];
        for (int32_t q = 0; q < o; ++q)
            for (int32_t c = 0; c < width && of[q] != 0.0; ++c)
                row[c] += of[q] * rows[q * width + c];
    }
}

void cosim_output_error_residual(const cosim_output_error *s, const cosim_known_input *known,
                                 int64_t begin, int64_t end, const double *u, const double *y,
                                 const int32_t *interval, double *x, double *residual)
{
    const int32_t n = s->states, m = known->inputs, outputs = s->outputs;
    double *next = x + n;
    for (int64_t k = begin; k < end; ++k) {
        if (k > 0) {
            const int64_t i = interval ? interval[k] : 0;
            cosim_multiply(n, n, s->Ad + i * n * n, x, next);
            cosim_multiply_add(n, m, known->B0 + i * n * m, u + (k - 1) * m, next);
            cosim_multiply_add(n, m, known->B1 + i * n * m, u + k * m, next);
            if (known->predicts[i])
                correct(n, outputs, s->K + i * n * outputs, y + (k - 1) * outputs, next);
            memcpy(x, next, (size_t)n * sizeof *x);
        }
        double *r = residual + k * outputs;
        cosim_multiply(outputs, n, s->C, x, r);
        cosim_multiply_add(outputs, m, known->D, u + k * m, r);
        for (int32_t o = 0; o < outputs; ++o)
            r[o] = y[k * outputs + o] - r[o];
        restore_noise(outputs, 1, s->L + (interval ? interval[k] : 0) * outputs * outputs, r);
    }
}

/* --- one pass over samples, for given theta --- */

/* Exponentials of components of one state, which wait for others: they are computed side by
 * side. */
typedef struct {
    int count;
    double M[COSIM_NUMBERS], S[COSIM_NUMBERS];
    double *E[COSIM_NUMBERS], *F[COSIM_NUMBERS]; /* where the results go; F may be NULL */
} numbers;

static void compute_numbers(numbers *w)
{
    double E[COSIM_NUMBERS], F[COSIM_NUMBERS];
    for (int i = w->count; i < COSIM_NUMBERS; ++i)
        w->M[i] = w->S[i] = 0.0;
    cosim_exponential_numbers(w->M, w->S, E, F);
    for (int i = 0; i < w->count; ++i) {
        *w->E[i] = E[i];
        if (w->F[i])
            *w->F[i] = F[i];
    }
    w->count = 0;
}

static void add_number(numbers *w, double M, double S, double *E, double *F)
{
    w->M[w->count] = M, w->S[w->count] = S;
    w->E[w->count] = E, w->F[w->count] = F;
    if (++w->count == COSIM_NUMBERS)
        compute_numbers(w);
}

void cosim_output_error_basis(const cosim_output_error *s, const double *theta, double h, double *E,
                              double *F, double *work)
{
    const double *G0 = s->G0, *G1 = s->G1;
    numbers w = {0};
    for (int32_t i = 0; i < s->components; ++i) {
        const int32_t V = s->size[i], size = V * V, count = s->count[i];
        double *Gh = work, *slope = work + size, *rest = work + 2 * size;
        cosim_system_matrix(V, count, G0, G1, theta, Gh);
        for (int32_t k = 0; k < size; ++k)
            Gh[k] *= h;
        if (V == 1 && count <= 1)
            add_number(&w, *Gh, count ? *G1 * h : 0.0, E, count ? F : NULL);
        else if (!count)
            cosim_exponential(V, Gh, E, rest);
        else
            for (int32_t j = 0; j < count; ++j) {
                for (int32_t k = 0; k < size; ++k)
                    slope[k] = G1[j * size + k] * h;
                cosim_exponential_slope(V, Gh, slope, E, F + j * size, rest);
            }
        E += size, F += count * size;
        G0 += size, G1 += count * size;
        theta += count;
    }
    if (w.count)
        compute_numbers(&w);
}

static void set_interval(const cosim_output_error *s, const double *theta, int32_t interval,
                         const parts *p)
{
    cosim_output_error_basis(s, theta, s->step[interval], p->E, p->F, p->scratch);
    *p->interval = interval;
}

void cosim_output_error_start(const cosim_output_error *s, const double *theta, double *work)
{
    const layout l = layout_of(s);
    const parts p = parts_of(s, l, work);
    memset(work, 0, (size_t)(p.scratch - work) * sizeof *work);
    for (int32_t i = 0; i < s->states; ++i)
        p.X[i * l.columns + l.basis + i] = 1.0;
    for (int32_t k = 0; k < l.basis; ++k)
        p.basis[k] = s->c[k];
    set_interval(s, theta, 0, &p);
}

/* q' += q E for rows of V numbers. */
static void multiply_row(int32_t V, const double *q, const double *E, double *to)
{
    for (int32_t a = 0; a < V; ++a)
        for (int32_t b = 0; b < V; ++b)
            to[b] += q[a] * E[a * V + b];
}

/* q' = q E and s_j' = s_j E + q F_j for the rows q = c' expm(G t) and s_j = dq/dtheta_j. */
static void advance_basis(const cosim_output_error *s, layout l, const parts *p)
{
    const double *E = p->E, *F = p->F;
    const double *q = p->basis, *slope = p->basis + l.basis;
    double *q_next = p->advanced, *slope_next = p->advanced + l.basis;
    memset(p->advanced, 0, (size_t)(l.basis + l.derivatives) * sizeof *p->advanced);
    for (int32_t i = 0; i < s->components; ++i) {
        const int32_t V = s->size[i];
        multiply_row(V, q, E, q_next);
        for (int32_t j = 0; j < s->count[i]; ++j) {
            multiply_row(V, slope + j * V, E, slope_next + j * V);
            multiply_row(V, q, F + j * V * V, slope_next + j * V);
        }
        E += V * V, F += s->count[i] * V * V;
        q += V, q_next += V;
        slope += s->count[i] * V, slope_next += s->count[i] * V;
    }
    memcpy(p->basis, p->advanced, (size_t)(l.basis + l.derivatives) * sizeof *p->basis);
}

/* What disturbs each column now: alpha_i times its row; nothing where it is no disturbance. */
static void set_inputs(const cosim_output_error *s, layout l, const parts *p, const double *alpha,
                       double *input)
{
    const double *q = p->basis, *slope = p->basis + l.basis;
    double *column = input, *derivative = input + l.linear;
    for (int32_t i = 0; i < s->components; ++i) {
        const int32_t V = s->size[i], count = s->count[i] * V;
        const double factor = alpha[s->source[i]];
        for (int32_t b = 0; b < V; ++b)
            column[b] = factor * q[b];
        for (int32_t b = 0; b < count; ++b)
            derivative[b] = factor * slope[b];
        q += V, column += V;
        slope += count, derivative += count;
    }
}

static void add_input(int32_t count, double b0, double b1, const double *input0,
                      const double *input1, double *x)
{
    for (int32_t c = 0; c < count; ++c)
        x[c] += b0 * input0[c] + b1 * input1[c];
}

/* x' = Ad x + B0 input0 + B1 input1 for every column, and less K for an offset. */
static void advance_responses(const cosim_output_error *s, layout l, const parts *p,
                              int32_t interval)
{
    const int32_t n = s->states, M = l.columns;
    const double *Ad = s->Ad + (int64_t)interval * n * n;
    const double *B0 = s->B0 + (int64_t)interval * s->sources * n;
    const double *B1 = s->B1 + (int64_t)interval * s->sources * n;
    const double *K = s->K + (int64_t)interval * n * s->outputs;
    for (int32_t a = 0; a < n; ++a) {
        double *x = p->next + a * M;
        for (int32_t c = 0; c < M; ++c)
            x[c] = 0.0;
        for (int32_t b = 0; b < n; ++b) {
            const double A = Ad[a * n + b];
            const double *from = p->X + b * M;
            for (int32_t c = 0; c < M; ++c)
                x[c] += A * from[c];
        }
        for (int32_t o = 0; o < s->outputs && s->offset; ++o)
            x[l.linear - s->outputs + o] -= K[a * s->outputs + o];
        int32_t column = 0, derivative = l.linear;
        for (int32_t i = 0; i < s->components; ++i) {
            const int32_t V = s->size[i], count = s->count[i] * V;
            const double b0 = B0[s->source[i] * n + a], b1 = B1[s->source[i] * n + a];
            add_input(V, b0, b1, p->input0 + column, p->input1 + column, x + column);
            add_input(count, b0, b1, p->input0 + derivative, p->input1 + derivative,
                      x + derivative);
            column += V, derivative += count;
        }
    }
    memcpy(p->X, p->next, (size_t)n * (size_t)M * sizeof *p->X);
}

/* One output of the model before weights and filter: C x + D0 input0 + D1 input1. */
typedef struct {
    const double *C;
    const double *D0, *D1; /* of the disturbances; D0 may be NULL */
    int32_t stride;        /* from one disturbance to the next */
} output_row;

static void make_row(const cosim_output_error *s, layout l, const parts *p, output_row from,
                     double *plain)
{
    const int32_t M = l.columns;
    for (int32_t c = 0; c < M; ++c)
        plain[c] = 0.0;
    for (int32_t a = 0; a < s->states; ++a) {
        const double C = from.C[a];
        if (C == 0.0)
            continue;
        for (int32_t c = 0; c < M; ++c)
            plain[c] += C * p->X[a * M + c];
    }
    int32_t column = 0, derivative = l.linear;
    for (int32_t i = 0; i < s->components; ++i) {
        const int32_t V = s->size[i], count = s->count[i] * V;
        const double D0 = from.D0 ? from.D0[s->source[i] * from.stride] : 0.0;
        const double D1 = from.D1[s->source[i] * from.stride];
        if (D0 != 0.0 || D1 != 0.0) {
            add_input(V, D0, D1, p->input0 + column, p->input1 + column, plain + column);
            add_input(count, D0, D1, p->input0 + derivative, p->input1 + derivative,
                      plain + derivative);
        }
        column += V, derivative += count;
    }
}

static const double *weight_at(const cosim_output_error *s, const cosim_record *record, int64_t k)
{
    const int64_t interval = record->interval ? record->interval[k] : 0;
    return s->L + interval * s->outputs * s->outputs;
}

/* The rows of one sample, one an output, of the covariance of the noise. `between`: where they are
 * in the record, if it is no sample of the grid; else L is of the interval that ends there. */
static void make_rows(const cosim_output_error *s, layout l, const parts *p, const double *between,
                      const double *L, const double *residual, double *rows)
{
    const int32_t n = s->states, M = l.columns;
    for (int32_t o = 0; o < s->outputs; ++o) {
        output_row from = {s->C + o * n, NULL, s->D + o, s->outputs};
        double *plain = rows + o * M;
        if (between) {
            const double *row = between + o * (n + 2 * s->sources);
            from = (output_row){row, row + n, row + n + s->sources, 1};
        }
        make_row(s, l, p, from, plain);
        if (s->offset)
            plain[l.linear - s->outputs + o] += 1.0; /* C x has what the predictor knows of it */
    }
    if (L)
        restore_noise(s->outputs, M, L, rows);
    for (int32_t o = 0; o < s->outputs; ++o)
        rows[o * M + M - 1] = residual[o];
}

/* Of the rows of a sample one whose residual is NaN is not there: its output was not measured. */
static int is_there(layout l, const double *rows, int32_t o)
{
    return !isnan(rows[o * l.columns + l.columns - 1]);
}

static int32_t rows_there(const cosim_output_error *s, layout l, const double *rows)
{
    int32_t count = 0;
    for (int32_t o = 0; o < s->outputs; ++o)
        count += is_there(l, rows, o);
    return count;
}

static void leave_out(layout l, double *rows, int32_t o)
{
    rows[o * l.columns + l.columns - 1] = NAN;
}

/* Filter the rows of a sample by the autoregressive model of each output; those that have too few
 * at its distance before them are left out. */
static void filter_rows(const cosim_output_error *s, layout l, const parts *p, double *rows)
{
    const int32_t M = l.columns, width = s->outputs * M;
    double *filtered = rows + width;
    for (int32_t o = 0; o < s->outputs && s->ar; ++o) {
        if (!is_there(l, rows, o))
            continue;
        if (!(fabs(p->passed[o] - s->every[o]) < IN_LINE * s->every[o]))
            p->lag[o] = 0.0;
        p->passed[o] = 0.0;
        const double *a = s->a + o * s->ar;
        const int64_t before = (int64_t)p->lag[o];
        double *row = rows + o * M, *ring = p->ring + o * M;
        p->lag[o] += 1.0;
        if (before >= s->ar)
            for (int32_t c = 0; c < M; ++c) {
                double sum = row[c];
                for (int32_t k = 1; k <= s->ar; ++k)
                    sum -= a[k - 1] * ring[((before - k) % s->ar) * width + c];
                filtered[c] = sum;
            }
        memcpy(ring + (before % s->ar) * width, row, (size_t)M * sizeof *row);
        if (before >= s->ar)
            memcpy(row, filtered, (size_t)M * sizeof *row);
        else
            leave_out(l, rows, o);
    }
}

/* Rotate rows r > m and row m of W so that column m of it is left in row m alone. */
static void rotate_away(const cosim_output_error *s, layout l, int32_t m, double *W, double *rows)
{
    const int32_t outputs = s->outputs, M = l.columns;
    for (int32_t r = m + 1; r < outputs; ++r) {
        const double here = W[m * outputs + m], there = W[r * outputs + m];
        if (there == 0.0)
            continue;
        const double length = sqrt(here * here + there * there);
        const double cosine = here / length, sine = there / length;
        for (int32_t o = 0; o < outputs; ++o) {
            const double upper = W[m * outputs + o], lower = W[r * outputs + o];
            W[m * outputs + o] = cosine * upper + sine * lower;
            W[r * outputs + o] = cosine * lower - sine * upper;
        }
        for (int32_t c = 0; c < M; ++c) {
            const double upper = rows[m * M + c], lower = rows[r * M + c];
            rows[m * M + c] = cosine * upper + sine * lower;
            rows[r * M + c] = cosine * lower - sine * upper;
        }
    }
}

/* Append the rows of a sample to the block, made white by W; returns how many. What is not measured
 * is an unknown of its own: rotated into one row, which says nothing of the others and is left out.
 * That is the covariance of those that are measured, for W is a lower triangle. */
static int32_t weigh_rows(const cosim_output_error *s, layout l, const double *rows, double weight,
                          double *W, double *to)
{
    const int32_t outputs = s->outputs, M = l.columns;
    double *white = to;
    for (int32_t w = 0; w < outputs; ++w, white += M) {
        for (int32_t c = 0; c < M; ++c)
            white[c] = 0.0;
        for (int32_t o = 0; o < outputs; ++o) {
            const double of_output = s->W[w * outputs + o];
            if (of_output == 0.0 || !is_there(l, rows, o))
                continue;
            for (int32_t c = 0; c < M; ++c)
                white[c] += of_output * rows[o * M + c];
        }
        for (int32_t c = 0; c < M; ++c)
            white[c] *= weight;
    }
    memcpy(W, s->W, (size_t)(outputs * outputs) * sizeof *W);
    int32_t count = 0;
    for (int32_t o = 0; o < outputs; ++o)
        if (!is_there(l, rows, o))
            rotate_away(s, l, o, W, to);
    for (int32_t o = 0; o < outputs; ++o)
        if (is_there(l, rows, o)) {
            memmove(to + count * M, to + o * M, (size_t)M * sizeof *to);
            ++count;
        }
    return count;
}

/* Go on to the disturbances at sample k; returns the interval that ends there, -1: none. */
static int32_t advance_inputs(const cosim_output_error *s, layout l, const parts *p,
                              const double *theta, const cosim_record *record, int64_t k)
{
    const double *alpha = record->alpha + k * s->sources;
    if (k == record->first) {
        set_inputs(s, l, p, alpha, p->input1);
        return -1;
    }
    const int32_t interval = record->interval ? record->interval[k] : 0;
    if (s->step[interval] != s->step[(int32_t)*p->interval])
        set_interval(s, theta, interval, p);
    memcpy(p->input0, p->input1, (size_t)l.columns * sizeof *p->input0);
    advance_basis(s, l, p);
    set_inputs(s, l, p, alpha, p->input1);
    return interval;
}

/* Rows that wait to be rotated into R; or, where products of residuals are summed, nothing. */
typedef struct {
    int32_t count;
    double weight;          /* of the next one, relative to R */
    const double *unknowns; /* (linear) amplitudes, x(0) and offset, or NULL */
    double *products;       /* (outputs, outputs) of residuals at these unknowns */
} waiting;

static void rotate_into(int32_t M, double *R, int32_t count, double *block, double weight,
                        double *work)
{
    cosim_householder(M, R, count, block, work);
    if (weight != 1.0)
        for (int32_t i = 0; i < M * M; ++i)
            R[i] /= weight;
}

static void rotate(const cosim_output_error *s, layout l, const parts *p, waiting *w)
{
    const int32_t M = l.columns;
    rotate_into(M, p->R, w->count, p->block, w->weight, p->scratch);
    if (forgets(s, l))
        rotate_into(M, p->R_squared, w->count, p->block_squared, w->weight * w->weight,
                    p->scratch);
    w->count = 0, w->weight = 1.0;
}

static void add_to_means(const cosim_output_error *s, layout l, const parts *p, const double *rows)
{
    const int32_t M = l.columns;
    for (int32_t o = 0; o < s->outputs; ++o) {
        if (!is_there(l, rows, o))
            continue;
        for (int32_t c = 0; c < M; ++c)
            p->sums[o * M + c] += rows[o * M + c];
        p->summed[o] += 1.0;
    }
}

static void add_products(const cosim_output_error *s, layout l, const parts *p, double *rows,
                         const waiting *w)
{
    const int32_t M = l.columns;
    double *residual = rows + s->outputs * M;
    for (int32_t o = 0; o < s->outputs; ++o) {
        const double *row = rows + o * M;
        double explained = 0.0;
        for (int32_t c = 0; c < l.linear; ++c)
            explained += row[c] * w->unknowns[c];
        residual[o] = row[M - 1] - explained;
    }
    for (int32_t o = 0; o < s->outputs; ++o)
        for (int32_t q = 0; q < s->outputs; ++q)
            if (is_there(l, rows, o) && is_there(l, rows, q)) {
                w->products[o * s->outputs + q] += residual[o] * residual[q];
                p->pairs[o * s->outputs + q] += 1.0;
            }
}

/* As if every output had been measured as often as they are in the mean. */
static void even_out(const cosim_output_error *s, const parts *p, double *products)
{
    const int32_t outputs = s->outputs;
    double samples = 0.0;
    for (int32_t o = 0; o < outputs; ++o)
        samples += p->pairs[o * outputs + o] / outputs;
    for (int32_t i = 0; i < outputs * outputs; ++i)
        if (p->pairs[i] > 0.0 && p->pairs[i] != samples)
            products[i] *= samples / p->pairs[i];
}

/* Filter and weigh rows, those of one sample or means, and append them. */
static void append_rows(const cosim_output_error *s, layout l, const parts *p, double *rows,
                        waiting *w)
{
    double *W = rows + 2 * s->outputs * l.columns;
    filter_rows(s, l, p, rows);
    if (!rows_there(s, l, rows))
        return;
    const int32_t before = w->count * l.columns;
    const int32_t made = weigh_rows(s, l, rows, w->weight, W, p->block + before);
    for (int32_t i = 0; forgets(s, l) && i < made * l.columns; ++i)
        p->block_squared[before + i] = w->weight * p->block[before + i];
    *p->rows += made;
    w->count += made;
    if (w->count + s->outputs > BLOCK)
        rotate(s, l, p, w);
}

static void take_rows(const cosim_output_error *s, layout l, const parts *p, const double *between,
                      const double *L, const double *residual, waiting *w)
{
    double *rows = p->scratch;
    int32_t measured = 0;
    for (int32_t o = 0; o < s->outputs; ++o)
        measured += !isnan(residual[o]);
    if (!measured)
        return;
    make_rows(s, l, p, between, L, residual, rows);
    if (w->unknowns) {
        add_products(s, l, p, rows, w);
        return;
    }
    if (s->average > 1)
        add_to_means(s, l, p, rows);
    else
        append_rows(s, l, p, rows, w);
}

/* At the end of a step: append the means of the samples of the last steps, if these are all. */
static void take_means(const cosim_output_error *s, layout l, const parts *p, waiting *w)
{
    const int32_t M = l.columns;
    *p->steps += 1.0;
    if (*p->steps < s->average)
        return;
    for (int32_t o = 0; o < s->outputs; ++o) {
        double *row = p->scratch + o * M, *sums = p->sums + o * M;
        if (p->summed[o] == 0.0)
            leave_out(l, p->scratch, o);
        else
            for (int32_t c = 0; c < M; ++c)
                row[c] = sums[c] / p->summed[o];
        p->summed[o] = 0.0;
    }
    memset(p->sums, 0, (size_t)(s->outputs * M) * sizeof *p->sums);
    *p->steps = 0.0;
    append_rows(s, l, p, p->scratch, w);
}

/* The first of the samples between those of the grid that is in the step to k or later. */
static int64_t first_between(const cosim_between_record *between, int64_t k)
{
    int64_t low = 0, high = between ? between->count : 0;
    while (low < high) {
        const int64_t middle = low + (high - low) / 2;
        if (between->place[middle] < (double)k)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

static void take_samples(const cosim_output_error *s, const parts *p, const double *theta,
                         const cosim_record *record, int64_t begin, int64_t end, waiting *w)
{
    const layout l = layout_of(s);
    const cosim_between_record *between = record->between;
    const int64_t width = s->outputs * (s->states + 2 * s->sources);
    const double of_row = sqrt(s->forgetting);
    int64_t b = first_between(between, begin);
    for (int64_t k = begin; k < end; ++k) {
        const int32_t interval = advance_inputs(s, l, p, theta, record, k);
        for (int32_t o = 0; interval >= 0 && o < s->outputs; ++o)
            p->passed[o] += s->step[interval];
        w->weight /= of_row;
        *p->rows *= s->forgetting;
        for (int32_t i = 0; w->products && i < s->outputs * s->outputs; ++i) {
            w->products[i] *= s->forgetting;
            p->pairs[i] *= s->forgetting;
        }
        for (; between && b < between->count && between->place[b] == (double)k; ++b)
            if (interval >= 0)
                take_rows(s, l, p, between->rows + b * width, NULL,
                          between->residual + b * s->outputs, w);
        if (interval >= 0)
            advance_responses(s, l, p, interval);
        take_rows(s, l, p, NULL, weight_at(s, record, k), record->residual + k * s->outputs, w);
        if (s->average > 1 && !w->unknowns)
            take_means(s, l, p, w);
    }
}

void cosim_output_error_take(const cosim_output_error *s, const double *theta,
                             const cosim_record *record, int64_t begin, int64_t end, double *work)
{
    const layout l = layout_of(s);
    const parts p = parts_of(s, l, work);
    waiting w = {0, 1.0, NULL, NULL};
    take_samples(s, &p, theta, record, begin, end, &w);
    if (w.count > 0 || w.weight != 1.0)
        rotate(s, l, &p, &w);
}

void cosim_output_error_products(const cosim_output_error *s, const double *theta,
                                 const double *unknowns, const cosim_record *record, double *work,
                                 double *products)
{
    const layout l = layout_of(s);
    const parts p = parts_of(s, l, work);
    waiting w = {0, 1.0, unknowns, products};
    memset(products, 0, (size_t)(s->outputs * s->outputs) * sizeof *products);
    cosim_output_error_start(s, theta, work);
    take_samples(s, &p, theta, record, record->first, record->end, &w);
    even_out(s, &p, products);
}

void cosim_output_error_rows(const cosim_output_error *s, const double *theta,
                             const cosim_record *record, double *work, double *rows)
{
    const layout l = layout_of(s);
    const parts p = parts_of(s, l, work);
    const int64_t width = (int64_t)s->outputs * l.columns;
    cosim_output_error_start(s, theta, work);
    for (int64_t k = record->first; k < record->end; ++k) {
        const int32_t interval = advance_inputs(s, l, &p, theta, record, k);
        if (interval >= 0)
            advance_responses(s, l, &p, interval);
        make_rows(s, l, &p, NULL, weight_at(s, record, k), record->residual + k * s->outputs,
                  rows + (k - record->first) * width);
    }
}

/* --- theta from R --- */

static double length(int32_t count, const double *column, int32_t stride)
{
    double squares = 0.0;
    for (int32_t i = 0; i < count; ++i)
        squares += column[i * stride] * column[i * stride];
    return sqrt(squares);
}

/* The linear columns that those before them already explain are left out. */
static int32_t independent_columns(const double *R, int32_t M, int32_t linear, int32_t *kept)
{
    int32_t count = 0;
    for (int32_t j = 0; j < linear; ++j)
        if (fabs(R[j * M + j]) > DEPENDENT * length(j + 1, R + j, M))
            kept[count++] = j;
    return count;
}

/* Rotate chosen columns of R, each given as M doubles, into an upper triangle of their own. */
static void triangularize(int32_t M, int32_t count, double *rows, double *T)
{
    double work[COSIM_MOST_COLUMNS];
    memset(T, 0, (size_t)(count * count) * sizeof *T);
    cosim_householder(count, T, M, rows, work);
}

/* How far the amplitudes of a component are from 0, in their own covariance: beta' C^-1 beta. */
static double amplitude_statistic(int32_t V, int32_t n, const double *covariance, int32_t first,
                                  const double *beta)
{
    double block[COSIM_MOST_COLUMNS * COSIM_MOST_COLUMNS];
    double inverse[COSIM_MOST_COLUMNS * COSIM_MOST_COLUMNS];
    for (int32_t a = 0; a < V; ++a)
        for (int32_t b = 0; b < V; ++b)
            block[a * V + b] = covariance[(first + a) * n + first + b];
    if (cosim_invert(V, block, inverse))
        return 0.0;
    double sum = 0.0;
    for (int32_t a = 0; a < V; ++a)
        for (int32_t b = 0; b < V; ++b)
            sum += beta[a] * inverse[a * V + b] * beta[b];
    return sum;
}

/* Copy columns of T (height, stride) side by side, and make their own triangle of them. */
static void choose(int32_t height, int32_t stride, const double *T, int32_t count,
                   const int32_t *columns, double *triangle)
{
    double rows[COSIM_MOST_COLUMNS * COSIM_MOST_COLUMNS];
    for (int32_t i = 0; i < height; ++i)
        for (int32_t j = 0; j < count; ++j)
            rows[i * count + j] = T[i * stride + columns[j]];
    triangularize(height, count, rows, triangle);
}

/* The regression at theta: n linear unknowns, theta of all components, the residual. */
typedef struct {
    int32_t n, width;
    int32_t kept[COSIM_MOST_COLUMNS]; /* which linear unknowns */
    double T[COSIM_MOST_COLUMNS * COSIM_MOST_COLUMNS];
} regression;

/* The statistic of a component. Its own theta is given, those of the others are unknown with the
 * amplitudes: else errors of these would count as amplitudes of this one. */
static double presence(const cosim_output_error *s, const regression *r, int32_t component,
                       int32_t place, int32_t found, const double *beta)
{
    double triangle[COSIM_MOST_COLUMNS * COSIM_MOST_COLUMNS];
    double covariance[COSIM_MOST_COLUMNS * COSIM_MOST_COLUMNS];
    double work[COSIM_MOST_COLUMNS * (COSIM_MOST_COLUMNS + 1)];
    int32_t columns[COSIM_MOST_COLUMNS], kept[COSIM_MOST_COLUMNS];
    int32_t count = 0, slope = r->n;
    for (int32_t j = 0; j < r->n; ++j)
        columns[count++] = j;
    for (int32_t i = 0; i < s->components; ++i)
        for (int32_t j = 0; j < s->count[i]; ++j, ++slope)
            if (i != component)
                columns[count++] = slope;
    choose(r->width, r->width, r->T, count, columns, triangle);
    const int32_t independent = independent_columns(triangle, count, count, kept);
    for (int32_t j = 0; j < independent; ++j)
        kept[j] = columns[kept[j]];
    choose(r->width, r->width, r->T, independent, kept, triangle);
    cosim_covariance(independent, independent, triangle, covariance, work);
    return amplitude_statistic(found, independent, covariance, place, beta);
}

/* A component whose amplitudes are not all independent of the others has none. */
static void make_statistics(const cosim_output_error *s, const regression *r,
                            const double *amplitudes, double *statistics)
{
    int32_t column = 0, place = 0;
    for (int32_t i = 0; i < s->components; ++i) {
        int32_t found = 0;
        while (place + found < r->n && r->kept[place + found] < column + s->size[i])
            ++found;
        statistics[i] = 0.0;
        if (found == s->size[i])
            statistics[i] = presence(s, r, i, place, found, amplitudes + column);
        place += found, column += s->size[i];
    }
}

/* A row of R with the derivative by theta in the place of those of the basis, for amplitudes
 * beta. */
static void make_slopes(const cosim_output_error *s, const double *derivative, const double *beta,
                        double *slope)
{
    for (int32_t c = 0; c < s->components; ++c) {
        for (int32_t j = 0; j < s->count[c]; ++j) {
            double sum = 0.0;
            for (int32_t b = 0; b < s->size[c]; ++b)
                sum += derivative[b] * beta[b];
            *slope++ = sum;
            derivative += s->size[c];
        }
        beta += s->size[c];
    }
}

static void solve_linear(layout l, const double *R, regression *r, double *amplitudes)
{
    const int32_t M = l.columns;
    double solution[COSIM_MOST_COLUMNS];
    r->n = independent_columns(R, M, l.linear, r->kept);
    int32_t columns[COSIM_MOST_COLUMNS];
    memcpy(columns, r->kept, (size_t)r->n * sizeof *columns);
    columns[r->n] = M - 1;
    choose(M, M, R, r->n + 1, columns, r->T);
    cosim_solve_upper(r->n, r->n + 1, r->T, r->T + r->n, r->n + 1, solution);
    for (int32_t j = 0; j < l.linear; ++j)
        amplitudes[j] = 0.0;
    for (int32_t j = 0; j < r->n; ++j)
        amplitudes[r->kept[j]] = solution[j];
}

static void make_regression(const cosim_output_error *s, const double *R, double *amplitudes,
                            regression *r)
{
    const layout l = layout_of(s);
    const int32_t M = l.columns, P = l.parameters;
    double rows[COSIM_MOST_COLUMNS * COSIM_MOST_COLUMNS];
    solve_linear(l, R, r, amplitudes);
    r->width = r->n + P + 1;
    for (int32_t i = 0; i < M; ++i) {
        double *row = rows + i * r->width;
        for (int32_t j = 0; j < r->n; ++j)
            row[j] = R[i * M + r->kept[j]];
        make_slopes(s, R + i * M + l.linear, amplitudes, row + r->n);
        row[r->n + P] = R[i * M + M - 1];
    }
    triangularize(M, r->width, rows, r->T);
}

int32_t cosim_output_error_reduce(const cosim_output_error *s, const double *R, double *amplitudes,
                                  double *statistics, double *reduced)
{
    const int32_t P = layout_of(s).parameters;
    regression r;
    make_regression(s, R, amplitudes, &r);
    make_statistics(s, &r, amplitudes, statistics);
    for (int32_t i = 0; i <= P; ++i)
        for (int32_t j = 0; j <= P; ++j)
            reduced[i * (P + 1) + j] = r.T[(r.n + i) * r.width + r.n + j];
    return r.n;
}

/* The linear unknowns after a step of theta, to first order. */
static void move_linear(const cosim_experiment *x, const double *step)
{
    const int32_t P = layout_of(x->model).parameters;
    double right[COSIM_MOST_COLUMNS], solution[COSIM_MOST_COLUMNS];
    regression r;
    make_regression(x->model, x->work, x->amplitudes, &r);
    for (int32_t i = 0; i < r.n; ++i) {
        const double *row = r.T + i * r.width + r.n;
        right[i] = row[P];
        for (int32_t j = 0; j < P; ++j)
            right[i] -= row[j] * step[j];
    }
    cosim_solve_upper(r.n, r.width, r.T, right, 1, solution);
    for (int32_t j = 0; j < r.n; ++j)
        x->amplitudes[r.kept[j]] = solution[j];
}

/* --- Gauss-Newton --- */

typedef struct {
    double step[COSIM_MOST_PARAMETERS];
    double variances[COSIM_MOST_PARAMETERS * COSIM_MOST_PARAMETERS];
    double squares;   /* of the residual at theta */
    double predicted; /* after the step */
    int32_t unknowns; /* theta that are estimated */
} gauss_newton;

/* The theta that are estimated now, and the step of these. */
typedef struct {
    int32_t n;
    int32_t place[COSIM_MOST_PARAMETERS];
    /* (n + 1, n + 1), the residual last */
    double triangle[COSIM_MOST_COLUMNS * COSIM_MOST_COLUMNS];
    double solution[COSIM_MOST_PARAMETERS];
} free_theta;

/* The regression of those estimated, the steps of the others taken. */
static void make_triangle(const cosim_fit *fit, const double *T, const gauss_newton *g,
                          free_theta *f)
{
    const int32_t P = fit->parameters, width = P + 1;
    double rows[COSIM_MOST_COLUMNS * COSIM_MOST_COLUMNS];
    f->n = 0;
    for (int32_t j = 0; j < P; ++j)
        if (fit->state[j] == COSIM_ESTIMATED)
            f->place[f->n++] = j;
    for (int32_t i = 0; i < width; ++i) {
        double *row = rows + i * (f->n + 1);
        double residual = T[i * width + P];
        for (int32_t j = 0; j < P; ++j)
            if (fit->state[j] != COSIM_ESTIMATED)
                residual -= T[i * width + j] * g->step[j];
        for (int32_t j = 0; j < f->n; ++j)
            row[j] = T[i * width + f->place[j]];
        row[f->n] = residual;
    }
    triangularize(width, f->n + 1, rows, f->triangle);
}

/* Of columns that say the same the first are kept; returns whether any was left out. */
static int leave_out_dependent(const cosim_fit *fit, const free_theta *f)
{
    const int32_t n = f->n, width = n + 1;
    int found = 0;
    for (int32_t j = 0; j < n; ++j) {
        const double whole = length(j + 1, f->triangle + j, width);
        if (fabs(f->triangle[j * width + j]) > DEPENDENT * whole)
            continue;
        fit->state[f->place[j]] = COSIM_DEPENDENT;
        found = 1;
    }
    return found;
}

/* The theta that the step carries farthest across a bound goes to it; returns whether there is
 * one. */
static int stop_at_bound(const cosim_fit *fit, const free_theta *f, gauss_newton *g)
{
    int32_t stopped = -1;
    double worst = 0.0;
    for (int32_t j = 0; j < f->n; ++j) {
        const int32_t place = f->place[j];
        const double reached = fit->theta[place] + f->solution[j];
        const double above = reached - fit->upper[place];
        const double outside = above > 0.0 ? above : fit->lower[place] - reached;
        if (outside > worst) {
            worst = outside;
            stopped = j;
        }
    }
    if (stopped < 0)
        return 0;
    const int32_t place = f->place[stopped];
    const double bound = f->solution[stopped] > 0.0 ? fit->upper[place] : fit->lower[place];
    fit->state[place] = COSIM_AT_BOUND;
    g->step[place] = bound - fit->theta[place];
    return 1;
}

static void take_step(const cosim_fit *fit, const free_theta *f, gauss_newton *g)
{
    const int32_t P = fit->parameters, n = f->n, width = n + 1;
    double covariance[COSIM_MOST_PARAMETERS * COSIM_MOST_PARAMETERS];
    double work[COSIM_MOST_PARAMETERS * (COSIM_MOST_PARAMETERS + 1)];
    cosim_covariance(n, width, f->triangle, covariance, work);
    for (int32_t a = 0; a < n; ++a) {
        g->step[f->place[a]] = f->solution[a];
        for (int32_t b = 0; b < n; ++b)
            g->variances[f->place[a] * P + f->place[b]] = covariance[a * n + b];
    }
    const double last = f->triangle[n * width + n];
    g->predicted = last * last;
    g->unknowns = n;
}

/* Without one theta after the other that others explain or that would leave its bounds. */
static void solve_step(const cosim_fit *fit, const double *T, gauss_newton *g)
{
    free_theta f;
    memset(g->variances, 0, sizeof g->variances);
    memset(g->step, 0, sizeof g->step);
    for (;;) {
        make_triangle(fit, T, g, &f);
        if (leave_out_dependent(fit, &f))
            continue;
        const int32_t width = f.n + 1;
        cosim_solve_upper(f.n, width, f.triangle, f.triangle + f.n, width, f.solution);
        if (!stop_at_bound(fit, &f, g))
            break;
    }
    take_step(fit, &f, g);
}

/* R of all experiments at theta, reduced to theta and stacked. */
static int reduce_all(const cosim_fit *fit, double *T, double *rows_total, int32_t *unknowns)
{
    const int32_t width = fit->parameters + 1;
    double reduced[COSIM_MOST_COLUMNS * COSIM_MOST_COLUMNS], work[COSIM_MOST_COLUMNS];
    double statistics[COSIM_MOST_COLUMNS];
    memset(T, 0, (size_t)(width * width) * sizeof *T);
    *rows_total = 0.0, *unknowns = 0;
    for (int32_t i = 0; i < fit->components; ++i)
        fit->statistics[i] = 0.0;
    for (int32_t e = 0; e < fit->experiments; ++e) {
        const cosim_experiment *x = &fit->experiment[e];
        const layout l = layout_of(x->model);
        *unknowns +=
            cosim_output_error_reduce(x->model, x->work, x->amplitudes, statistics, reduced);
        *rows_total += *parts_of(x->model, l, x->work).rows;
        for (int32_t i = 0; i < fit->components; ++i)
            fit->statistics[i] += statistics[i];
        cosim_householder(width, T, width, reduced, work);
    }
    for (int32_t i = 0; i < width * width; ++i)
        if (!(fabs(T[i]) <= DBL_MAX))
            return 0;
    return 1;
}

static void pass(const cosim_fit *fit, const double *theta)
{
    for (int32_t e = 0; e < fit->experiments; ++e) {
        const cosim_experiment *x = &fit->experiment[e];
        cosim_output_error_start(x->model, theta, x->work);
        cosim_output_error_take(x->model, theta, &x->record, x->record.first, x->record.end,
                                x->work);
    }
}

/* Of a component that noise alone explains theta means nothing: it stays where it is. */
static void hold_absent(const cosim_fit *fit, double variance)
{
    int32_t j = 0;
    for (int32_t i = 0; i < fit->components; ++i) {
        const int present = fit->statistics[i] > fit->threshold[i] * variance;
        for (int32_t k = 0; k < fit->count[i]; ++k, ++j) {
            fit->state[j] = present ? COSIM_ESTIMATED : COSIM_ABSENT;
            if (fit->lower[j] == fit->upper[j])
                fit->state[j] = COSIM_FIXED;
        }
    }
}

static double variance_of(const cosim_fit *fit, double squares, double rows, int32_t unknowns)
{
    const double freedom = rows - unknowns;
    const double variance = freedom > 0.0 ? squares / freedom : INFINITY;
    const double rounding = fit->accuracy * fit->accuracy;
    return variance > rounding ? variance : rounding;
}

static double largest_of(double a, double b) { return a > b ? a : b; }

/* The step in units of what it may be at the end: a small part of a standard error, or rounding. */
static double relative_step(const cosim_fit *fit, const gauss_newton *g, double variance)
{
    const int32_t P = fit->parameters;
    double largest = 0.0;
    for (int32_t j = 0; j < P; ++j) {
        const double error = sqrt(variance * g->variances[j * P + j]);
        const double rounding = SMALLEST_STEP * (fabs(fit->theta[j]) + fit->scale[j]);
        largest = largest_of(largest, fabs(g->step[j]) / largest_of(SMALL_STEP * error, rounding));
    }
    return largest;
}

static void limit_step(const cosim_fit *fit, gauss_newton *g)
{
    double factor = 1.0;
    for (int32_t j = 0; j < fit->parameters; ++j)
        if (fabs(g->step[j]) * factor > fit->scale[j])
            factor = fit->scale[j] / fabs(g->step[j]);
    for (int32_t j = 0; j < fit->parameters; ++j)
        g->step[j] *= factor;
}

/* Solve at the theta that R was made for; 0: there is no information. */
static int solve(const cosim_fit *fit, gauss_newton *g, double *freedom)
{
    const int32_t P = fit->parameters;
    double T[COSIM_MOST_COLUMNS * COSIM_MOST_COLUMNS], rows;
    int32_t unknowns;
    if (!reduce_all(fit, T, &rows, &unknowns))
        return 0;
    double squares = 0.0;
    for (int32_t i = 0; i <= P; ++i)
        squares += T[i * (P + 1) + P] * T[i * (P + 1) + P];
    const double smallest = T[P * (P + 1) + P] * T[P * (P + 1) + P];
    hold_absent(fit, variance_of(fit, smallest, rows, unknowns + P));
    solve_step(fit, T, g);
    g->squares = squares;
    *freedom = rows - unknowns - g->unknowns;
    return rows - unknowns - P > 0.0;
}

/* G += B'B with the derivatives B by theta of the rows with squared weights, less what the linear
 * unknowns make up for. */
static void add_squared(const cosim_experiment *x, double *G)
{
    const cosim_output_error *s = x->model;
    const layout l = layout_of(s);
    const int32_t M = l.columns, P = l.parameters;
    const double *R_squared = parts_of(s, l, x->work).R_squared;
    double amplitudes[COSIM_MOST_COLUMNS], slope[COSIM_MOST_PARAMETERS];
    double by_theta[COSIM_MOST_PARAMETERS * COSIM_MOST_COLUMNS];
    regression r;
    make_regression(s, x->work, amplitudes, &r);
    for (int32_t j = 0; j < P; ++j)
        cosim_solve_upper(r.n, r.width, r.T, r.T + r.n + j, r.width, by_theta + j * r.n);
    for (int32_t i = 0; i < M; ++i) {
        const double *row = R_squared + i * M;
        make_slopes(s, row + l.linear, amplitudes, slope);
        for (int32_t j = 0; j < P; ++j)
            for (int32_t k = 0; k < r.n; ++k)
                slope[j] -= row[r.kept[k]] * by_theta[j * r.n + k];
        for (int32_t j = 0; j < P; ++j)
            for (int32_t k = 0; k < P; ++k)
                G[j * P + k] += slope[j] * slope[k];
    }
}

/* The covariance of theta for noise of variance 1: H, or H G H where rows weigh differently. */
static void make_covariance(const cosim_fit *fit, const gauss_newton *g, double *covariance)
{
    const int32_t P = fit->parameters;
    const double *H = g->variances;
    double G[COSIM_MOST_PARAMETERS * COSIM_MOST_PARAMETERS] = {0.0};
    double HG[COSIM_MOST_PARAMETERS * COSIM_MOST_PARAMETERS] = {0.0};
    const cosim_experiment *first = fit->experiment;
    memcpy(covariance, H, (size_t)(P * P) * sizeof *covariance);
    if (!forgets(first->model, layout_of(first->model)))
        return;
    for (int32_t e = 0; e < fit->experiments; ++e)
        add_squared(&fit->experiment[e], G);
    for (int32_t a = 0; a < P; ++a)
        for (int32_t b = 0; b < P; ++b)
            for (int32_t c = 0; c < P; ++c)
                HG[a * P + b] += H[a * P + c] * G[c * P + b];
    for (int32_t a = 0; a < P; ++a)
        for (int32_t b = 0; b < P; ++b) {
            double sum = 0.0;
            for (int32_t c = 0; c < P; ++c)
                sum += HG[a * P + c] * H[c * P + b];
            covariance[a * P + b] = sum;
        }
}

static void finish(cosim_fit *fit, const gauss_newton *g, double freedom)
{
    const int32_t P = fit->parameters;
    for (int32_t j = 0; j < P; ++j)
        fit->estimate[j] = fit->theta[j] + g->step[j];
    const double rows = freedom + g->unknowns;
    const double variance = variance_of(fit, g->predicted, rows, g->unknowns);
    fit->variance = variance;
    fit->freedom = freedom;
    make_covariance(fit, g, fit->covariance);
    for (int32_t j = 0; j < P * P; ++j)
        fit->covariance[j] *= variance;
}

/* The linear unknowns go with theta to the estimate. */
static void move_all_linear(const cosim_fit *fit, const gauss_newton *g)
{
    for (int32_t e = 0; e < fit->experiments; ++e)
        move_linear(&fit->experiment[e], g->step);
}

void cosim_output_error_settle(cosim_fit *fit)
{
    double squares = 0.0;
    pass(fit, fit->estimate);
    for (int32_t e = 0; e < fit->experiments; ++e) {
        const cosim_experiment *x = &fit->experiment[e];
        const layout l = layout_of(x->model);
        regression r;
        solve_linear(l, x->work, &r, x->amplitudes);
        const double last = r.T[(r.n + 1) * (r.n + 1) - 1];
        squares += last * last;
    }
    const double before = fit->variance;
    fit->variance = variance_of(fit, squares, fit->freedom, 0);
    for (int32_t j = 0; before > 0.0 && j < fit->parameters * fit->parameters; ++j)
        fit->covariance[j] *= fit->variance / before;
}

int32_t cosim_output_error_update(cosim_fit *fit)
{
    gauss_newton g;
    double freedom;
    if (!solve(fit, &g, &freedom))
        return COSIM_NO_VALUE;
    finish(fit, &g, freedom);
    move_all_linear(fit, &g);
    return relative_step(fit, &g, fit->variance) <= fit->tolerance ? COSIM_OK : COSIM_NOT_CONVERGED;
}

int32_t cosim_output_error_fit(cosim_fit *fit)
{
    const int32_t P = fit->parameters;
    gauss_newton g = {0};
    double accepted[COSIM_MOST_PARAMETERS], freedom = 0.0, best = INFINITY;
    double part = 1.0; /* of a step that is tried first: what was left of the last ones, and more */
    int32_t halvings = 0;
    memcpy(accepted, fit->theta, (size_t)P * sizeof *accepted);
    for (fit->iterations = 1; fit->iterations <= fit->most_iterations; ++fit->iterations) {
        pass(fit, fit->theta);
        gauss_newton trial;
        double trial_freedom = 0.0;
        const int solved = solve(fit, &trial, &trial_freedom);
        if (!solved && best == INFINITY)
            return COSIM_NO_VALUE;
        const double rounding = trial_freedom * fit->accuracy * fit->accuracy;
        if (solved && trial.squares <= best + rounding) {
            g = trial;
            freedom = trial_freedom;
            best = trial.squares;
            memcpy(accepted, fit->theta, (size_t)P * sizeof *accepted);
            halvings = 0;
            finish(fit, &g, freedom);
            if (relative_step(fit, &g, fit->variance) <= 1.0) {
                move_all_linear(fit, &g);
                return COSIM_OK;
            }
            if (fit->iterations >= FEW_STEPS && g.predicted > fit->most_squares)
                break;
            limit_step(fit, &g);
            part = part < 0.25 ? 4.0 * part : 1.0;
            for (int32_t j = 0; j < P; ++j)
                g.step[j] *= part;
        } else if (++halvings > HALVINGS) {
            break;
        } else {
            part *= 0.5;
            for (int32_t j = 0; j < P; ++j)
                g.step[j] *= 0.5;
        }
        for (int32_t j = 0; j < P; ++j)
            fit->theta[j] = accepted[j] + g.step[j];
    }
    memcpy(fit->estimate, accepted, (size_t)P * sizeof *accepted);
    return COSIM_NOT_CONVERGED;
}
