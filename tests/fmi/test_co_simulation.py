"""Co-simulation FMUs that misbehave in every way the standard allows, and some it does not.

All of them are the lag of ``c/lag.h``.
"""

from functools import cache

import numpy as np
import pytest

from cosim.core.contracts import Stopped
from cosim.errors import FmuError, RunError
from cosim.fmi.component import load
from cosim.fmi.options import FmuOptions
from cosim.testing import check_component, check_rollback
from tests.core.parts import driven
from tests.fmi import lag
from tests.fmi.lag import on_a_line, on_a_sine

HELD = np.array([False, True])  # u, d
U0 = 0.5
SLOPE = 0.7
# Values near 1 over at most 100 steps, each rounding a few times: below 100 * 10 * 2^-53 = 1.1e-13.
ROUNDING = 2e-13
X = 0
Y = 1
CALLS = 2
Z = 3


@pytest.fixture(scope="session")
def path(tmp_path_factory):
    """Return the path of the lag of a version with some capabilities.

    Each is a file of its own, as those that can save states are tried when first loaded.
    """
    folder = tmp_path_factory.mktemp("lag")
    compiled = {version: lag.build(folder, version) for version in "123"}

    @cache
    def path(version, *can):
        name = f"{version}-{'-'.join(can)}.fmu".replace(" ", "_")
        return lag.able(compiled[version], folder / name, version, *can)

    return path


@pytest.fixture
def opened(path):
    """Open the lag: its version, what it can, start values of its parameters."""
    fmus = []

    def opened(version, *can, **start):
        fmus.append(load(path(version, *can), FmuOptions(start=start)))
        return fmus[-1]

    yield opened
    for fmu in fmus:
        fmu.close()


def line(t):
    return np.column_stack([U0 + SLOPE * t, np.zeros_like(t)])


def sine(t):
    return np.column_stack([np.sin(t), np.zeros_like(t)])


def run(fmu, *, step=0.1, stop=1.0, u=line, held=HELD, blocks=None):
    """Return the outputs at every communication point, shape (steps + 1, 3)."""
    steps = round(stop / step)
    t = np.arange(steps + 1) * round(step * 1e9) / 1e9
    inputs = u(t)
    size = blocks or steps
    component = fmu.component
    component.prepare(step, held, {})
    y = [component.initialize(0.0, inputs[0])[np.newaxis]]
    for k in range(0, steps, size):
        rows = slice(k, k + size + 1)
        y.append(component.advance(t[rows], step, inputs[rows]))
    return np.concatenate(y)


def times(step=0.1, stop=1.0):
    return np.arange(round(stop / step) + 1) * step


# --- the order ---


@pytest.mark.parametrize(("version", "can"), [("2", ("D",)), ("3", ("D",)), ("3", ("D", "events"))])
def test_mean_inputs_are_second_order_and_D_makes_feedthrough_so(opened, version, can):
    """Halving the step quarters the error of x and of y = x + u.

    The FMU would give stale values where outputs are read after inputs were set.
    """

    def error(h):
        y = run(opened(version, *can), step=h, u=sine)
        return abs(y[1:, :2] - reference(h)[1:]).max(axis=0)

    ratio = error(0.1) / error(0.05)
    assert ((ratio > 3.8) & (ratio < 4.2)).all()
    assert driven(opened(version, *can).component).notes == ()


def reference(h):
    t = times(h)
    x = on_a_sine(t)
    return np.column_stack([x, x + np.sin(t)])


@pytest.mark.parametrize("version", ["1", "2", "3"])
def test_feedthrough_without_D_is_first_order_and_reported(opened, version):
    """y belongs to the mean input: on a ramp it is wrong by slope h/2, and x by second order."""
    for h in (0.1, 0.05):
        error = run(opened(version), step=h)[1:, :2] - exact(h)[1:]
        difference = error[:, Y] - error[:, X]
        assert difference == pytest.approx(-SLOPE * h / 2, abs=ROUNDING)
    assert opened(version).component.notes == ()  # nothing drives it
    assert driven(opened(version).component).notes == (
        "lag: y lags inputs set to a mean by up to one step (the FMU has no directional "
        "derivatives)",
    )


@pytest.mark.parametrize(("version", "can"), [("2", ("D",)), ("2", ()), ("3", ("D",)), ("3", ())])
def test_outputs_are_what_was_read_last_corrected_by_D(opened, version, can):
    """For u = 5 at the end, y = x + 5 where D is known; else what belongs to the mean.

    An eager FMU would give stale values.
    """
    component = opened(version, *can).component
    component.prepare(0.1, HELD, {})
    component.initialize(0.0, line(times())[0])
    x = component.advance(times(), 0.1, line(times()))[-1, X]
    mean = U0 + SLOPE * 0.95
    expected = x + (5.0 if can else mean)
    for _ in range(2):
        y = component.outputs(1.0, np.array([5.0, 0.0]))
        assert y[X] == x
        assert y[Y] == pytest.approx(expected, abs=ROUNDING)


def exact(h=0.1, stop=1.0):
    t = times(h, stop)
    x = on_a_line(t, U0, SLOPE)
    return np.column_stack([x, x + U0 + SLOPE * t])


@pytest.mark.parametrize("version", ["1", "2", "3"])
def test_fmus_that_interpolate_are_exact_on_ramps(opened, version):
    """The FMU's own step is exact on a ramp, and its outputs belong to the end of it.

    A discrete input gets no derivative.
    """
    assert abs(run(opened(version, "lines"))[:, :2] - exact()).max() < ROUNDING


def test_an_input_that_cannot_be_set_inside_a_step_has_its_mean(opened):
    """u = 1 - t is interpolated, d = t is not: x follows u exactly, and the means of d."""

    def u(t):
        return np.column_stack([1.0 - t, t])

    y = run(opened("3", "lines", "d moves"), u=u, held=np.zeros(2, np.bool_))
    t = times()
    x = on_a_line(t, 1.0, -1.0)
    decay = np.exp(-0.1)
    for k in range(1, 11):
        mean = (k - 0.5) * 0.1
        x[k:] += mean * (1.0 - decay) * np.exp(-(t[k:] - t[k]))
    assert y[:, X] == pytest.approx(x, abs=ROUNDING)


@pytest.mark.parametrize("can", [(), ("D",)])
def test_an_fmu_that_never_asks_for_inputs_gets_their_mean(opened, can):
    """Its inputs stay at u0 in the first step; from the second on it gets their mean.

    A warning reports that once. The outputs are right in the first step too, where D is known: what
    is read belongs to u0.
    """
    fmu = opened("3", "lines", *can, asks=0.0)
    y = run(fmu)
    expected = run(opened("3", *can))
    # What the input of the first step adds to x from then on, relative to its value.
    first_step = (1.0 - np.exp(-0.1)) * np.exp(0.1 - times()[1:])
    mean = U0 + SLOPE * 0.05
    x = expected[1:, X] + (U0 - mean) * first_step
    assert y[1:, X] == pytest.approx(x, abs=ROUNDING)
    fed = y[:, Y] - y[:, X]
    expected_fed = expected[:, Y] - expected[:, X]
    assert fed[2:] == pytest.approx(expected_fed[2:], abs=ROUNDING)
    assert fed[1] == pytest.approx(U0 + SLOPE * 0.1 if can else U0, abs=ROUNDING)
    warning = (
        "lag: asked for no inputs in the step from t = 0.0 s, though it says it can "
        "(providesIntermediateUpdate): they kept their value from the start of that "
        "step; from then on it gets one value of them over a step, and the direct feedthrough to "
        "outputs belongs to that"
    )
    assert fmu.drain() == [(0.0, "warning", "", warning)]
    assert np.array_equal(run(fmu), y)
    assert fmu.drain() == []


def test_outputs_belong_to_the_inputs_that_were_asked_for_last(opened):
    """An FMU that asks at the start of the step only: y is corrected by D from u0 to u1.

    x keeps its own first-order error.
    """
    y = run(opened("3", "lines", "D", asks=1.0))
    fed = y[:, Y] - y[:, X]
    assert fed == pytest.approx(line(times())[:, 0], abs=ROUNDING)


@pytest.mark.fast("1", "2")
@pytest.mark.parametrize("version", ["1", "2", "3"])
def test_the_contract_is_kept(opened, version):
    """Blocks of any size give equal bits, restore(save()) is the identity.

    With D outputs follow the inputs.
    """
    everything = [can for can in lag.CAN[version] if not can.startswith(("inner", "d "))]

    def make():
        return opened(version, *everything).component

    check_component(make, steps=12, h=0.1)
    if "state" in everything:
        check_rollback(make, steps=12, h=0.1)


def test_a_held_input_that_loses_its_value_at_the_end_kept_it_until_then(opened):
    """u = 1 held, without a value (NaN) from the end of the step on: x = 1 - exp(-h) there."""
    component = opened("2").component
    component.prepare(0.1, np.ones(2, np.bool_), {})
    component.initialize(0.0, np.array([1.0, 0.0]))
    u = np.array([[1.0, 0.0], [np.nan, 0.0]])
    y = component.advance(np.array([0.0, 0.1]), 0.1, u)
    assert y[0, X] == pytest.approx(1.0 - np.exp(-0.1), abs=ROUNDING)


@pytest.mark.parametrize("version", ["1", "2"])
def test_slopes_that_are_refused_at_once_begin_the_run_again_with_means(opened, version):
    """A new instance takes the place of the one that failed; that is reported once.

    The rows are those of an FMU that does not interpolate; also at another initialization.
    """
    fmu = opened(version, "lines", no_slopes=0.0)
    expected = run(opened(version))
    assert np.array_equal(run(fmu), expected)
    (message,) = [text for _, level, _, text in fmu.drain() if level == "warning"]
    assert "SetRealInputDerivatives returned 3 (error)" in message
    assert "the run began again with a new instance, which gets one value of its inputs" in message
    assert np.array_equal(run(fmu, blocks=3), expected)
    assert fmu.drain() == []


@pytest.mark.parametrize("version", ["1", "2"])
def test_slopes_that_are_refused_later_stop_the_run(opened, version):
    """After a step that was completed, with its rows; the instance that failed is not replaced."""
    fmu = opened(version, "lines", no_slopes=0.1)
    with pytest.raises(Stopped, match=r"SetRealInputDerivatives returned 3 \(error\)") as stop:
        run(fmu)
    assert (stop.value.steps, stop.value.failed) == (1, True)


def test_a_new_instance_goes_back_to_states_of_its_own(opened):
    """Steps that it discards are repeated from states that were copied of it."""
    discarding = {"longest": 0.03, "begin": 0.4, "until": 0.6}
    fmu = opened("2", "lines", "state", "any step", no_slopes=0.0, **discarding)
    assert np.array_equal(run(fmu), run(opened("2", "state", "any step", **discarding)))


def test_an_fmu_that_asks_for_no_constant_inputs_is_not_reported(opened):
    """It needs none: they keep their value anyway."""
    fmu = opened("3", "lines", asks=0.0)
    run(fmu, u=rest)
    assert fmu.drain() == []


def test_states_of_an_instance_that_was_replaced_are_lost(opened):
    """What was saved before the first step cannot be restored: the FMU's memory is no more."""
    component = opened("2", "lines", "state", no_slopes=0.0).component
    component.prepare(0.1, HELD, {})
    component.initialize(0.0, line(times())[0])
    component.outputs(0.0, line(times())[0])
    saved = component.save()
    component.advance(times(), 0.1, line(times()))
    with pytest.raises(RunError, match=r"a saved state was lost, as the instance that it was"):
        component.restore(saved)


def test_an_initialization_with_other_inputs_needs_no_reset(opened):
    """FMI 1.0: the reset of the lag sets its parameters to zero, so it would end at once."""
    component = opened("1").component
    component.prepare(0.1, HELD, {})
    for u in (2.0, U0):
        assert component.initialize(0.0, np.array([u, 0.0]))[Y] == u
    y = component.advance(times(), 0.1, line(times()))
    assert y == pytest.approx(run(opened("1"))[1:], abs=ROUNDING)


# --- discarded steps ---


HALVING = [("2", ("state", "any step")), ("3", ("any step",))]


@pytest.mark.parametrize(("version", "can"), HALVING)
def test_a_discarded_step_is_done_in_halves(opened, version, can):
    """From 0.4 s to 0.6 s only steps of 0.03 s: two steps of 0.1 s become four of 0.025 s each.

    FMI 2 leaves the state spoilt by 1e6, so it was restored; FMI 3 leaves it as it was. Parts have
    their own mean inputs, so x is that of steps of 0.025 s there: the exact solution for the means.
    """
    y = run(opened(version, *can, longest=0.03, begin=0.4, until=0.6))
    assert np.array_equal(np.diff(y[:, CALLS]), [1, 1, 1, 1, 4, 4, 1, 1, 1, 1])
    x = 0.0
    t = 0.0
    for h in [0.1] * 4 + [0.025] * 8 + [0.1] * 4:
        mean = U0 + SLOPE * (t + h / 2)
        x = mean + (x - mean) * np.exp(-h)
        t += h
    assert y[-1, X] == pytest.approx(x, abs=ROUNDING)


@pytest.mark.parametrize(("version", "can"), HALVING)
def test_halves_keep_to_the_ramp_of_an_interpolating_fmu(opened, version, can):
    """Wherever the step is cut, the inputs are on their ramp."""
    y = run(opened(version, "lines", *can, longest=0.03, begin=0.35, until=0.6))
    assert y[-1, CALLS] > 10
    assert abs(y[:, :2] - exact()).max() < ROUNDING


@pytest.mark.parametrize("blocks", [1, 7])
@pytest.mark.parametrize(("version", "can"), HALVING)
def test_halves_do_not_depend_on_blocks(opened, version, can, blocks):
    start = {"longest": 0.006, "begin": 0.25, "until": 0.6}
    whole = run(opened(version, *can, **start), step=0.02)
    assert whole[-1, CALLS] > 50
    assert np.array_equal(whole, run(opened(version, *can, **start), step=0.02, blocks=blocks))


@pytest.mark.parametrize(("version", "can"), HALVING)
def test_discards_without_end_stop_the_run(opened, version, can):
    """After 10 halvings, so below 0.1 s / 1024, with the rows that were completed."""
    fmu = opened(version, *can, longest=0.0, begin=0.5)
    message = (
        r"lag: discarded the step of 9\.76\d*e-05 s from t = 0\.5 s; no smaller one is tried, as "
        r"the communication step of 0\.1 s was halved 10 times"
    )
    with pytest.raises(Stopped, match=message) as stop:
        run(fmu)
    assert (stop.value.steps, stop.value.failed) == (5, True)


NO_WAY_BACK = (
    r"its state before the step cannot be restored \(canGetAndSetFMUstate is false, or not true\)"
)
ONE_STEP_SIZE = (
    r"it takes steps of one size only \(canHandleVariableCommunicationStepSize is false\)"
)


@pytest.mark.parametrize(
    ("version", "can", "reason"),
    [
        ("1", ("any step",), NO_WAY_BACK),
        ("2", ("any step",), NO_WAY_BACK),
        ("2", ("state",), ONE_STEP_SIZE),
        ("3", (), ONE_STEP_SIZE),
    ],
)
def test_a_discarded_step_stops_the_run_where_nothing_can_be_done(opened, version, can, reason):
    fmu = opened(version, *can, longest=0.03, begin=0.4)
    discarded = r"lag: discarded the step of 0\.1 s from t = 0\.4 s; no smaller one is tried"
    with pytest.raises(Stopped, match=f"{discarded}, as {reason}") as stop:
        run(fmu)
    assert (stop.value.steps, stop.value.failed) == (4, True)


# --- the end, and failures ---


@pytest.mark.parametrize("version", ["2", "3"])
def test_a_request_for_the_end_ends_the_run_with_the_rows_completed(opened, version):
    with pytest.raises(Stopped, match="the FMU requests the end of the run") as stop:
        run(opened(version, end=0.35))
    assert (stop.value.steps, stop.value.failed) == (3, False)


@pytest.mark.parametrize(
    "start", [{"status": -1.0, "event": 0.3, "announces": 1.0}, {"status": -2.0}]
)
def test_a_request_for_the_end_may_come_with_a_completed_step(opened, start):
    """In an event at 0.3 s, or with the step to it: its row counts, and the next is not begun."""
    fmu = opened("3", "events", "any step", end=0.3, **start)
    with pytest.raises(Stopped, match="the FMU requests the end of the run") as stop:
        run(fmu)
    assert (stop.value.steps, stop.value.failed) == (3, False)
    with pytest.raises(Stopped, match="the FMU requests the end of the run") as stop:
        fmu.component.advance(times()[3:], 0.1, line(times()[3:]))
    assert (stop.value.steps, stop.value.failed) == (0, False)


@pytest.mark.parametrize(("status", "name"), [(3.0, "error"), (4.0, "fatal")])
@pytest.mark.parametrize("version", ["1", "2", "3"])
def test_failures_carry_the_last_words(opened, version, status, name):
    call = rf"fmi{version}?DoStep returned \d \({name}\)"
    with pytest.raises(Stopped, match=f"{call}; its last message: error: out of petrol") as stop:
        run(opened(version, fail=0.35, status=status))
    assert (stop.value.steps, stop.value.failed) == (3, True)


# --- early returns and events ---


@pytest.mark.parametrize("can", [(), ("lines",)])
def test_early_returns_are_gone_on_from(opened, can):
    """At the multiples of 0.03 s the FMU returns: 10 steps of 0.1 s become 40 parts.

    x is what it is without returns. Where the mean is set, it is kept to the end of the step: the
    part up to the return had it, so that only with the same mean in the rest the integral of the
    input is right.
    """
    y = run(opened("3", *can, returns=0.03))
    hundredths = set(range(0, 100, 3)) | set(range(0, 100, 10))
    assert y[-1, CALLS] == len(hundredths)
    expected = run(opened("3", *can))
    assert y[:, :2] == pytest.approx(expected[:, :2], abs=ROUNDING)


def test_returns_without_end_stop_the_run(opened):
    message = r"lag: 1000 returns at t = 0\.0 s do not advance time in the step of 0\.1 s"
    with pytest.raises(Stopped, match=message) as stop:
        run(opened("3", returns=1e-14))
    assert stop.value.steps == 0


def test_any_number_of_returns_fits_into_one_step(opened):
    """2 000 of them, each of which advances time."""
    y = run(opened("3", returns=5e-5), stop=0.1)
    assert y[-1, CALLS] == pytest.approx(2000, abs=2)


def test_a_return_to_before_the_step_stops_the_run(opened):
    message = (
        r"lag: early return: expected a time within the step from 0\.0 s to 0\.1 s, "
        r"got -0\.25 s"
    )
    with pytest.raises(Stopped, match=message) as stop:
        run(opened("3", returns=-0.25))
    assert stop.value.steps == 0


@pytest.mark.parametrize("announces", [0.0, 1.0])
@pytest.mark.parametrize("period", [0.25, 0.2])
def test_time_events_are_met(opened, announces, period):
    """Announced or not, between and on communication points: x grows by 1 exactly there.

    The row shows it after the event.
    """
    y = run(opened("3", "events", "any step", event=period, announces=announces), u=rest)
    events = np.arange(1, 6) * period
    expected = []
    for t in times():
        past = events[events <= t + 1e-9]
        expected.append(np.exp(-(t - past)).sum())
    assert y[:, X] == pytest.approx(expected, abs=ROUNDING)


def test_an_event_at_the_start_is_seen(opened):
    """The first event iteration lets x grow by 1: in the outputs at the start.

    In initialization mode it did not happen yet.
    """
    component = opened("3", "events", "any step", event=10.0, announces=2.0).component
    component.prepare(0.1, HELD, {})
    assert component.initialize(0.0, np.zeros(2))[X] == 0.0
    assert component.outputs(0.0, np.zeros(2))[X] == 1.0
    y = component.advance(times(), 0.1, rest(times()))
    assert y[:, X] == pytest.approx(np.exp(-times()[1:]), abs=ROUNDING)


def test_an_fmu_of_one_step_size_meets_its_time_events_too_late_which_is_reported(opened):
    """The event at 0.25 s is met where the FMU itself returns; the step is not cut there."""
    fmu = opened("3", "events", event=0.25, announces=1.0)
    run(fmu)
    warning = (
        "lag: the time event at t = 0.25 s is met at the end of the communication step only, as it "
        "takes steps of one size (canHandleVariableCommunicationStepSize is false)"
    )
    assert fmu.drain() == [(0.2, "warning", "", warning)]


def test_discrete_inputs_are_set_in_event_mode(opened):
    """The FMU refuses them elsewhere; d steps by 1 at 0.3 s, x follows from there."""

    def u(t):
        return np.column_stack([np.zeros_like(t), (t > 0.29).astype(float)])

    y = run(opened("3", "events"), u=u)
    since_step = np.maximum(times() - 0.3, 0.0)
    assert y[:, X] == pytest.approx(1.0 - np.exp(-since_step), abs=ROUNDING)


def switched(t):
    """Return u = t, and d, which steps to 1 at 0.3 s and to 3 at 0.5 s."""
    d = (t > 0.29) + 2.0 * (t > 0.49)
    return np.column_stack([t, d])


@pytest.mark.parametrize("can", [(), ("state",)])
@pytest.mark.parametrize("blocks", [None, 1, 3])
def test_outputs_show_a_discrete_input_at_the_instant_it_changes(opened, can, blocks):
    """z = d at every communication point, y = x + u too; x follows d from there.

    Blocks of any size give the same.
    """
    shown = ("events", "D", "d is shown", *can)
    y = run(opened("3", *shown), u=switched, blocks=blocks)
    assert np.array_equal(y[:, Z], switched(times())[:, 1])
    assert y[:, Y] - y[:, X] == pytest.approx(times(), abs=ROUNDING)
    assert np.array_equal(y, run(opened("3", *shown), u=switched))


@pytest.mark.slow
def test_an_fmu_that_can_go_back_only_shows_what_a_discrete_input_would_do(opened):
    """Outputs for an input that a loop may still correct change nothing.

    What it shows at its instant is no first-order error.
    """

    def make():
        return opened("3", "events", "D", "state", "d is shown").component

    check_component(make, steps=12, h=0.1)
    check_rollback(make, steps=12, h=0.1)
    assert driven(make()).notes == ()


@pytest.mark.parametrize("events", [(), ("events",)])
@pytest.mark.parametrize("state", [(), ("state",)])
def test_an_fmu_that_cannot_go_back_keeps_its_events(opened, events, state):
    """Elsewhere a step to an event is undone, or there is none."""
    interface = opened("3", "D", *events, *state).component.interface
    assert interface.rollback == bool(state)
    assert interface.locates_events == bool(events)
    assert interface.keeps_events == (bool(events) and not state)


def test_no_event_happens_where_an_input_has_no_value(opened):
    """NaN as before is no change."""
    fmu = opened("3", "events", "d is shown", iterations=3.0)
    u = np.column_stack([np.zeros(11), np.full(11, np.nan)])
    fmu.component.prepare(0.1, HELD, {})
    fmu.component.initialize(0.0, u[0])
    fmu.component.advance(times()[:2], 0.1, u[:2])
    entered = []
    fmu._instance.enter_event_mode = lambda: entered.append(True)
    fmu.component.advance(times()[1:], 0.1, u[1:])
    assert entered == []


def test_an_event_without_end_stops_the_run(opened):
    fmu = opened("3", "events", "any step", event=0.25, announces=1.0, iterations=101.0)
    fmu.component.prepare(0.1, HELD, {})
    fmu.component.initialize(0.0, np.zeros(2))
    message = r"lag: the event iteration at t = 0\.0 s does not converge in 100 iterations"
    with pytest.raises(Stopped, match=message):
        fmu.component.advance(times(), 0.1, line(times()))
    y = run(opened("3", "events", "any step", event=0.25, iterations=100.0))
    assert y[-1, CALLS] == 12


# --- inner steps ---


@pytest.mark.parametrize("version", ["1", "2", "3"])
def test_an_inner_step_that_ignores_ours_is_reported(opened, version):
    """h = 1 ms, inner step 10 ms: once, at the end of the 10th of these, whatever the inputs do."""
    warning = (
        "lag: its outputs change at every 10th communication step only: it seems to keep an inner "
        "step of 0.01 s and to ignore the communication step of 0.001 s"
    )
    for u in (sine, lambda t: np.ones((len(t), 2))):
        fmu = opened(version, inner=0.01)
        run(fmu, step=1e-3, stop=0.2, u=u)
        assert fmu.drain() == [(0.1, "warning", "inner step", warning)]
        run(fmu, step=1e-3, stop=0.2, u=u)
        assert fmu.drain() == []


def steps_of_ten(t):
    """Return an input that itself changes at every 10th step only."""
    u = np.floor(np.arange(len(t)) / 10)
    return np.column_stack([u, np.zeros_like(t)])


def rest(t):
    return np.zeros((len(t), 2))


@pytest.mark.parametrize(("version", "start"), [("2", {}), ("3", {}), ("2", {"inner": 1e-3})])
@pytest.mark.parametrize("u", [rest, steps_of_ten, sine])
def test_no_inner_step_is_reported_where_there_is_none(opened, version, start, u):
    """At rest nothing moves; an inner step of 1 ms is the communication step."""
    fmu = opened(version, **start)
    run(fmu, step=1e-3, stop=0.3, u=u)
    assert fmu.drain() == []


@pytest.mark.parametrize("can", [(), ("any step",)])
def test_a_step_that_no_inner_step_divides_is_refused_where_steps_cannot_vary(opened, can):
    """FMI 3 says its inner step (fixedInternalStepSize)."""
    fmu = opened("3", "inner step of 30 ms", *can)
    if can:
        fmu.component.prepare(0.1, HELD, {})
        return
    message = (
        r"lag: the communication step 0\.1 s is not a whole number of the FMU's inner steps of "
        r"0\.03 s; nearest: 0\.09 s"
    )
    with pytest.raises(FmuError, match=message):
        fmu.component.prepare(0.1, HELD, {})
    fmu.component.prepare(0.09, HELD, {})


def test_an_inner_step_that_is_a_fraction_is_met_to_the_nanosecond(opened):
    """A scenario says "1/60", or what a nanosecond allows of it; a refusal says the former."""
    fmu = opened("3", "inner step at 60 Hz")
    fmu.component.prepare(1 / 60, HELD, {})
    fmu.component.prepare(0.016666667, HELD, {})
    fmu.component.prepare(0.5, HELD, {})
    with pytest.raises(FmuError, match=r"nearest: 1/60 s"):
        fmu.component.prepare(0.0166666, HELD, {})
