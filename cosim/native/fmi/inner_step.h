/* Whether an FMU ignores the communication step and keeps one of its own: see inner_step.py. */
#ifndef COSIM_INNER_STEP_H
#define COSIM_INNER_STEP_H

#include <stdint.h>

enum { COSIM_UNEVEN = 32 };

typedef struct {
    const intptr_t *columns; /* (n) of the outputs that are watched */
    int32_t n, n_u;
    int32_t watches; /* 0: there is nothing to watch, or it is decided */
    int32_t begun;   /* `outputs` and `inputs` are those of a step */
    int32_t changed; /* `outputs_before` is known */
    int32_t is_shared; /* inputs of its loop changed too: another may keep the step */
    int64_t steps, input_changes, outside_changes, period, repeats;
    int64_t uneven;                 /* intervals in a row that n h follows */
    int64_t ends[COSIM_UNEVEN + 1]; /* their ends */
    double least, most;             /* what n may be by these */
    const uint8_t *in_loop; /* (n_u) which inputs change by what the component does itself */
    double *outputs, *inputs, *outputs_before; /* (n), (n_u), (n) */
} cosim_inner_step;

/* Watch the outputs and inputs of one more step: n, once, where the outputs change at every n-th
 * step only, on average; else 0. */
double cosim_inner_step_observe(cosim_inner_step *self, const double *outputs,
                                 const double *inputs);

#endif
