/* What instance.c needs of a model. The numbers are in the generated model.c; the functions in
 * continuous.c, for a linear model that is continuous in time, or in discrete.c, for one that
 * changes at communication points only. Nothing here changes during a run, so that all instances
 * share it; what changes is the `memory` of an instance.
 *
 * Value references number the elements: inputs, outputs, derivatives, states, the time, then
 * residuals. In FMI 3 a variable may be an array: it has the reference of its first element. */
#ifndef MODEL_H
#define MODEL_H

#include <stddef.h>
#include <stdint.h>

/* Hidden, so that two of these libraries in one process never see each other's constants. */
#if defined __GNUC__ && !defined _WIN32
#pragma GCC visibility push(hidden)
#endif

#include "kernels.h" /* written for the model, too: the headers of the steps that it needs */

extern const char *const model_token;           /* GUID or instantiation token */
extern const double model_stamp;                /* of copied states: whose they are */
extern const int32_t model_n, model_m, model_p; /* states, inputs, outputs: their elements */
/* elements of the variable with this reference; 0: none has it */
extern const int32_t model_size[];
extern const int32_t model_is_exact[]; /* (n) the start value of this state may be set */
extern const int32_t model_state_of[]; /* (p) the state that this output is, or -1 */
extern const double model_X0[];        /* (n) start values of the states; those of inputs are 0 */
extern const double model_step;        /* the only communication step [s]; 0: any */
/* it may be exchanged as a model; else co-simulation only */
extern const int32_t model_has_derivatives;
extern const int32_t model_memory; /* doubles of it; the first n are the states */
extern const int32_t model_work;   /* doubles of scratch that steps may use and keep */

typedef enum { MODEL_OUTPUT, MODEL_DERIVATIVE, MODEL_STATE, MODEL_RESIDUAL } model_unknown;
typedef enum { MODEL_BY_INPUT, MODEL_BY_STATE, MODEL_BY_ALGEBRAIC } model_known;

/* Initialize at t with the inputs u; x0: start values of the states. */
void model_initialize(double *memory, const double *x0, double t, const double *u);
/* Outputs y, and derivatives dx, at t, the time reached, for the inputs u. */
void model_outputs(double *memory, double t, const double *u, double *y);
void model_derivatives(const double *memory, double t, const double *u, double *dx);
/* Advance from t0 to t1, h seconds apart, with inputs u0 at t0 and u1 at t1; outputs y at t1. NULL,
 * or an error message. */
const char *model_advance(double *memory, double *work, double t0, double t1, double h,
                          const double *u0, const double *u1, double *y);
/* d(unknown)/d(input or state) at the time reached; in_initialization: while the initial states
 * still follow the inputs. */
double model_by_input(double *memory, double *work, double t, const double *u, model_unknown of,
                      int32_t row, int32_t input, int in_initialization);
double model_by_state(model_unknown of, int32_t row, int32_t state);

/* A model some of whose outputs are algebraic variables z, which the importer may set: then all
 * else follows from x, z and u, and the residual is zero where z is the z that the model
 * calculates. */
typedef struct {
    int32_t n_z;              /* elements of z, and of the residual */
    const int32_t *of_output; /* (p) the algebraic variable that this output is, or -1 */
    void (*outputs)(const double *x, const double *z, const double *u, double *dx, double *y);
    void (*residual)(const double *x, const double *z, const double *u, double *r);
    /* with all other knowns constant */
    double (*partial)(model_unknown of, int32_t row, model_known by, int32_t column);
} residual_form;

extern const residual_form *const model_residual_form; /* NULL: it has no algebraic variables */

#if defined __GNUC__ && !defined _WIN32
#pragma GCC visibility pop
#endif

#endif
