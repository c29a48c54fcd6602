/* A communication step of a co-simulation FMU: the usual one of stepping.py, in one part.
 *
 * What is not usual is left to the methods in Python: an event, a discarded step, an early return,
 * a failure, the end. `note` says what is done already. */
#ifndef COSIM_CO_SIMULATION_H
#define COSIM_CO_SIMULATION_H

#include "cosim.h"
#include "fmu.h"
#include "inner_step.h"

/* What a step did that was left to the methods: */
#define COSIM_NOTHING 0
#define COSIM_STEPPED 1       /* do_step was called, and `do_step.status` returned */
#define COSIM_UNREAD 2        /* all but reading the outputs */
#define COSIM_COMPLETED 3     /* all but the outputs for the inputs at the end */
#define COSIM_FAILED 4        /* a call failed, which the FMU remembers */
#define COSIM_SLOPES_FAILED 5 /* that call was one for the slopes of inputs */

/* A copy of the state of a component. */
typedef struct {
    cosim_fmu_call *get, *set; /* GetFMUState, SetFMUState */
    void **fmu_state;          /* where the FMU's own is copied to; allocated */
    /* as in the component: outputs, inputs, event_inputs; outputs, inputs and outputs_before of
     * inner_step */
    double *values;
    int32_t interpolates, stepped, ended;
    double next_event;
    double inner_steps;
    cosim_inner_step inner_step;
    /* what was said up to the copy is said; what comes behind it is not, where the FMU goes back */
    cosim_messages_mark messages;
    int32_t has_warned; /* do_step had */
    int32_t watches;    /* `inner_step` is a copy; else nothing was watched */
} cosim_co_simulation_copy;

typedef struct {
    /* what every step reads, first */
    cosim_fmu *fmu; /* NULL: all is left to the methods */
    /* no inputs in events, no saved state, no D; inputs and outputs are Float64 in order */
    int32_t plain;
    int32_t initialized, interpolates, stepped, ended;
    int32_t n_u, n_y, n_event;
    int32_t note; /* of the last step: what it did before it was left to the methods */
    double next_event;  /* infinity: none */
    double first_event; /* inside the last step; infinity: none, as in every compiled one */
    cosim_fmu_call *get_state; /* NULL: no state is saved before a step */
    const uint8_t *held;       /* (n_u) keeps its value over a step */
    const uint8_t *latest;     /* (n_u) has the value at the end over a step, where it has one */
    /* the state: as in StepperState; one array behind the other */
    double *outputs, *inputs, *event_inputs;
    cosim_inner_step *inner_step;
    double inner_steps; /* the inner step that was detected, in communication steps */
    cosim_fmu_directional feedthrough; /* D; n_unknowns 0: not known */
    cosim_fmu_variables step_inputs, outputs_read;
    cosim_fmu_step do_step;
    cosim_fmu_slopes slopes;           /* of inputs that are interpolated */
    void **fmu_state;                  /* where it is saved; NULL: there is no memory for it yet */
    const intptr_t *unknowns, *knowns; /* columns of the outputs and inputs of D */
    const uint8_t *ramped; /* (n_u) has its value, not its mean, where slopes are set */
    const intptr_t *event_columns; /* (n_event) inputs that are set in events */
    double *scratch;               /* (4 n_u + n_y) */
    cosim_co_simulation_copy *copy;
    int32_t has_left; /* outputs had other values before an event at the end: never here */
} cosim_co_simulation;

/* A cosim_step and a cosim_outputs. */
int32_t cosim_co_simulation_step(void *self, double t0, double t1, double h, const double *u0,
                                 const double *u1, double *y);
int32_t cosim_co_simulation_outputs(void *self, double t, const double *u, double *y);

/* Copy the state, which an FMU that is still in its initialization declines; put the copy back. */
int32_t cosim_co_simulation_save(void *self);
int32_t cosim_co_simulation_restore(void *self);

#endif
