#include "callbacks.h"
#include "running.h"

#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* guards the list and every ring in it; held for a few copies only */
static atomic_flag busy = ATOMIC_FLAG_INIT;
static cosim_messages *list;

static void lock(void)
{
    while (atomic_flag_test_and_set_explicit(&busy, memory_order_acquire)) {
    }
}

static void unlock(void) { atomic_flag_clear_explicit(&busy, memory_order_release); }

void cosim_messages_open(cosim_messages *self)
{
    lock();
    self->next = list;
    list = self;
    unlock();
}

void cosim_messages_close(cosim_messages *self)
{
    if (cosim_running == self)
        cosim_running = NULL;
    lock();
    for (cosim_messages **link = &list; *link; link = &(*link)->next)
        if (*link == self) {
            *link = self->next;
            break;
        }
    unlock();
}

static cosim_messages *find(const void *key)
{
    cosim_messages *fallback = NULL;
    for (cosim_messages *messages = list; messages; messages = messages->next) {
        if (key && messages->key == key)
            return messages;
        if (messages->accepts_unknown && !fallback)
            fallback = messages;
    }
    return fallback;
}

static void copy(char *target, size_t size, const char *source)
{
    size_t length = 0;
    for (; source && length < size - 1 && source[length]; ++length)
        target[length] = source[length];
    target[length] = 0;
}

void cosim_log_text(void *key, int status, const char *category, const char *text)
{
    lock();
    cosim_messages *self = find(key);
    if (self) {
        cosim_message *free = &self->ring[(self->first + self->count) % self->size];
        if (self->count < self->size)
            ++self->count;
        else {
            self->first = (self->first + 1) % self->size;
            ++self->dropped;
        }
        free->time = self->now;
        free->status = status;
        copy(free->category, sizeof free->category, category);
        copy(free->text, sizeof free->text, text);
    }
    unlock();
}

void cosim_log(void *key, const char *instance, int status, const char *category,
               const char *format, ...)
{
    (void)instance;
    char text[COSIM_TEXT] = "";
    if (format) {
        va_list arguments;
        va_start(arguments, format);
        vsnprintf(text, sizeof text, format, arguments);
        va_end(arguments);
    }
    cosim_log_text(key, status, category, text);
}

void cosim_messages_forget_behind(cosim_messages *self, cosim_messages_mark mark)
{
    lock();
    /* unless some were taken, or overwritten, since then */
    if (self->first == mark.first && self->dropped == mark.dropped && self->count > mark.count)
        self->count = mark.count;
    unlock();
}

int32_t cosim_messages_take(cosim_messages *self, cosim_message *out)
{
    lock();
    const int32_t found = self->count > 0;
    if (found) {
        *out = self->ring[self->first];
        self->first = (self->first + 1) % self->size;
        --self->count;
    }
    unlock();
    return found;
}

int32_t cosim_messages_last(cosim_messages *self, cosim_message *out)
{
    lock();
    const int32_t found = self->count > 0;
    if (found)
        *out = self->ring[(self->first + self->count - 1) % self->size];
    unlock();
    return found;
}

int64_t cosim_messages_dropped(cosim_messages *self)
{
    lock();
    const int64_t dropped = self->dropped;
    self->dropped = 0;
    unlock();
    return dropped;
}

void cosim_intermediate_update(void *environment, double t, bool set_requested, bool get_allowed,
                               bool step_finished, bool can_return_early,
                               bool *early_return_requested, double *early_return_time)
{
    (void)get_allowed, (void)step_finished, (void)can_return_early;
    cosim_interpolation *self = environment;
    if (early_return_requested)
        *early_return_requested = false;
    if (early_return_time)
        *early_return_time = t;
    if (!self || !set_requested || self->size == 0)
        return;
    /* at the end without the rounding of t */
    const double elapsed = t == self->t0 + self->h ? self->h : t - self->t0;
    self->last_request = t;
    for (size_t i = 0; i < self->size; ++i)
        self->values[i] = self->start[i] + self->slope[i] * elapsed;
    const int status =
        self->set(self->instance, self->references, self->count, self->values, self->size);
    if (status > self->status)
        self->status = status;
}

void *cosim_allocate(size_t n, size_t size) { return calloc(n, size); }

void cosim_free(void *memory) { free(memory); }
