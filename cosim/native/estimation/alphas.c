#include "alphas.h"

void cosim_alphas_at(const cosim_alphas *self, double t, const double *signals, double *values)
{
    for (int32_t i = 0; i < self->count; ++i)
        values[i] = self->element[i] < 0 ? cosim_evaluate(&self->programs[i], t)
                                         : signals[self->element[i]];
}

int64_t cosim_past_alphas_memory(const cosim_past_alphas *self)
{
    return (int64_t)self->depth * self->alphas.signals;
}

/* A signal `steps` samples before now; NaN before the first one. */
static double sample(const cosim_past_alphas *self, const double *ring, int64_t now,
                     int32_t element, const double *signals, int32_t steps)
{
    if (steps == 0)
        return signals[element];
    if (steps > now)
        return cosim_no_value();
    return ring[(now - steps) % self->depth * self->alphas.signals + element];
}

void cosim_past_alphas_at(const cosim_past_alphas *self, const double *ring, int64_t now, double t,
                          const double *signals, double *values)
{
    for (int32_t i = 0; i < self->alphas.count; ++i)
        for (int32_t j = 0; j < self->rows; ++j) {
            const int32_t place = i * self->rows + j, element = self->alphas.element[i];
            if (element < 0) {
                values[place] = cosim_evaluate(&self->alphas.programs[i], t - self->age[j]);
                continue;
            }
            const int32_t steps = self->steps[place];
            const double part = self->part[place];
            const double value = sample(self, ring, now, element, signals, steps);
            values[place] = value;
            if (part > 0.0) {
                const double before = sample(self, ring, now, element, signals, steps + 1);
                values[place] = value + part * (before - value);
            }
        }
}

void cosim_past_alphas_keep(const cosim_past_alphas *self, double *ring, int64_t now,
                            const double *signals)
{
    const int32_t width = self->alphas.signals;
    if (self->depth == 0)
        return;
    for (int32_t k = 0; k < width; ++k)
        ring[now % self->depth * width + k] = signals[k];
}
