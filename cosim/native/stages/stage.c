#include "stage.h"

#include <math.h>
#include <stdbool.h>
#include <string.h>
#include <time.h>

#include "copying.h"

#define RARE __attribute__((noinline))

#define GO_ON (-1) /* the cursor shows where */

static double convert(const cosim_sum *sum, double value)
{
    if (!sum->converts)
        return value;
    return (value * sum->factor1 + sum->offset1 - sum->offset2) / sum->factor2;
}

static bool is_finite(double value)
{
    return value - value == 0.0;
}

static double value_of(const cosim_sum *sum, const double *row)
{
    const cosim_term *terms = sum->terms;
    if (sum->plain)
        return convert(sum, row[terms->from]);
    double value = sum->offset;
    for (int32_t j = 0; j < sum->n_terms; ++j)
        value += terms[j].gain * row[terms[j].from];
    return convert(sum, value);
}

static void add_up(cosim_stage *s, const cosim_sum *sum, double *row)
{
    const double value = value_of(sum, row);
    s->suspicious |= !is_finite(value);
    row[sum->to] = value;
}

/* Give inputs that are overridden their values, behind what their sources gave. */
static void override(cosim_stage *s, const cosim_member *m, double *row)
{
    for (int32_t i = 0; i < *m->overridden; ++i) {
        double *u = row + m->overridden[1 + i];
        if (m->gains[i] == 0.0) {
            *u = m->overrides[i];
            continue;
        }
        *u = m->gains[i] * *u + m->overrides[i];
        s->suspicious |= !is_finite(*u);
    }
}

/* Give inputs that a loop solves for what is tried for them. */
static inline void put_tried(const cosim_member *m, double *row)
{
    for (int32_t i = 0; i < m->n_torn; ++i)
        row[m->torn[i]] = m->tried[i];
}

static void copy_wide(const cosim_wide_copy *c, double *row)
{
    memcpy(row + c->to, row + c->from, (size_t)c->count * sizeof *row);
}

/* Fill inputs that are no copies of single columns. */
RARE static void gather_driven(cosim_stage *s, const cosim_member *m, double *row)
{
    for (int32_t i = 0; i < m->n_wide; ++i)
        copy_wide(m->wide_copies + i, row);
    for (int32_t i = 0; i < m->n_sums; ++i)
        add_up(s, m->sums + i, row);
    override(s, m, row);
}

static inline void gather_copies(const cosim_member *m, double *row)
{
    const cosim_copy *c = m->copies, *end = c + m->n_copies;
    for (; c < end; ++c)
        row[c->to] = row[c->from];
}

/* Fill the inputs from their sources. */
static inline void gather_sources(cosim_stage *s, const cosim_member *m, double *row)
{
    gather_copies(m, row);
    if (m->n_wide | m->n_sums | *m->overridden)
        gather_driven(s, m, row);
}

/* The same of a member with inputs that are tried, or kept: those have the values of that. */
RARE static void gather_torn(cosim_stage *s, const cosim_member *m, double *row)
{
    if (m->n_torn < m->n_u)
        gather_sources(s, m, row);
    put_tried(m, row);
}

static inline void gather(cosim_stage *s, const cosim_member *m, double *row)
{
    if (m->n_torn)
        gather_torn(s, m, row);
    else
        gather_sources(s, m, row);
}

static inline double left_limit(const cosim_jump *jump, const double *before, const double *row)
{
    return jump->limit < 0 ? before[jump->column] : row[jump->limit];
}

/* Put left limits of sources in the places of right ones. */
static inline void put_left(const cosim_member *m, const double *before, double *row)
{
    for (int32_t i = 0; i < m->n_jumps; ++i) {
        m->right[i] = row[m->jumps[i].column];
        row[m->jumps[i].column] = left_limit(m->jumps + i, before, row);
    }
}

static inline void put_right(const cosim_member *m, double *row)
{
    for (int32_t i = 0; i < m->n_jumps; ++i)
        row[m->jumps[i].column] = m->right[i];
}

/* Fill the inputs from the left limits of their sources. */
static inline void gather_left(cosim_stage *s, const cosim_member *m, const double *before,
                               double *row)
{
    if (m->n_jumps)
        put_left(m, before, row);
    gather(s, m, row);
    if (m->n_jumps)
        put_right(m, row);
}

/* Whether the left limit of a source is not its right one, by their bits. */
static bool jumps(const cosim_member *m, const double *before, const double *row)
{
    for (int32_t i = 0; i < m->n_jumps; ++i) {
        const double left = left_limit(m->jumps + i, before, row);
        if (memcmp(&left, row + m->jumps[i].column, sizeof left))
            return true;
    }
    return false;
}

/* Take the outputs as left limits. */
static inline void keep_outputs(const cosim_member *m, double *row)
{
    for (int32_t i = 0; i < m->n_limits; ++i)
        row[m->limits[i].to] = row[m->limits[i].from];
}

/* Take as left limits the outputs before a jump of the member, or its outputs. */
static inline void keep_limits(const cosim_member *m, double *row)
{
    if (!m->n_limits)
        return;
    const double *y = m->has_jumped && *m->has_jumped ? m->left_outputs : row + m->y;
    for (int32_t i = 0; i < m->n_limits; ++i)
        row[m->limits[i].to] = y[m->limits[i].from - m->y];
}

/* The same for many rows, each input on its own. */
static void gather_rows(cosim_stage *s, const cosim_member *m, double *rows, int64_t n_rows)
{
    const int64_t width = s->width, end = n_rows * width;
    for (int32_t i = 0; i < m->n_copies; ++i) {
        const cosim_copy c = m->copies[i];
        for (int64_t k = 0; k < end; k += width)
            rows[k + c.to] = rows[k + c.from];
    }
    if (m->n_wide | m->n_sums | *m->overridden)
        for (int64_t k = 0; k < end; k += width)
            gather_driven(s, m, rows + k);
}

/* Whether a value is infinite, or NaN that does not mean "no value yet". */
static bool is_bad(double value, bool optional)
{
    return !is_finite(value) && (!optional || value == value);
}

/* The first of some columns of a member that is bad, counted from its first input; else -1. */
static int32_t first_bad(const cosim_member *m, const double *row, int32_t begin, int32_t end)
{
    for (int32_t j = begin; j < end; ++j)
        if (is_bad(row[m->u + j], m->optional[j]))
            return j;
    return -1;
}

static bool has_bad(const cosim_member *members, int32_t count, const double *row)
{
    for (int32_t i = 0; i < count; ++i)
        if (first_bad(members + i, row, 0, members[i].n_u + members[i].n_y) >= 0)
            return true;
    return false;
}

RARE static void remember_origin(cosim_stage *s, const cosim_member *m, const double *row)
{
    if (s->origin >= 0)
        return;
    const int32_t bad = first_bad(m, row, m->n_u, m->n_u + m->n_y);
    if (bad < 0)
        return;
    s->suspicious = 1;
    s->origin = m->u + bad;
    s->origin_value = row[s->origin];
}

/* Look at outputs that were written. */
static inline void trace(cosim_stage *s, const cosim_member *m, const double *row)
{
    const double *y = row + m->y;
    for (int32_t j = 0; j < m->n_y; ++j)
        if (!is_finite(y[j])) {
            remember_origin(s, m, row);
            return;
        }
}

/* Begin to do the operations of a step, or of another sweep. */
static inline void begin_step(cosim_stage *s)
{
    s->suspicious = 0;
    s->origin = -1;
}

static double seconds(void)
{
    struct timespec now;
    timespec_get(&now, TIME_UTC);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

/* A step of a segment. */
typedef struct {
    const double *t;     /* (2) [s] */
    double *before, *row; /* of the signals at its start and at its end */
} Step;

static inline int32_t call(const cosim_stage *s, const cosim_member *m, int32_t kind,
                           const Step *step)
{
    const double *u = step->row + m->u;
    double *y = step->row + m->y;
    if (kind == COSIM_REFRESH)
        return m->outputs ? m->outputs(m->self, step->t[1], u, y) : COSIM_NO_VALUE;
    if (!m->advance)
        return COSIM_NO_VALUE;
    const double *u0 = m->takes_latest ? u : step->before + m->u;
    return m->advance(m->self, step->t[0], step->t[1], s->h, u0, u, y);
}

RARE static int32_t timed_call(const cosim_stage *s, const cosim_member *m, int32_t kind,
                               const Step *step)
{
    const double began = seconds();
    const int32_t status = call(s, m, kind, step);
    *m->seconds += seconds() - began;
    return status;
}

/* Advance or refresh a member with the inputs that are there. */
static inline int32_t evaluate(cosim_stage *s, const cosim_member *m, int32_t kind,
                               const Step *step)
{
    const int32_t status = m->seconds ? timed_call(s, m, kind, step) : call(s, m, kind, step);
    if (status == COSIM_OK) {
        trace(s, m, step->row);
        keep_limits(m, step->row);
    }
    return status;
}

/* Refresh a member for right limits, where it has taken left ones. */
RARE static int32_t refresh_right(cosim_stage *s, const cosim_member *m, const Step *step)
{
    if (!jumps(m, step->before, step->row))
        return COSIM_OK;
    gather(s, m, step->row);
    const int32_t kind = COSIM_REFRESH;
    const int32_t status = m->seconds ? timed_call(s, m, kind, step) : call(s, m, kind, step);
    if (status == COSIM_OK)
        trace(s, m, step->row);
    return status;
}

RARE static int32_t refresh(cosim_stage *s, const cosim_member *m, const Step *step)
{
    gather_left(s, m, step->before, step->row);
    return evaluate(s, m, COSIM_REFRESH, step);
}

/* Gather the inputs of members that advance together; keep what is not gathered again. */
static int32_t gather_together(cosim_stage *s, const cosim_operation *operation, const Step *step)
{
    double *row = step->row;
    for (int32_t i = 0; i < operation->count; ++i) {
        const cosim_member *m = operation->members + i;
        put_left(m, step->before, row);
        gather_sources(s, m, row);
        put_right(m, row);
        for (int32_t j = 0; j < m->n_torn; ++j)
            m->tried[j] = row[m->torn[j]];
    }
    return COSIM_OK;
}

/* What their sources gave at last. */
static int32_t record(cosim_stage *s, const cosim_operation *operation, double *row)
{
    for (int32_t i = 0; i < operation->count; ++i)
        gather_sources(s, operation->members + i, row);
    return COSIM_OK;
}

RARE static int32_t check(const cosim_operation *operation, const double *row)
{
    return has_bad(operation->members, operation->count, row) ? COSIM_NO_VALUE : COSIM_OK;
}

RARE static int32_t save(const cosim_member *m)
{
    cosim_rollback *r = m->rollback;
    if (!r)
        return COSIM_NO_VALUE;
    r->is_saved = 0;
    if (r->save) {
        if (r->save(m->self) != COSIM_OK)
            return COSIM_NO_VALUE;
    } else {
        memcpy(r->saved, r->memory, (size_t)r->count * sizeof *r->saved);
    }
    r->is_saved = 1;
    return COSIM_OK;
}

RARE static int32_t restore(const cosim_member *m)
{
    const cosim_rollback *r = m->rollback;
    if (!r || !r->is_saved)
        return COSIM_NO_VALUE;
    if (r->restore)
        return r->restore(m->self);
    memcpy(r->memory, r->saved, (size_t)r->count * sizeof *r->memory);
    return COSIM_OK;
}

/* Go on with another operation of the segment. */
static int32_t jump(cosim_stage *s, int64_t operation)
{
    s->operation = operation;
    return GO_ON;
}

/* What the sources give for the torn inputs of a member. */
static inline double *answer(cosim_stage *s, const cosim_member *m, double *row, double *w)
{
    gather_sources(s, m, row);
    for (int32_t j = 0; j < m->n_torn; ++j)
        *w++ = row[m->torn[j]];
    return w;
}

/* The guess is what the inputs have at the start of the step; with a fixed number of iterations
 * what their sources have there, which the new row has so far. */
RARE static int32_t begin(cosim_stage *s, const cosim_operation *operation, const Step *step)
{
    cosim_unknowns *unknowns = s->segments[s->segment].unknowns;
    double *v = unknowns->solver->v;
    for (int32_t i = 0; i < operation->count; ++i) {
        const cosim_member *m = operation->members + i;
        if (!m->n_torn)
            continue;
        if (unknowns->solver->iterations) {
            v = answer(s, m, step->row, v);
            continue;
        }
        for (int32_t j = 0; j < m->n_torn; ++j)
            *v++ = step->before[m->torn[j]];
    }
    unknowns->stopped = 0;
    cosim_loop_solver_begin(unknowns->solver, step->t[1]);
    return jump(s, unknowns->sweep);
}

/* The largest value of a loop in a row. */
RARE static double largest_of(const cosim_operation *operation, const double *row)
{
    double largest = 0.0;
    for (int32_t i = 0; i < operation->count; ++i) {
        const cosim_member *m = operation->members + i;
        for (int32_t j = m->u; j < m->u + m->n_u + m->n_y; ++j)
            largest = fabs(row[j]) > largest ? fabs(row[j]) : largest; /* not NaN */
    }
    return largest;
}

RARE static int32_t solve(cosim_stage *s, const cosim_operation *operation, const Step *step)
{
    cosim_unknowns *unknowns = s->segments[s->segment].unknowns;
    double *w = unknowns->w;
    for (int32_t i = 0; i < operation->count; ++i) {
        const cosim_member *m = operation->members + i;
        if (!m->n_torn)
            continue;
        w = answer(s, m, step->row, w);
        put_tried(m, step->row);
    }
    unknowns->status = cosim_loop_solver_next(unknowns->solver, unknowns->w, NAN);
    if (unknowns->status == COSIM_ASK) {
        const double largest = largest_of(operation, step->row);
        unknowns->status = cosim_loop_solver_next(unknowns->solver, unknowns->w, largest);
    }
    if (unknowns->status != COSIM_SWEEP)
        return unknowns->status == COSIM_SOLVED && !unknowns->stopped ? COSIM_OK : COSIM_NO_VALUE;
    unknowns->stopped = 0;
    begin_step(s);
    return jump(s, unknowns->restore);
}

static inline int32_t perform(cosim_stage *s, const cosim_operation *operation, const Step *step)
{
    const cosim_member *m = operation->members;
    switch (operation->kind) {
    case COSIM_ADVANCE:
        gather_left(s, m, step->before, step->row);
        return evaluate(s, m, COSIM_ADVANCE, step);
    case COSIM_KEEP:
        cosim_copy_values(step->row + m->y, step->before + m->y, m->n_y);
        keep_outputs(m, step->row);
        return COSIM_OK;
    case COSIM_GATHER:
        gather(s, m, step->row);
        return COSIM_OK;
    case COSIM_REFRESH:
        return refresh(s, m, step);
    case COSIM_RIGHT:
        return refresh_right(s, m, step);
    case COSIM_CHECK: /* inputs are sums, or copies of outputs with the same need of a value */
        return s->suspicious ? check(operation, step->row) : COSIM_OK;
    case COSIM_GATHER_TOGETHER:
        return gather_together(s, operation, step);
    case COSIM_ADVANCE_TOGETHER:
        return evaluate(s, m, COSIM_ADVANCE, step);
    case COSIM_RECORD:
        return record(s, operation, step->row);
    case COSIM_SAVE:
        return save(m);
    case COSIM_BEGIN:
        return begin(s, operation, step);
    case COSIM_RESTORE:
        return restore(m);
    default:
        return solve(s, operation, step);
    }
}

static inline Step first_step(const cosim_stage *s)
{
    double *before = s->rows + s->step * s->width;
    return (Step){s->t + s->step, before, before + s->width};
}

static inline void next_step(const cosim_stage *s, Step *step)
{
    ++step->t;
    step->before = step->row;
    step->row += s->width;
}

/* Say how far the stage is: another thread that sees it sees the rows up to there. */
static inline void show(int64_t *place, int64_t value)
{
    __atomic_store_n(place, value, __ATOMIC_RELEASE);
}

/* Do the steps of the segment up to `end`, from the cursor on; or return the number of the
 * operation that is left. */
static int64_t run_segment(cosim_stage *s, int64_t end)
{
    const cosim_segment *segment = s->segments + s->segment;
    const cosim_operation *operations = segment->operations, *behind = operations + segment->count;
    Step step = first_step(s);
    for (; s->step < end; show(&s->step, s->step + 1)) {
        const cosim_operation *operation = operations + s->operation;
        if (operation == operations)
            begin_step(s);
        while (operation < behind) {
            const int32_t status = perform(s, operation, &step);
            if (status == COSIM_OK) {
                ++operation;
            } else if (status == GO_ON) {
                operation = operations + s->operation;
            } else {
                s->operation = operation - operations;
                return segment->first + s->operation + 1;
            }
        }
        s->operation = 0;
        next_step(s, &step);
    }
    return 0;
}

/* The same for one component outside every loop, whose inputs are all known before. */
static int64_t run_cascade(cosim_stage *s, int64_t end)
{
    const cosim_segment *segment = s->segments + s->segment;
    const cosim_member *m = segment->operations->members;
    double *row = s->rows + s->step * s->width;
    if (s->operation || m->seconds || !m->advance || m->n_jumps || m->n_limits)
        return run_segment(s, end);
    begin_step(s);
    gather_rows(s, m, row + s->width, end - s->step);
    if (s->suspicious)
        return run_segment(s, end);
    for (int64_t k = s->step; k < end; ++k) {
        const double *t = s->t + k, *before = row + m->u;
        row += s->width;
        const double *u = row + m->u, *u0 = m->takes_latest ? u : before;
        show(&s->step, k);
        const int32_t status = m->advance(m->self, t[0], t[1], s->h, u0, u, row + m->y);
        if (status != COSIM_OK)
            return segment->first + 1;
        for (int32_t j = 0; j < m->n_y; ++j)
            if (!is_finite(row[m->y + j])) {
                remember_origin(s, m, row);
                s->operation = 1;
                return run_segment(s, end);
            }
    }
    return 0;
}

static void next_segment(cosim_stage *s)
{
    s->step = s->completed;
    s->operation = 0;
    show(&s->segment, s->segment + 1); /* last: of a segment `step` is its own */
}

/* Go past the operation that the caller has done. */
static void pass(cosim_stage *s)
{
    const cosim_segment *segment = s->segments + s->segment;
    const cosim_operation *operation = segment->operations + s->operation;
    if (operation->kind == COSIM_ADVANCE || operation->kind == COSIM_ADVANCE_TOGETHER
        || operation->kind == COSIM_REFRESH || operation->kind == COSIM_RIGHT)
        trace(s, operation->members, s->rows + (s->step + 1) * s->width);
    ++s->operation;
}

int64_t cosim_stage_run(cosim_stage *s, int64_t end, int32_t answer)
{
    if (answer == COSIM_DONE)
        pass(s);
    else if (answer == COSIM_OVER)
        next_segment(s);
    while (s->completed < end) {
        const int64_t last = s->completed + s->tile < end ? s->completed + s->tile : end;
        for (; s->segment < s->n_segments; next_segment(s)) {
            const int64_t left = s->segments[s->segment].cascade ? run_cascade(s, last)
                                                                 : run_segment(s, last);
            if (left)
                return left;
        }
        s->step = last;
        show(&s->completed, last);
        show(&s->segment, 0);
    }
    return 0;
}

void cosim_accumulate(int64_t n_rows, int64_t width, const double *rows, double *counts,
                      double *sums, double *squares)
{
    for (int64_t k = 0; k < n_rows; ++k) {
        const double *row = rows + k * width;
        for (int64_t j = 0; j < width; ++j) {
            const bool has_value = row[j] == row[j];
            const double value = has_value ? row[j] : 0.0;
            counts[j] += has_value;
            sums[j] += value;
            squares[j] += value * value;
        }
    }
}

int32_t cosim_held_step(void *self, double t0, double t1, double h, const double *u0,
                        const double *u1, double *y)
{
    const cosim_held *s = self;
    for (int32_t i = 0; i < s->n_u; ++i)
        s->u[i] = s->held[i] ? u0[i] : u1[i];
    const int32_t status = s->step(s->self, t0, t1, h, u0, s->u, y);
    return status == COSIM_OK ? s->outputs(s->self, t1, u1, y) : status;
}

int32_t cosim_held_outputs(void *self, double t, const double *u, double *y)
{
    const cosim_held *s = self;
    return s->outputs(s->self, t, u, y);
}
