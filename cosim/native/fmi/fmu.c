#include "fmu.h"

#include <math.h>

#include "cosim.h"

typedef int (*directional_2)(void *instance, const uint32_t *unknowns, size_t n_unknowns,
                             const uint32_t *knowns, size_t n_knowns, const double *seed,
                             double *result);
typedef int (*directional_3)(void *instance, const uint32_t *unknowns, size_t n_unknowns,
                             const uint32_t *knowns, size_t n_knowns, const double *seed,
                             size_t n_seed, double *result, size_t n_result);

typedef int (*slopes_2)(void *instance, const uint32_t *references, size_t n, const int32_t *orders,
                        const double *values);

void cosim_fmu_record_warning(const cosim_fmu *fmu, cosim_fmu_call *call)
{
    if (call->warned)
        return;
    call->warned = 1;
    call->time = fmu->messages->now;
    call->has_message = cosim_messages_last(fmu->messages, &call->message);
}

int32_t cosim_fmu_check_other(cosim_fmu *fmu, cosim_fmu_call *call, int32_t status)
{
    if (status == COSIM_FMI_WARNING) {
        cosim_fmu_record_warning(fmu, call);
        return COSIM_OK;
    }
    fmu->failed = call;
    fmu->status = status;
    return COSIM_CALL_FAILED;
}

/* --- conversions --- */

/* Smallest and largest float64 among the integers of a carrier. */
static const double range[][2] = {
    [COSIM_INT8] = {INT8_MIN, INT8_MAX},           [COSIM_UINT8] = {0, UINT8_MAX},
    [COSIM_INT16] = {INT16_MIN, INT16_MAX},        [COSIM_UINT16] = {0, UINT16_MAX},
    [COSIM_INT32] = {INT32_MIN, INT32_MAX},        [COSIM_UINT32] = {0, UINT32_MAX},
    [COSIM_INT64] = {-0x1p63, 0x1.fffffffffffffp62}, [COSIM_UINT64] = {0, 0x1.fffffffffffffp63},
    [COSIM_BOOL] = {0, 1},
};

static double element(const cosim_fmu_group *group, const double *vector, size_t i)
{
    return group->columns ? vector[group->columns[i]] : vector[group->first + (intptr_t)i];
}

static double *place(const cosim_fmu_group *group, double *vector, size_t i)
{
    return group->columns ? vector + group->columns[i] : vector + group->first + (intptr_t)i;
}

/* Whether a value is a number of the group's type. */
static bool fits(const cosim_fmu_group *group, double value)
{
    if (group->boolean)
        return value == 0.0 || value == 1.0;
    const double *limits = range[group->carrier];
    return value >= limits[0] && value <= limits[1] && value == floor(value);
}

static bool is_float(const cosim_fmu_group *group)
{
    return group->carrier == COSIM_FLOAT64 || group->carrier == COSIM_FLOAT32;
}

/* Whether the group's elements of a vector can be handed over where they stand. */
static bool is_direct(const cosim_fmu_group *group)
{
    return group->carrier == COSIM_FLOAT64 && !group->columns;
}

#define TO(carrier, type)                                        \
    case carrier:                                                \
        for (size_t i = 0; i < group->size; ++i)                 \
            ((type *)group->values)[i] = (type)element(group, vector, i); \
        break

/* Convert to the FMU's type, in the group's scratch memory; false: a value does not fit. */
static bool convert(const cosim_fmu_group *group, const double *vector)
{
    if (!is_float(group))
        for (size_t i = 0; i < group->size; ++i)
            if (!fits(group, element(group, vector, i)))
                return false;
    switch (group->carrier) {
        TO(COSIM_FLOAT64, double);
        TO(COSIM_FLOAT32, float);
        TO(COSIM_INT8, int8_t);
        TO(COSIM_UINT8, uint8_t);
        TO(COSIM_INT16, int16_t);
        TO(COSIM_UINT16, uint16_t);
        TO(COSIM_INT32, int32_t);
        TO(COSIM_UINT32, uint32_t);
        TO(COSIM_INT64, int64_t);
        TO(COSIM_UINT64, uint64_t);
        TO(COSIM_BOOL, uint8_t);
    }
    return true;
}

#define FROM(carrier, type)                                         \
    case carrier:                                                   \
        for (size_t i = 0; i < group->size; ++i)                    \
            *place(group, vector, i) = (double)((const type *)group->values)[i]; \
        break

/* Whether all integers that were read are float64. */
static bool are_exact(const cosim_fmu_group *group)
{
    for (size_t i = 0; i < group->size; ++i) {
        const int64_t value = ((const int64_t *)group->values)[i];
        const uint64_t unsigned_value = ((const uint64_t *)group->values)[i];
        const bool is_signed = group->carrier == COSIM_INT64;
        const double carried = is_signed ? (double)value : (double)unsigned_value;
        if (carried > range[group->carrier][1])
            return false; /* rounded up to what the type does not have */
        if (is_signed ? (int64_t)carried != value : (uint64_t)carried != unsigned_value)
            return false;
    }
    return true;
}

/* Convert what was read, from the group's scratch memory; false: an integer is no float64. */
static bool convert_back(const cosim_fmu_group *group, double *vector)
{
    const bool is_large = group->carrier == COSIM_INT64 || group->carrier == COSIM_UINT64;
    if (is_large && !are_exact(group))
        return false;
    switch (group->carrier) {
        FROM(COSIM_FLOAT64, double);
        FROM(COSIM_FLOAT32, float);
        FROM(COSIM_INT8, int8_t);
        FROM(COSIM_UINT8, uint8_t);
        FROM(COSIM_INT16, int16_t);
        FROM(COSIM_UINT16, uint16_t);
        FROM(COSIM_INT32, int32_t);
        FROM(COSIM_UINT32, uint32_t);
        FROM(COSIM_INT64, int64_t);
        FROM(COSIM_UINT64, uint64_t);
    case COSIM_BOOL:
        for (size_t i = 0; i < group->size; ++i)
            *place(group, vector, i) = ((const uint8_t *)group->values)[i] ? 1.0 : 0.0;
        break;
    }
    return true;
}

/* --- calls --- */

static int32_t access(cosim_fmu *fmu, cosim_fmu_call *call, const cosim_fmu_group *group,
                      void *values)
{
    int status;
    if (fmu->version == 3)
        status = ((cosim_fmu_values_3)call->function)(fmu->instance, group->references,
                                                      group->count, values, group->size);
    else
        status = ((cosim_fmu_values_2)call->function)(fmu->instance, group->references,
                                                      group->count, values);
    return cosim_fmu_check(fmu, call, status);
}

int32_t cosim_fmu_set_any(cosim_fmu *fmu, const cosim_fmu_variables *variables,
                          const double *vector)
{
    for (int64_t i = 0; i < variables->count; ++i) {
        const cosim_fmu_group *group = variables->groups + i;
        if (!is_direct(group) && !convert(group, vector))
            return COSIM_DECLINED;
    }
    for (int64_t i = 0; i < variables->count; ++i) {
        const cosim_fmu_group *group = variables->groups + i;
        /* functions of FMI that set take const values */
        void *values = is_direct(group) ? (void *)(vector + group->first) : group->values;
        const int32_t status = access(fmu, group->set, group, values);
        if (status != COSIM_OK)
            return status;
    }
    return COSIM_OK;
}

int32_t cosim_fmu_get_any(cosim_fmu *fmu, const cosim_fmu_variables *variables, double *vector)
{
    for (int64_t i = 0; i < variables->count; ++i) {
        const cosim_fmu_group *group = variables->groups + i;
        const bool direct = is_direct(group);
        void *values = direct ? vector + group->first : group->values;
        const int32_t status = access(fmu, group->get, group, values);
        if (status != COSIM_OK)
            return status;
        if (!direct && !convert_back(group, vector))
            return COSIM_DECLINED;
    }
    return COSIM_OK;
}

int32_t cosim_fmu_directional_derivative(cosim_fmu *fmu, const cosim_fmu_directional *d,
                                         const double *seed, double *result)
{
    int status;
    if (fmu->version == 3)
        status = ((directional_3)d->call->function)(fmu->instance, d->unknowns, d->n_unknowns,
                                                    d->knowns, d->n_knowns, seed, d->knowns_size,
                                                    result, d->unknowns_size);
    else
        status = ((directional_2)d->call->function)(fmu->instance, d->unknowns, d->n_unknowns,
                                                    d->knowns, d->n_knowns, seed, result);
    return cosim_fmu_check(fmu, d->call, status);
}

/* --- co-simulation --- */

int32_t cosim_fmu_set_slopes(cosim_fmu *fmu, const cosim_fmu_slopes *slopes, const double *change,
                             double h)
{
    for (size_t i = 0; i < slopes->size; ++i)
        slopes->values[i] = change[slopes->columns[i]] / h;
    int status;
    if (fmu->version == 3)
        status = ((cosim_fmu_values_3)slopes->call->function)(fmu->instance, slopes->references,
                                                    slopes->count, slopes->start, slopes->size);
    else
        status = ((slopes_2)slopes->call->function)(fmu->instance, slopes->references,
                                                    slopes->count, slopes->orders, slopes->values);
    const int32_t result = cosim_fmu_check(fmu, slopes->call, status);
    if (result == COSIM_OK && slopes->interpolation)
        slopes->interpolation->size = slopes->size; /* not 0: switched on for one step */
    return result;
}

/* Whether inputs have slopes that the FMU never asked for in the step. */
static bool was_not_asked(const cosim_interpolation *interpolation)
{
    if (interpolation->last_request != -INFINITY)
        return false;
    for (size_t i = 0; i < interpolation->size; ++i)
        if (interpolation->slope[i] != 0.0)
            return true;
    return false;
}

bool cosim_fmu_has_lost_slopes(const cosim_interpolation *interpolation)
{
    return interpolation->status > COSIM_FMI_WARNING || was_not_asked(interpolation);
}

int32_t cosim_fmu_check_step(cosim_fmu *fmu, cosim_fmu_step *step)
{
    if (step->status != COSIM_FMI_WARNING)
        return COSIM_DECLINED;
    cosim_fmu_record_warning(fmu, step->call);
    return COSIM_OK;
}

double cosim_fmu_interpolated_until(cosim_fmu *fmu, const cosim_fmu_step *step)
{
    cosim_interpolation *interpolation = step->interpolation;
    if (!interpolation || !interpolation->size)
        return INFINITY;
    interpolation->size = 0;
    if (interpolation->status == COSIM_FMI_WARNING)
        cosim_fmu_record_warning(fmu, step->set);
    return interpolation->last_request;
}
