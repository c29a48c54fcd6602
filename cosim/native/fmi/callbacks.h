/* What a loaded FMU calls back: none of it runs Python or prints.
 *
 * An FMU may log from any thread, and FMI 1.0 names only its own component: every ring of messages
 * is in one list, found by a key under one lock, so that an FMU that names something else reaches
 * none of them. The memory belongs to the caller. */
#ifndef COSIM_CALLBACKS_H
#define COSIM_CALLBACKS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define COSIM_CATEGORY 100 /* bytes of a category and of a text, with the 0 at their ends */
#define COSIM_TEXT 1001

typedef struct {
    double time; /* `now`, when it came */
    int32_t status;
    char category[COSIM_CATEGORY], text[COSIM_TEXT];
} cosim_message;

/* The last `size` messages of one FMU that were not taken yet. */
typedef struct cosim_messages {
    struct cosim_messages *next; /* in the list */
    const void *key;             /* the environment given to the FMU; its component in FMI 1.0 */
    cosim_message *ring;
    int32_t size, first, count;
    /* also takes the messages of an unknown key: while an FMU of FMI 1.0 is instantiated */
    int32_t accepts_unknown;
    int64_t dropped;
    /* time of the simulation [s], written between the calls of the FMU; NaN: it did not begin */
    double now;
    const char *name; /* of the component */
} cosim_messages;

/* Put into the list. */
void cosim_messages_open(cosim_messages *self);
/* Take out of the list: after this no FMU reaches the memory. */
void cosim_messages_close(cosim_messages *self);

/* Copy the oldest message and drop it (last: the newest one, which stays); 0: there is none. */
int32_t cosim_messages_take(cosim_messages *self, cosim_message *out);
int32_t cosim_messages_last(cosim_messages *self, cosim_message *out);
/* What the messages up to now are known by; and forget those behind it that were not taken yet. */
typedef struct {
    int32_t first, count;
    int64_t dropped;
} cosim_messages_mark;
void cosim_messages_forget_behind(cosim_messages *self, cosim_messages_mark mark);
/* Both without the lock, as most FMUs say nothing: called between the calls of the FMU. */
static inline cosim_messages_mark cosim_messages_up_to_now(const cosim_messages *self)
{
    return (cosim_messages_mark){self->first, self->count, self->dropped};
}
static inline void cosim_messages_forget(cosim_messages *self, cosim_messages_mark mark)
{
    if (self->count != mark.count || self->first != mark.first)
        cosim_messages_forget_behind(self, mark);
}
/* How many were dropped since the last call. */
int64_t cosim_messages_dropped(cosim_messages *self);

/* The loggers of FMI 1.0 and 2.0 (a printf format and its arguments), and of FMI 3.0 (a text). */
void cosim_log(void *key, const char *instance, int status, const char *category,
               const char *format, ...);
void cosim_log_text(void *key, int status, const char *category, const char *text);

/* Linear interpolation of the inputs inside a step of FMI 3.0: u(t) = start + slope (t - t0), set
 * by fmi3SetFloat64. */
typedef struct {
    int (*set)(void *instance, const uint32_t *references, size_t n, const double *values,
               size_t n_values);
    void *instance;
    const uint32_t *references;
    size_t count, size; /* of references, of values; size 0: no interpolation */
    const double *start, *slope;
    double *values; /* scratch */
    double t0, h;   /* start of the step, and its size */
    /* time of the last update that requested inputs; -infinity before the step */
    double last_request;
    int32_t status; /* the worst status that `set` returned */
} cosim_interpolation;

/* fmi3IntermediateUpdateCallback, the environment being a cosim_interpolation; never asks for an
 * early return. */
void cosim_intermediate_update(void *environment, double t, bool set_requested, bool get_allowed,
                               bool step_finished, bool can_return_early,
                               bool *early_return_requested, double *early_return_time);

/* Of FMI 1.0 and 2.0. */
void *cosim_allocate(size_t n, size_t size);
void cosim_free(void *memory);

#endif
