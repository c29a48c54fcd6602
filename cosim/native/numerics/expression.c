#include "expression.h"
#include "operations.h"

#include <stddef.h>
#include <string.h>

/* How many instants of the run before are looked through for one: a state event has others. */
#define INSTANTS_AHEAD 4
/* After so many in vain this run has other instants, which take the place of those. */
#define MOST_MISSES 16

static double compute(const cosim_program *program, double t, const double *row)
{
    double stack[COSIM_STACK];
    int32_t top = -1;
    for (int32_t i = 0; i < program->length; ++i) {
        const int32_t code = program->code[i];
        if (code < 0)
            stack[++top] = row[-1 - code];
        else if (code >= OPERATIONS)
            stack[++top] = program->constants[code - OPERATIONS];
        else if (code == T)
            stack[++top] = t;
        else if (code < NEGATE) {
            stack[top - 1] = cosim_binary(code, stack[top - 1], stack[top]);
            --top;
        } else
            stack[top] = cosim_unary(code, stack[top]);
    }
    return stack[0];
}

/* The instants have to agree in their bits: sin(-0.0) is not sin(0.0). */
static double look_up(const cosim_program *program, double t)
{
    cosim_program_cache *cache = program->cache;
    int64_t end = cache->next + INSTANTS_AHEAD;
    if (end > cache->count)
        end = cache->count;
    for (int64_t k = cache->next; k < end; ++k)
        if (memcmp(cache->t + k, &t, sizeof t) == 0) {
            cache->next = k + 1;
            cache->misses = 0;
            return cache->values[k];
        }
    const double value = compute(program, t, NULL);
    if (++cache->misses > MOST_MISSES)
        cache->count = cache->next;
    if (cache->next == cache->count && cache->count < cache->room) {
        cache->t[cache->count] = t;
        cache->values[cache->count] = value;
        cache->next = ++cache->count;
    }
    return value;
}

double cosim_evaluate(const cosim_program *program, double t)
{
    return cosim_evaluate_row(program, t, NULL);
}

double cosim_evaluate_row(const cosim_program *program, double t, const double *row)
{
    return program->cache == NULL ? compute(program, t, row) : look_up(program, t);
}

void cosim_evaluate_rows(const cosim_program *program, int64_t count, const double *t,
                         const double *rows, int64_t stride, double *values)
{
    for (int64_t k = 0; k < count; ++k)
        values[k] = cosim_evaluate_row(program, t[k], rows + k * stride);
}

int32_t cosim_expression_step(void *self, double t0, double t1, double h, const double *u0,
                              const double *u1, double *y)
{
    (void)t0, (void)h, (void)u0;
    const cosim_expression *s = self;
    for (int32_t i = 0; i < s->count; ++i)
        y[i] = cosim_evaluate_row(&s->programs[i], t1, u1);
    return COSIM_OK;
}
