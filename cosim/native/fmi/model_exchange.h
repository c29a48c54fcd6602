/* A loaded FMU for model exchange with an explicit Runge-Kutta method, in compiled steps.
 *
 * What happens in a communication step is described and done in integrator.py; this is the same,
 * call for call and bit for bit. What is declined stands here as far as it was done, and the caller
 * goes on from there: what fails, the end of the run, changed nominal values, a first FMU state. */
#ifndef COSIM_MODEL_EXCHANGE_H
#define COSIM_MODEL_EXCHANGE_H

#include "runge_kutta.h"
#include "fmu.h"

/* Kinds of events, as bits: those due at one time. */
#define COSIM_STATE_EVENT 1
#define COSIM_STEP_EVENT 2
#define COSIM_TIME_EVENT 4
#define COSIM_INPUT_EVENT 8
#define COSIM_NOT_LISTED 16 /* no event: how many of a step are left out of the list */

/* How far a step has come that was declined. */
enum { COSIM_AT_BEGIN, COSIM_INTEGRATING, COSIM_AT_END };

/* What ended it, if it is to end the run. */
enum {
    COSIM_NO_FAILURE,
    COSIM_FAILED_CALL,    /* the FMU knows which */
    COSIM_FAILED_SOLVER,  /* its tolerance needs too small a step */
    COSIM_FAILED_INPUTS,  /* the inputs of an event are no values of their types */
    COSIM_ENDLESS_UPDATE, /* an event iteration that does not converge */
    COSIM_EVENT_IS_OVER   /* the next time event is announced in the past */
};

typedef struct {
    double t;
    int32_t kind, count; /* count: of what is not listed */
} cosim_event;

typedef struct {
    cosim_fmu *fmu;
    cosim_runge_kutta *solver; /* NULL: there are no continuous states */
    /* calls; NULL where there is none, or none is needed */
    cosim_fmu_call *set_time, *set_states, *get_states, *get_derivatives, *get_indicators;
    cosim_fmu_call *completed_step, *enter_event_mode, *update, *enter_continuous_time_mode;
    cosim_fmu_call *get_state, *set_state;
    cosim_fmu_variables input_variables, continuous_variables, output_variables;
    int32_t n_x, n_z, n_u, n_in_events;
    int32_t parts;       /* of a step of the solver as its tolerance allows, after each of which the
                            indicators are read */
    double longest_step; /* of the solver [s] */
    const int32_t *in_events; /* (n_in_events) the inputs that change in events only */

    /* written by the caller before steps */
    int32_t allowed;     /* 0: every call is declined */
    int32_t rolls_back;  /* an event is undone after the outputs behind it were read */
    void **fmu_state;    /* memory to copy the FMU state to; NULL: there is none yet */

    /* the state */
    int32_t moved;            /* it has changed since the caller wrote it */
    int32_t due;              /* events at t that were not handled yet */
    int32_t ended;            /* the FMU requested the end of the run */
    int32_t nominals_changed; /* they are to be read, and the solver is to start with them */
    double t, next_event;
    double inputs_time; /* the time whose inputs of this step the FMU has; NaN: it has others */
    double *x;                   /* (n_x) that of the solver, but where an event is due */
    double *inputs, *indicators; /* (n_u) as the FMU has them, (n_z) */
    const double *nominals;      /* (n_x) */

    /* of a step that was declined */
    int32_t reached, failure;
    int32_t handled; /* events in it that did not advance time, as Standstill counts them ... */
    double since;    /* ... since this time */

    /* events that the caller has not listed yet */
    cosim_event *events;
    int32_t n_events, room;
    int32_t in_step; /* how many came since a communication step began */
    double latest;   /* time of the last one */
    double first;    /* time of the first one; infinity: there was none */

    /* the inputs of the step, by linear interpolation */
    double t0, t1;
    const double *u0, *u1; /* (n_u) */
    double *end_inputs;    /* (n_u) u1, where some inputs change in events only */
    double *u, *scratch;   /* (n_u), (2 n_x + n_u + 4 n_z) */

    /* outputs at the end of a step before an event that is due there; NULL: nobody asks for them */
    double *left;      /* (n_y) */
    int32_t has_left;  /* of the last step */
} cosim_model_exchange;

int32_t cosim_model_exchange_step(void *self, double t0, double t1, double h, const double *u0,
                                  const double *u1, double *y);
int32_t cosim_model_exchange_outputs(void *self, double t, const double *u, double *y);
/* The right-hand side of the solver: the model is a cosim_model_exchange. */
int32_t cosim_model_exchange_derivatives(void *model, double t, const double *x, double *dx);

#endif
