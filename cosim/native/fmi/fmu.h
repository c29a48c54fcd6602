/* A loaded FMU, called by address: what its methods in Python do, for steps in compiled code.
 *
 * Values are float64 vectors; the FMU carries them by type. A call that fails is remembered, so
 * that the methods in Python can name it; none is made where values do not fit the types. */
#ifndef COSIM_FMU_H
#define COSIM_FMU_H

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "callbacks.h"

/* Statuses beside those of cosim.h. */
#define COSIM_DECLINED 20    /* nothing was called: it is left to the methods in Python */
#define COSIM_CALL_FAILED 21 /* `failed` and `status` of the FMU say which call, and how */

/* Statuses of FMI that a call may return. */
#define COSIM_FMI_OK 0
#define COSIM_FMI_WARNING 1

/* A function of one instance. */
typedef struct {
    void (*function)(void);
    int32_t warned;      /* 1: it returned a warning, which was not fetched yet; 2: fetched */
    int32_t has_message; /* what the FMU logged last before its first warning */
    double time;         /* of the first warning [s] */
    cosim_message message;
} cosim_fmu_call;

/* One instance. */
typedef struct {
    void *instance;    /* NULL: there is none any more */
    int32_t version;   /* of FMI: 1, 2 or 3 */
    int32_t forbidden; /* no call is allowed any more */
    int32_t may_go_back; /* the negation of noSetFMUStatePriorToCurrentPoint */
    cosim_messages *messages;
    const cosim_fmu_call *failed; /* NULL: none */
    int32_t status;               /* what that returned */
} cosim_fmu;

/* How the FMU carries a value. */
#define COSIM_FLOAT64 0
#define COSIM_FLOAT32 1
#define COSIM_INT8 2
#define COSIM_UINT8 3
#define COSIM_INT16 4
#define COSIM_UINT16 5
#define COSIM_INT32 6
#define COSIM_UINT32 7
#define COSIM_INT64 8
#define COSIM_UINT64 9
#define COSIM_BOOL 10

/* Variables of one type. */
typedef struct {
    cosim_fmu_call *get, *set;
    const uint32_t *references;
    size_t count, size;      /* of references, of elements */
    const intptr_t *columns; /* (size) of the vector; NULL: those from `first` on, in order */
    intptr_t first;
    int32_t carrier, boolean; /* boolean: only 0 and 1 can be set */
    void *values;             /* (size) of the carrier: scratch; Float64 in order needs none */
} cosim_fmu_group;

/* Variables that are set or read together: elements of one vector. */
typedef struct {
    const cosim_fmu_group *groups;
    int64_t count;
    /* what a call needs where there is one group of Float64 in order: a copy, as what a step reads
     * should be close together; NULL: there are others */
    void (*get)(void), (*set)(void);
    const uint32_t *references;
    size_t n_references, size;
    intptr_t first;
} cosim_fmu_variables;

/* Whether calls are allowed. */
static inline bool cosim_fmu_is_open(const cosim_fmu *fmu)
{
    return fmu->instance && !fmu->forbidden;
}

/* Remember the first warning of a function. */
void cosim_fmu_record_warning(const cosim_fmu *fmu, cosim_fmu_call *call);

/* Check what a call returned: COSIM_OK for ok and warning, else COSIM_CALL_FAILED. */
int32_t cosim_fmu_check_other(cosim_fmu *fmu, cosim_fmu_call *call, int32_t status);
static inline int32_t cosim_fmu_check(cosim_fmu *fmu, cosim_fmu_call *call, int32_t status)
{
    return status == COSIM_FMI_OK ? 0 : cosim_fmu_check_other(fmu, call, status);
}

typedef int (*cosim_fmu_values_2)(void *instance, const uint32_t *references, size_t n,
                                  void *values);
typedef int (*cosim_fmu_values_3)(void *instance, const uint32_t *references, size_t n,
                                  void *values, size_t n_values);

/* Set variables from a vector; COSIM_DECLINED where a value is none of its type. */
int32_t cosim_fmu_set_any(cosim_fmu *fmu, const cosim_fmu_variables *variables,
                          const double *vector);
/* Read variables into a vector; COSIM_DECLINED where an integer does not fit a float64: then they
 * were read, and may be read again. */
int32_t cosim_fmu_get_any(cosim_fmu *fmu, const cosim_fmu_variables *variables, double *vector);

/* The same, quick for what is usual; `version` is that of the FMU, a constant where it is known. */
static inline int cosim_fmu_access(const cosim_fmu *fmu, int32_t version, void (*function)(void),
                                   const cosim_fmu_variables *variables, void *values)
{
    if (version == 3)
        return ((cosim_fmu_values_3)function)(fmu->instance, variables->references,
                                              variables->n_references, values, variables->size);
    return ((cosim_fmu_values_2)function)(fmu->instance, variables->references,
                                          variables->n_references, values);
}

static inline int32_t cosim_fmu_set_direct(cosim_fmu *fmu, int32_t version,
                                           const cosim_fmu_variables *variables,
                                           const double *vector)
{
    /* functions of FMI that set take const values */
    double *values = (double *)vector + variables->first;
    const int status = cosim_fmu_access(fmu, version, variables->set, variables, values);
    return status == COSIM_FMI_OK ? 0
                                  : cosim_fmu_check_other(fmu, variables->groups->set, status);
}

static inline int32_t cosim_fmu_get_direct(cosim_fmu *fmu, int32_t version,
                                           const cosim_fmu_variables *variables, double *vector)
{
    double *values = vector + variables->first;
    const int status = cosim_fmu_access(fmu, version, variables->get, variables, values);
    return status == COSIM_FMI_OK ? 0
                                  : cosim_fmu_check_other(fmu, variables->groups->get, status);
}

static inline int32_t cosim_fmu_set(cosim_fmu *fmu, const cosim_fmu_variables *variables,
                                    const double *vector)
{
    return variables->set ? cosim_fmu_set_direct(fmu, fmu->version, variables, vector)
                          : cosim_fmu_set_any(fmu, variables, vector);
}

static inline int32_t cosim_fmu_get(cosim_fmu *fmu, const cosim_fmu_variables *variables,
                                    double *vector)
{
    return variables->get ? cosim_fmu_get_direct(fmu, fmu->version, variables, vector)
                          : cosim_fmu_get_any(fmu, variables, vector);
}

/* Write d(unknowns)/d(knowns) . seed, of Float64 variables. */
typedef struct {
    cosim_fmu_call *call;
    const uint32_t *unknowns, *knowns;
    size_t n_unknowns, n_knowns;   /* of references */
    size_t unknowns_size, knowns_size; /* of elements */
} cosim_fmu_directional;
int32_t cosim_fmu_directional_derivative(cosim_fmu *fmu, const cosim_fmu_directional *derivative,
                                         const double *seed, double *result);

/* The slopes of inputs over a step. */
typedef struct {
    /* SetRealInputDerivatives; of FMI 3.0 GetFloat64, of the values that the inputs have */
    cosim_fmu_call *call;
    const uint32_t *references;
    size_t count, size;      /* of references, of elements */
    const int32_t *orders;   /* (count) 1; not in FMI 3.0 */
    const intptr_t *columns; /* (size) of the inputs */
    double *start;           /* (size) of FMI 3.0 */
    double *values;          /* (size) */
    cosim_interpolation *interpolation; /* of FMI 3.0, with the memory of `start` and `values` */
} cosim_fmu_slopes;
/* Set change / h for the next step, from the change of the whole vector of inputs over it. */
int32_t cosim_fmu_set_slopes(cosim_fmu *fmu, const cosim_fmu_slopes *slopes, const double *change,
                             double h);

/* do_step of co-simulation. */
typedef struct {
    void (*function)(void); /* of `call`: a copy */
    cosim_fmu_call *call;
    int32_t event_mode; /* the FMU has one */
    int32_t status;     /* that it returned last */
    /* of FMI 3.0 */
    bool *event_needed, *terminate, *early_return;
    double *last_successful_time;
    cosim_interpolation *interpolation;
    cosim_fmu_call *set; /* fmi3SetFloat64, which the interpolation calls */
} cosim_fmu_step;
typedef int (*cosim_fmu_do_step_1)(void *instance, double t, double h, signed char new_step);
typedef int (*cosim_fmu_do_step_2)(void *instance, double t, double h, int no_way_back);
typedef int (*cosim_fmu_do_step_3)(void *instance, double t, double h, bool no_way_back,
                                   bool *event_needed, bool *terminate, bool *early_return,
                                   double *last_successful_time);
/* Whether inputs with slopes failed in a step of FMI 3.0, or were never asked for. */
bool cosim_fmu_has_lost_slopes(const cosim_interpolation *interpolation);
/* Check another status than ok: COSIM_OK for a warning, else COSIM_DECLINED. */
int32_t cosim_fmu_check_step(cosim_fmu *fmu, cosim_fmu_step *step);

/* Call it; COSIM_DECLINED: it ended in another way than with a completed step, and what is to be
 * found out about that is left to the methods in Python. */
static inline int32_t cosim_fmu_do_step(cosim_fmu *fmu, int32_t version, cosim_fmu_step *step,
                                        double t, double h)
{
    fmu->messages->now = t;
    if (version == 2)
        step->status =
            ((cosim_fmu_do_step_2)step->function)(fmu->instance, t, h, !fmu->may_go_back);
    else if (version == 1)
        step->status = ((cosim_fmu_do_step_1)step->function)(fmu->instance, t, h, 1);
    else {
        cosim_interpolation *interpolation = step->interpolation;
        interpolation->t0 = t;
        interpolation->h = h;
        interpolation->last_request = -INFINITY;
        step->status = ((cosim_fmu_do_step_3)step->function)(
            fmu->instance, t, h, !fmu->may_go_back, step->event_needed, step->terminate,
            step->early_return, step->last_successful_time);
        if (*step->terminate || *step->early_return || (*step->event_needed && step->event_mode))
            return COSIM_DECLINED;
        if (interpolation->size && cosim_fmu_has_lost_slopes(interpolation))
            return COSIM_DECLINED;
    }
    return step->status == COSIM_FMI_OK ? 0 : cosim_fmu_check_step(fmu, step);
}
/* Until when inputs with slopes followed them in a step that was completed [s], infinity: to its
 * end, -infinity: not at all; ends the interpolation of FMI 3.0. */
double cosim_fmu_interpolated_until(cosim_fmu *fmu, const cosim_fmu_step *step);

#endif
