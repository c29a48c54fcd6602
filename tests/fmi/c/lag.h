/* A lag with feedthrough for co-simulation, x' = u + d - x, y = x + u, that can be made to
 * misbehave. Its own step is exact for linearly interpolated inputs. What it shows is computed at
 * the end of a step (an eager instance): read after setting inputs without a step between, it would
 * be stale, so that is answered with an error. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum {
    U,
    D,
    X,
    Y,
    CALLS,
    Z,       /* z = d */
    LONGEST, /* longer steps are refused that overlap ... */
    FROM,
    TO,         /* ... this time */
    INNER,      /* the inner step, if there is one */
    RETURNS,    /* returns early at the multiples of it; negative: that long before the step */
    EVENT,      /* a time event, where x grows by 1, at the multiples of it ... */
    ANNOUNCES,  /* ... which is announced, or only met (0); one more is at the start (2) */
    ITERATIONS, /* of an event */
    END,        /* time of the wish to end */
    FAIL,       /* time of the failure */
    STATUS,     /* of the failure */
    ASKS,       /* for inputs in a step: how often (FMI 3) */
    NO_SLOPES,  /* from this time on input derivatives are refused (FMI 1 and 2) */
    VALUES
};

typedef enum { START, STEP, EVENT_MODE } Mode;
typedef enum { DONE, DISCARDED, EARLY, MET_EVENT, ENDED, FAILED } Outcome;

typedef struct {
    double value[VALUES], slope, shown[LONGEST], t, due, iteration;
    int stale; /* inputs were set, no step was made */
    Mode mode;
} Lag;

static const double start[VALUES] = {[TO] = 1e9,   [LONGEST] = 1e9,  [END] = 1e9,
                                     [FAIL] = 1e9, [ITERATIONS] = 1, [ASKS] = 2,
                                     [NO_SLOPES] = 1e9};

static void lag_reset(Lag *lag)
{
    *lag = (Lag){.mode = START};
    memcpy(lag->value, start, sizeof start);
}

static void lag_show(Lag *lag)
{
    lag->shown[X] = lag->value[X];
    lag->shown[Y] = lag->value[X] + lag->value[U];
    lag->shown[Z] = lag->value[D];
    lag->stale = 0;
}

/* 0: must not be set now. */
static int lag_set(Lag *lag, unsigned reference, double value, int event_mode_used)
{
    if (reference == D && event_mode_used && lag->mode == STEP)
        return 0;
    lag->value[reference] = value;
    lag->stale = lag->mode == STEP;
    return 1;
}

/* 0: must not be read now. */
static int lag_get(Lag *lag, unsigned reference, double *value)
{
    if (lag->mode != STEP)
        lag_show(lag);
    *value = reference == X || reference == Y || reference == Z ? lag->shown[reference]
                                                                : lag->value[reference];
    return !lag->stale || reference < X;
}

/* 0: refused, and nothing that is read from now on is a number. */
static int lag_set_slope(Lag *lag, double slope)
{
    lag->slope = slope;
    if (lag->t < lag->value[NO_SLOPES] - 1e-9)
        return 1;
    lag->value[X] = NAN;
    return 0;
}

/* The next multiple of a period after t. */
static double lag_next(double period, double t)
{
    return (floor(t / period + 1e-9) + 1.0) * period;
}

/* Return how the step from t to *end would go, and where it would really end. */
static Outcome lag_outcome(Lag *lag, double t, double *end)
{
    const double *p = lag->value, close = 1e-9;
    if (*end > p[FAIL] + close)
        return FAILED;
    if (*end > p[END] + close)
        return ENDED;
    if (*end - t > p[LONGEST] * (1.0 + close) && t < p[TO] - close && *end > p[FROM] + close)
        return DISCARDED;
    if (p[EVENT] > 0.0 && lag_next(p[EVENT], t) < *end + close) {
        *end = fmin(*end, lag_next(p[EVENT], t));
        lag->due = *end;
        return MET_EVENT;
    }
    if (p[RETURNS] < 0.0) {
        *end = t + p[RETURNS];
        return EARLY;
    }
    if (p[RETURNS] > 0.0 && lag_next(p[RETURNS], t) < *end - close) {
        *end = lag_next(p[RETURNS], t);
        return EARLY;
    }
    return DONE;
}

/* x - v + slope decays, v = u + d: exact for a linearly interpolated input. */
static void lag_cross(Lag *lag, double h)
{
    double *value = lag->value, v = value[U] + value[D], slope = lag->slope;
    value[X] = v + slope * h - slope + (value[X] - v + slope) * exp(-h);
    value[U] += slope * h;
}

static void lag_advance(Lag *lag, double t, double end)
{
    double inner = lag->value[INNER];
    for (; inner > 0.0 && lag->t + inner < end + 1e-9; lag->t += inner)
        lag_cross(lag, inner);
    if (inner == 0.0) {
        lag_cross(lag, end - t);
        lag->t = end;
    }
    lag->slope = 0.0;
    lag->value[CALLS] += 1.0;
    lag_show(lag);
}
