/* A unit apart from the version of the standard: variables, modes, time, start, step, derivatives, copies of the state.
 *
 * Everything that changes stands in one flat array of doubles, so that copying the state is one memcpy. Nothing is allocated
 * after unit_new; there are no variables outside the instance. Functions answer NULL, or what is wrong. */
#ifndef UNIT_H
#define UNIT_H

#include "model.h"

#if defined __GNUC__ && !defined _WIN32
#pragma GCC visibility push(hidden)
#endif

enum { INSTANTIATED = 1, INITIALIZATION = 2, EVENT = 4, CONTINUOUS = 8, STEP = 16, INTERMEDIATE = 32, TERMINATED = 64 };
#define RUNNING (EVENT | CONTINUOUS | STEP)
#define READABLE (INITIALIZATION | RUNNING | TERMINATED)
#define ANY (INSTANTIATED | READABLE)

typedef struct {
    int stale;   /* outputs and derivatives are not those of the memory and the inputs */
    size_t size; /* of everything that changes: values[0 .. size-1] */
    double *values, *stamp, *mode, *time, *x0, *u, *memory;
    double *slope;       /* (m) du/dt in the next step; FMI 2 */
    double *is_given, *z; /* (n_z) algebraic variables; whether the importer gave them, else they are calculated */
    double *y, *dx, *r;  /* computed; r (n_z): the residual */
    double *before;      /* (m) inputs at the start of a step */
    double *work;
    char message[160];
} unit;

unit *unit_new(void);
void unit_free(unit *i);
void unit_reset(unit *i);

int unit_is_in(const unit *i, int modes);
void unit_to(unit *i, int mode);

const char *unit_set(unit *i, const uint32_t references[], size_t n, const double values[], size_t n_values);
const char *unit_get(unit *i, const uint32_t references[], size_t n, double values[], size_t n_values);
const char *unit_set_states(unit *i, const double x[], size_t n);
const char *unit_get_states(unit *i, double x[], size_t n);
const char *unit_get_derivatives(unit *i, double dx[], size_t n);
const char *unit_get_nominals(const unit *i, double nominals[], size_t n);
void unit_set_time(unit *i, double t);
void unit_end_start(unit *i);

/* One step: begin, then move the inputs to their end, then end. */
const char *unit_begin_step(unit *i, double t, double h);
const char *unit_end_step(unit *i, double t, double h);
const char *unit_set_slope(unit *i, uint32_t reference, double slope);
void unit_move_inputs(unit *i, double h);

/* sensitivity = J seed, or its adjoint, J' seed, for J = d(unknowns)/d(knowns). */
const char *unit_derivative(unit *i, int adjoint, const uint32_t unknowns[], size_t n_unknowns, const uint32_t knowns[],
                            size_t n_knowns, const double seed[], size_t n_seed, double sensitivity[], size_t n_sensitivity);

/* A copy is unit_copy_size bytes long; *copy NULL: new memory, to be freed with free. */
size_t unit_copy_size(const unit *i);
const char *unit_copy(const unit *i, void **copy);
const char *unit_restore(unit *i, const void *copy);
const char *unit_write(const unit *i, const void *copy, void *bytes, size_t size);
const char *unit_read(const unit *i, const void *bytes, size_t size, void **copy);

#if defined __GNUC__ && !defined _WIN32
#pragma GCC visibility pop
#endif

#endif
