/* An instance of the FMU, whatever the version of the standard: variables, modes, time,
 * initialization, steps, derivatives, copies of the state.
 *
 * Everything that changes stands in one flat array of doubles, so that copying the state is one
 * memcpy. Nothing is allocated after instance_new; there are no variables outside the instance.
 * Functions return NULL, or an error message. */
#ifndef INSTANCE_H
#define INSTANCE_H

#include "model.h"

#if defined __GNUC__ && !defined _WIN32
#pragma GCC visibility push(hidden)
#endif

enum {
    INSTANTIATED = 1,
    INITIALIZATION = 2,
    EVENT = 4,
    CONTINUOUS = 8,
    STEP = 16,
    INTERMEDIATE = 32,
    TERMINATED = 64
};
#define RUNNING (EVENT | CONTINUOUS | STEP)
#define READABLE (INITIALIZATION | RUNNING | TERMINATED)
#define ANY (INSTANTIATED | READABLE)

typedef struct {
    int stale;   /* what is not that of the memory and the inputs */
    size_t size; /* of everything that changes: values[0 .. size-1] */
    double *values, *stamp, *mode, *time, *x0, *u, *memory;
    double *slope;      /* (m) du/dt in the next step; FMI 2 */
    double *z;          /* (n_z) algebraic variables */
    double *z_is_set;   /* whether the importer set them; else they are calculated */
    double *y, *dx, *r; /* computed; r (n_z): the residual */
    double *previous_u; /* (m) inputs at the start of a step */
    double *work;
    char message[160];
} instance;

instance *instance_new(void);
void instance_free(instance *i);
void instance_reset(instance *i);

int instance_is_in(const instance *i, int modes);
void instance_enter(instance *i, int mode);

const char *instance_set(instance *i, const uint32_t references[], size_t n, const double values[],
                         size_t n_values);
const char *instance_get(instance *i, const uint32_t references[], size_t n, double values[],
                         size_t n_values);
const char *instance_set_states(instance *i, const double x[], size_t n);
const char *instance_get_states(instance *i, double x[], size_t n);
const char *instance_get_derivatives(instance *i, double dx[], size_t n);
const char *instance_get_nominals(const instance *i, double nominals[], size_t n);
void instance_set_time(instance *i, double t);
void instance_initialize(instance *i);

/* One step: begin, then move the inputs to their end, then end. */
const char *instance_begin_step(instance *i, double t, double h);
const char *instance_end_step(instance *i, double t, double h);
const char *instance_set_slope(instance *i, uint32_t reference, double slope);
void instance_move_inputs(instance *i, double h);

/* sensitivity = J seed, or its adjoint, J' seed, for J = d(unknowns)/d(knowns). */
const char *instance_derivative(instance *i, int adjoint, const uint32_t unknowns[],
                                size_t n_unknowns, const uint32_t knowns[], size_t n_knowns,
                                const double seed[], size_t n_seed, double sensitivity[],
                                size_t n_sensitivity);

/* A copy is instance_copy_size bytes long; *copy NULL: new memory, to be freed with free. */
size_t instance_copy_size(const instance *i);
const char *instance_copy(const instance *i, void **copy);
const char *instance_restore(instance *i, const void *copy);
const char *instance_write(const instance *i, const void *copy, void *bytes, size_t size);
const char *instance_read(const instance *i, const void *bytes, size_t size, void **copy);

#if defined __GNUC__ && !defined _WIN32
#pragma GCC visibility pop
#endif

#endif
