#include "wrapping.h"

#include <string.h>

/* --- outputs that stay --- */

int32_t cosim_kept_step(void *self, double t0, double t1, double h, const double *u0,
                        const double *u1, double *y)
{
    const cosim_kept *s = self;
    const int32_t status = s->inner.step(s->inner.self, t0, t1, h, u0, u1, y);
    if (status == COSIM_OK)
        memcpy(s->last, y, (size_t)s->width * sizeof *y);
    return status;
}

int32_t cosim_kept_outputs(void *self, double t, const double *u, double *y)
{
    (void)t, (void)u;
    const cosim_kept *s = self;
    memcpy(y, s->last, (size_t)s->width * sizeof *y);
    return COSIM_OK;
}

/* --- larger steps --- */

int32_t cosim_sampled_step(void *self, double t0, double t1, double h, const double *u0,
                           const double *u1, double *y)
{
    (void)h;
    const cosim_sampled *s = self;
    const size_t width = (size_t)s->n_y * sizeof *y;
    double *taken = s->memory, *begin = taken + 1, *u_begin = begin + 1, *held = u_begin + s->n_u;
    if (*taken < 0.0) { /* before its first step */
        if (*taken == -1.0) {
            const int32_t status = cosim_inner_outputs(&s->inner, t1, u1, y);
            if (status != COSIM_OK)
                return status;
            memcpy(held, y, width);
        }
        *taken += 1.0;
        memcpy(y, held, width);
        return COSIM_OK;
    }
    if (*taken == 0.0) {
        /* also those of a step of its own that ends at once: they may decline */
        const int32_t status = cosim_inner_outputs(&s->inner, t0, u0, y);
        if (status != COSIM_OK)
            return status;
        memcpy(held, y, width);
        memcpy(u_begin, u0, (size_t)s->n_u * sizeof *u0);
        *begin = t0;
    }
    if (*taken + 1.0 < s->steps) {
        *taken += 1.0;
        memcpy(y, held, width);
        return COSIM_OK;
    }
    const int32_t status = s->inner.step(s->inner.self, *begin, t1, s->h, u_begin, u1, y);
    if (status != COSIM_OK)
        return status;
    memcpy(held, y, width);
    *taken = 0.0;
    return COSIM_OK;
}

int32_t cosim_sampled_outputs(void *self, double t, const double *u, double *y)
{
    const cosim_sampled *s = self;
    if (s->memory[0] == 0.0)
        return cosim_inner_outputs(&s->inner, t, u, y);
    memcpy(y, s->memory + 2 + s->n_u, (size_t)s->n_y * sizeof *y);
    return COSIM_OK;
}

int32_t cosim_decimated_step(void *self, double t0, double t1, double h, const double *u0,
                             const double *u1, double *y)
{
    const cosim_decimated *s = self;
    const size_t width = (size_t)s->n_y * sizeof *y;
    double *taken = s->memory, *held = taken + 1, *first = held + s->n_y;
    if (*taken == 0.0) {
        const int32_t status = cosim_inner_outputs(&s->inner, t0, u0, first);
        if (status != COSIM_OK)
            return status;
    }
    const int32_t status = s->inner.step(s->inner.self, t0, t1, h, u0, u1, y);
    if (status != COSIM_OK)
        return status;
    if (*taken == 0.0)
        memcpy(held, first, width);
    *taken = *taken + 1.0 < s->steps ? *taken + 1.0 : 0.0;
    if (*taken == 0.0)
        memcpy(held, y, width);
    memcpy(y, held, width);
    return COSIM_OK;
}

int32_t cosim_decimated_outputs(void *self, double t, const double *u, double *y)
{
    const cosim_decimated *s = self;
    if (s->memory[0] == 0.0)
        return cosim_inner_outputs(&s->inner, t, u, y);
    memcpy(y, s->memory + 1, (size_t)s->n_y * sizeof *y);
    return COSIM_OK;
}

/* --- other ports --- */

static void pick(const cosim_element *elements, int32_t count, const double *from, double *to)
{
    for (int32_t i = 0; i < count; ++i) {
        const cosim_element *e = elements + i;
        const double value = from[e->from];
        to[i] = e->converts ? (value * e->factor1 + e->offset1 - e->offset2) / e->factor2 : value;
    }
}

int32_t cosim_ports_step(void *self, double t0, double t1, double h, const double *u0,
                         const double *u1, double *y)
{
    const cosim_ports *s = self;
    double *own_u0 = s->work, *own_u1 = own_u0 + s->n_u, *own_y = own_u1 + s->n_u;
    pick(s->inputs, s->n_u, u0, own_u0);
    pick(s->inputs, s->n_u, u1, own_u1);
    const int32_t status = s->inner.step(s->inner.self, t0, t1, h, own_u0, own_u1, own_y);
    if (status == COSIM_OK)
        pick(s->outputs, s->n_y, own_y, y);
    return status;
}

int32_t cosim_ports_outputs(void *self, double t, const double *u, double *y)
{
    const cosim_ports *s = self;
    double *own_u = s->work, *own_y = own_u + 2 * s->n_u;
    pick(s->inputs, s->n_u, u, own_u);
    const int32_t status = cosim_inner_outputs(&s->inner, t, own_u, own_y);
    if (status == COSIM_OK)
        pick(s->outputs, s->n_y, own_y, y);
    return status;
}

/* --- components side by side --- */

static void gather(const cosim_part *part, const double *from, double *to)
{
    for (int32_t i = 0; i < part->n_u; ++i)
        to[i] = from[part->columns[i]];
}

int32_t cosim_parts_step(void *self, double t0, double t1, double h, const double *u0,
                         const double *u1, double *y)
{
    const cosim_parts *s = self;
    for (int32_t k = 0; k < s->count; ++k) {
        const cosim_part *part = s->parts + k;
        double *own_u0 = part->u, *own_u1 = own_u0 + part->n_u;
        gather(part, u0, own_u0);
        gather(part, u1, own_u1);
        const int32_t status =
            part->inner.step(part->inner.self, t0, t1, h, own_u0, own_u1, y);
        if (status != COSIM_OK)
            return status;
        y += part->n_y;
    }
    return COSIM_OK;
}

int32_t cosim_parts_outputs(void *self, double t, const double *u, double *y)
{
    const cosim_parts *s = self;
    for (int32_t k = 0; k < s->count; ++k) {
        const cosim_part *part = s->parts + k;
        gather(part, u, part->u);
        const int32_t status = cosim_inner_outputs(&part->inner, t, part->u, y);
        if (status != COSIM_OK)
            return status;
        y += part->n_y;
    }
    return COSIM_OK;
}
