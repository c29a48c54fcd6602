#include "inner_step.h"

#include <math.h>
#include <stdbool.h>
#include <string.h>

enum { REPEATS = 8, CHANGES_IN_A_ROW = 20 };
#define RELATIVE 1e-9
#define EVEN 1e-6

static bool is_watched_as_before(const cosim_inner_step *s, const double *outputs)
{
    for (int32_t i = 0; i < s->n; ++i)
        if (memcmp(outputs + s->columns[i], s->outputs + i, sizeof *outputs))
            return false;
    return true;
}

/* Whether a change is more than rounding, and no switch back. */
static bool is_significant(const cosim_inner_step *s, const double *outputs)
{
    bool changed = false, switched_back = s->changed;
    for (int32_t i = 0; i < s->n; ++i) {
        const double now = outputs[s->columns[i]], last = s->outputs[i];
        const double scale = fmax(fabs(now), fabs(last));
        if (fabs(now - last) > RELATIVE * scale) /* false for what is not finite */
            changed = true;
        if (memcmp(&now, s->outputs_before + i, sizeof now))
            switched_back = false;
    }
    return changed && !switched_back;
}

/* Whether an input is not as before; of those from its own loop too, or of the others alone. */
static bool has_changed(const cosim_inner_step *s, const double *inputs, bool of_loop)
{
    for (int32_t i = 0; i < s->n_u; ++i)
        if ((of_loop || !s->in_loop[i]) && memcmp(inputs + i, s->inputs + i, sizeof *inputs))
            return true;
    return false;
}

/* Whether all outputs change by what they changed last: a quantized ramp, which does so for any
 * step. */
static bool is_even(const cosim_inner_step *s, const double *outputs)
{
    for (int32_t i = 0; i < s->n; ++i) {
        const double last = s->outputs[i], change = outputs[s->columns[i]] - last;
        const double before = last - s->outputs_before[i];
        if (!(fabs(change - before) <= EVEN * fmax(fabs(change), fabs(before))))
            return false;
    }
    return true;
}

/* Take one more interval: whether there is an n, of which all changes are the first steps at or
 * behind multiples, from some time on. */
static bool is_followed(cosim_inner_step *s, int64_t steps)
{
    const int64_t end = s->ends[s->uneven] + steps;
    for (int64_t i = 0; i <= s->uneven; ++i) {
        const double distance = (double)(end - s->ends[i]), count = (double)(s->uneven + 1 - i);
        s->least = fmax(s->least, (distance - 1.0) / count);
        s->most = fmin(s->most, (distance + 1.0) / count);
    }
    s->ends[s->uneven + 1] = end;
    return s->least < s->most;
}

static void forget_intervals(cosim_inner_step *s)
{
    s->uneven = 0;
    s->ends[0] = 0;
    s->least = 0.0;
    s->most = INFINITY;
}

static bool is_always_or_never(int64_t changes, int64_t steps)
{
    return changes == 0 || changes == steps;
}

static void keep_inputs(cosim_inner_step *s, const double *inputs)
{
    memcpy(s->inputs, inputs, (size_t)s->n_u * sizeof *inputs);
}

static void keep_outputs(cosim_inner_step *s, const double *outputs)
{
    for (int32_t i = 0; i < s->n; ++i)
        s->outputs[i] = outputs[s->columns[i]];
}

double cosim_inner_step_observe(cosim_inner_step *s, const double *outputs, const double *inputs)
{
    if (!s->watches)
        return 0;
    if (!s->begun) {
        s->begun = 1;
        forget_intervals(s);
        keep_outputs(s, outputs);
        keep_inputs(s, inputs);
        return 0;
    }
    const int64_t steps = s->steps + 1;
    const int64_t input_changes = s->input_changes + has_changed(s, inputs, true);
    const int64_t outside_changes = s->outside_changes + has_changed(s, inputs, false);
    keep_inputs(s, inputs);
    if (is_watched_as_before(s, outputs)) {
        s->steps = steps;
        s->input_changes = input_changes;
        s->outside_changes = outside_changes;
        return 0;
    }
    const bool is_own = is_always_or_never(input_changes, steps);
    const bool counts = (is_own || is_always_or_never(outside_changes, steps)) && s->changed;
    int64_t repeats = 0;
    if (steps == s->period && counts)
        repeats = s->repeats + is_significant(s, outputs);
    if (counts && is_significant(s, outputs) && !is_even(s, outputs) && is_followed(s, steps))
        s->uneven += 1;
    else
        forget_intervals(s);
    s->is_shared = (repeats || s->uneven) && (s->is_shared || !is_own);
    memcpy(s->outputs_before, s->outputs, (size_t)s->n * sizeof *outputs);
    keep_outputs(s, outputs);
    s->changed = 1;
    s->steps = 0;
    s->input_changes = 0;
    s->outside_changes = 0;
    s->period = steps;
    s->repeats = repeats;
    if (repeats >= (steps == 1 ? CHANGES_IN_A_ROW : REPEATS)) {
        s->watches = 0;
        return steps > 1 ? (double)steps : 0.0;
    }
    if (s->uneven < COSIM_UNEVEN)
        return 0.0;
    s->watches = 0;
    return (double)s->ends[COSIM_UNEVEN] / COSIM_UNEVEN;
}
