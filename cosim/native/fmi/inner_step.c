#include "inner_step.h"

#include <math.h>
#include <stdbool.h>
#include <string.h>

enum { REPEATS = 8, CHANGES_IN_A_ROW = 20 };
#define RELATIVE 1e-9

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

static void keep_inputs(cosim_inner_step *s, const double *inputs)
{
    memcpy(s->inputs, inputs, (size_t)s->n_u * sizeof *inputs);
}

static void keep_outputs(cosim_inner_step *s, const double *outputs)
{
    for (int32_t i = 0; i < s->n; ++i)
        s->outputs[i] = outputs[s->columns[i]];
}

int64_t cosim_inner_step_observe(cosim_inner_step *s, const double *outputs, const double *inputs)
{
    if (!s->watches)
        return 0;
    if (!s->begun) {
        s->begun = 1;
        keep_outputs(s, outputs);
        keep_inputs(s, inputs);
        return 0;
    }
    const int64_t steps = s->steps + 1;
    const bool input_changed = memcmp(inputs, s->inputs, (size_t)s->n_u * sizeof *inputs) != 0;
    const int64_t input_changes = s->input_changes + input_changed;
    keep_inputs(s, inputs);
    if (is_watched_as_before(s, outputs)) {
        s->steps = steps;
        s->input_changes = input_changes;
        return 0;
    }
    int64_t repeats = 0;
    if (steps == s->period && (input_changes == 0 || input_changes == steps))
        repeats = s->repeats + is_significant(s, outputs);
    memcpy(s->outputs_before, s->outputs, (size_t)s->n * sizeof *outputs);
    keep_outputs(s, outputs);
    s->changed = 1;
    s->steps = 0;
    s->input_changes = 0;
    s->period = steps;
    s->repeats = repeats;
    if (repeats < (steps == 1 ? CHANGES_IN_A_ROW : REPEATS))
        return 0;
    s->watches = 0;
    return steps > 1 ? steps : 0;
}
