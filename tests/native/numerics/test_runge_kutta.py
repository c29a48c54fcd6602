"""Explicit Runge-Kutta methods, against closed forms and scipy's."""

import math
import sys

import numpy as np
import pytest
from scipy.integrate import DOP853, RK23, RK45, solve_ivp

from cosim.errors import RunError
from cosim.native.numerics.runge_kutta import EMBEDDED, EXPLICIT, FIXED_STEP, RungeKutta

SCIPY = {"RK23": RK23, "RK45": RK45, "DOP853": DOP853}
ORDERS = {"euler": 1, "rk4": 4, "RK23": 3, "RK45": 5, "DOP853": 8}
WITHIN = {"euler": 1, "rk4": 4, "RK23": 3, "RK45": 4, "DOP853": 7}  # of the dense output


def riccati(t, x):
    """Return x' = -2 t x^2: x = 1 / (1 + t^2) from 1; not linear, and not autonomous."""
    return -2.0 * t * x * x


def bell(t):
    return 1.0 / (1.0 + t * t)


def kepler(t, x):
    """Return the motion of a planet, whose period is 2 pi from ``orbit(0, e)``."""
    r = math.hypot(x[0], x[1])
    return np.array([x[2], x[3], -x[0] / r**3, -x[1] / r**3])


def orbit(t, e):
    """Return its position and velocity: E - e sin(E) = t by Newton's method."""
    E = t
    for _ in range(20):
        E -= (E - e * math.sin(E) - t) / (1.0 - e * math.cos(E))
    b = math.sqrt(1.0 - e * e)
    r = 1.0 - e * math.cos(E)
    velocity = (-math.sin(E) / r, b * math.cos(E) / r)
    return np.array([math.cos(E) - e, b * math.sin(E), *velocity])


def started(method, f, t, x, *, rtol=1e-9, nominals=None):
    x = np.array(x, np.float64)
    solver = RungeKutta(method, f, len(x), rtol=rtol)
    solver.start(t, x, np.ones(len(x)) if nominals is None else nominals)
    return solver


def reach(solver, t, ends):
    """Go through these times, with each of them as the bound of the steps until there."""
    for end in ends:
        while t < end:
            t = solver.step(end)
    return solver.at(t)


@pytest.mark.parametrize("method", EXPLICIT)
def test_halving_the_step_divides_the_error_by_two_to_the_order(method):
    """Over two seconds of an orbit; a tolerance of 10 accepts every step.

    The steps of the low orders are shorter: there the next term of the error is far smaller.
    """
    order = ORDERS[method]
    steps = {1: 2000, 3: 300, 4: 200, 5: 160, 8: 12}[order]

    def error(steps):
        solver = started(method, kepler, 0.0, orbit(0.0, 0.3), rtol=10.0)
        x = reach(solver, 0.0, 2.0 * np.arange(1, steps + 1) / steps)
        return abs(x - orbit(2.0, 0.3)).max()

    assert abs(math.log2(error(steps) / error(2 * steps)) - order) < 0.3


@pytest.mark.parametrize("method", EXPLICIT)
def test_the_dense_output_is_of_its_order(method):
    """Of one step h from an exact value, the largest error within it falls with h^(order + 1)."""

    def error(h):
        solver = started(method, kepler, 1.0, orbit(1.0, 0.3), rtol=10.0)
        assert solver.step(1.0 + h) == 1.0 + h
        times = 1.0 + h * np.linspace(0.05, 0.95, 19)
        return max(abs(solver.at(t) - orbit(t, 0.3)).max() for t in times)

    h = {1: 0.01, 3: 0.02, 4: 0.04, 5: 0.04, 8: 0.2}[ORDERS[method]]
    assert abs(math.log2(error(h) / error(h / 2)) - WITHIN[method] - 1) < 0.3


@pytest.mark.parametrize("method", EXPLICIT)
def test_the_dense_output_ends_at_both_ends_of_the_step(method):
    """To the last bit there; close to them it tends to the same values."""
    solver = started(method, kepler, 0.0, orbit(0.0, 0.3), rtol=1e-6)
    reached = solver.step(0.1)
    assert np.array_equal(solver.at(0.0), orbit(0.0, 0.3))
    end = solver.at(reached)
    # |x'| < 2: 1e-12 s before the end x differs by less than 2e-12, and rounding
    assert abs(solver.at(1e-12) - orbit(0.0, 0.3)).max() < 3e-12
    assert abs(solver.at(reached - 1e-12) - end).max() < 3e-12


@pytest.mark.parametrize("method", EMBEDDED)
def test_a_step_is_that_of_scipy(method):
    """The first step, its state and the states within it: the formulas in another order of sums."""
    x = orbit(0.0, 0.5)
    solver = started(method, kepler, 0.0, x, rtol=1e-7)
    other = SCIPY[method](kepler, 0.0, x, 9.0, rtol=1e-7, atol=1e-7)
    reached = solver.step(9.0)
    other.step()
    within = other.dense_output()
    assert reached == pytest.approx(other.t, rel=1e-14)
    for s in (0.1, 0.4, 0.8, 1.0):
        # weights of the extra stages of DOP853 of up to 400 times slopes of 4, over a step of 0.1
        assert solver.at(s * reached) == pytest.approx(within(s * reached), rel=1e-13, abs=1e-13)


@pytest.mark.parametrize("method", EMBEDDED)
@pytest.mark.parametrize("problem", ["kepler", "van der pol", "lorenz"])
def test_the_solution_is_that_of_scipy_within_the_tolerance(method, problem):
    """Both are some hundred tolerances off the reference, with as many evaluations to a fifth."""
    f, x, end = {
        "kepler": (kepler, orbit(0.0, 0.5), 4.0),
        "van der pol": (
            lambda t, x: np.array([x[1], 2.0 * (1.0 - x[0] ** 2) * x[1] - x[0]]),
            np.array([2.0, 0.0]),
            6.0,
        ),
        "lorenz": (
            lambda t, x: np.array(
                [10.0 * (x[1] - x[0]), x[0] * (28.0 - x[2]) - x[1], x[0] * x[1] - 8.0 / 3.0 * x[2]]
            ),
            np.array([1.0, 1.0, 1.0]),
            1.0,
        ),
    }[problem]
    rtol = 1e-6 if method == "RK23" else 1e-9
    evaluations = []

    def counted(t, x):
        evaluations.append(t)
        return f(t, x)

    reference = solve_ivp(f, (0.0, end), x, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    other = solve_ivp(f, (0.0, end), x, method=method, rtol=rtol, atol=rtol)
    mine = reach(started(method, counted, 0.0, x, rtol=rtol), 0.0, [end])
    size = max(1.0, abs(reference).max())
    error = abs(mine - reference).max()
    other_error = abs(other.y[:, -1] - reference).max()
    assert error < 3.0 * other_error + 10.0 * rtol * size
    assert len(evaluations) == pytest.approx(other.nfev, rel=0.2)


@pytest.mark.parametrize("method", EMBEDDED)
def test_the_step_follows_a_solution_that_changes_its_pace(method):
    """x = atan(1000 (t - 1/2)): short steps in the pulse of its derivative, long ones elsewhere."""

    def pulse(t, x):
        return np.array([1e3 / (1.0 + (1e3 * (t - 0.5)) ** 2)])

    rtol = 1e-5 if method == "RK23" else 1e-8
    solver = started(method, pulse, 0.0, [-math.atan(500.0)], rtol=rtol)
    times = [0.0]
    worst = 0.0
    while times[-1] < 1.0:
        t = solver.step(1.0)
        times.append(t)
        worst = max(worst, abs(solver.at(t)[0] - math.atan(1e3 * (t - 0.5))))
    # some hundred steps with an error of rtol (1 + pi/2) each
    assert worst < 300.0 * rtol
    steps = np.diff(times)
    centers = 0.5 * (np.array(times[1:]) + np.array(times[:-1]))
    assert steps[abs(centers - 0.5) > 0.2].max() > 30.0 * steps[abs(centers - 0.5) < 1e-3].max()


@pytest.mark.parametrize("method", EMBEDDED)
def test_each_state_is_measured_by_its_own_scale(method):
    """States of 1e-9 and 1e9, which need nominal values as small and as large."""

    def oscillator(t, x):
        return np.array([x[1], -x[0], x[3], -4.0 * x[2]])

    scale = np.array([1e-9, 1e-9, 1e9, 1e9])
    rtol = 1e-5 if method == "RK23" else 1e-8
    start = scale * [1.0, 0.0, 1.0, 0.0]
    solver = started(method, oscillator, 0.0, start, rtol=rtol, nominals=scale)
    x = reach(solver, 0.0, [3.0])
    exact = scale * [math.cos(3.0), -math.sin(3.0), math.cos(6.0), -2.0 * math.sin(6.0)]
    # at most a few dozen steps of some tolerances each
    assert (abs(x - exact) / scale).max() < 100.0 * rtol


@pytest.mark.parametrize("method", EXPLICIT)
def test_steps_after_save_come_again_after_restore(method):
    """Bit for bit, as often as asked, within a step too; also into another solver."""
    solver = started(method, kepler, 0.0, orbit(0.0, 0.3), rtol=1e-6)
    reach(solver, 0.0, [0.1, 0.2])
    saved = solver.save()

    def later(solver):
        reached = solver.step(0.5)
        within = solver.at(0.2 + 0.3 * (reached - 0.2))
        return [reached, *within, *reach(solver, reached, [0.6, 0.7])]

    first = later(solver)
    other = started(method, kepler, 3.0, orbit(0.0, 0.9), rtol=1e-6)
    for again in (solver, other, solver):
        again.restore(saved)
        assert later(again) == first


@pytest.mark.parametrize("method", EXPLICIT)
def test_nothing_is_evaluated_beyond_the_end_of_a_step(method):
    """What the inputs do there is not known yet; within a step as well."""
    times = []

    def watched(t, x):
        times.append(t)
        return riccati(t, x)

    solver = started(method, watched, 0.0, [1.0], rtol=1e-6)
    t = 0.0
    for end in (1e-3, 0.1, 0.7):
        while t < end:
            begin = t
            t = solver.step(end)
            solver.at(0.5 * (begin + t))
            assert max(times) <= end


@pytest.mark.parametrize(("method", "stages"), [("RK45", 6), ("DOP853", 12), ("RK23", 3)])
def test_the_last_slope_of_a_step_is_the_first_of_the_next(method, stages):
    """A step costs as many evaluations as stages, a start two more: x' and the first step."""
    solver = started(method, riccati, 0.5, [bell(0.5)], rtol=10.0)
    reach(solver, 0.5, [0.6, 0.7, 0.8, 0.9])
    assert solver.evaluations == 4 * stages + 2


@pytest.mark.parametrize("method", EMBEDDED)
def test_a_short_rest_of_a_communication_step_does_not_shorten_the_next_steps(method):
    """Steps that are cut to 1e-9 s leave what the tolerance allows as it was."""
    solver = started(method, riccati, 0.0, [1.0], rtol=1e-6)
    reach(solver, 0.0, [0.2])
    long = solver.step(1.0) - 0.2
    begin = 0.2 + long
    short = solver.step(begin + 1e-9)
    assert solver.step(1.0) - short > 0.5 * long


def test_no_step_is_a_tiny_rest():
    """A bound one percent beyond the step that is due is reached with it."""
    first = started("RK45", riccati, 0.0, [1.0]).step(1.0)
    bound = 1.005 * first
    assert started("RK45", riccati, 0.0, [1.0]).step(bound) == bound


@pytest.mark.parametrize("method", EXPLICIT)
def test_an_exception_of_the_right_hand_side_comes_through_and_the_step_can_be_repeated(method):
    """The very exception, at whatever evaluation; what follows has the bits of a run without it."""
    for fails_at in (1, 2, 4, 7, 11):
        calls = []

        def fragile(t, x, calls=calls, fails_at=fails_at):
            calls.append(t)
            if len(calls) == fails_at:
                raise RunError("it broke")
            return riccati(t, x)

        solver = started(method, fragile, 0.0, [1.0], rtol=1e-6)
        failures = []
        t = 0.0
        for end in (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1):
            while t < end:
                try:
                    t = solver.step(end)
                except RunError as error:
                    failures.append(str(error))
        assert failures == ["it broke"]
        whole = started(method, riccati, 0.0, [1.0], rtol=1e-6)
        ends = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1]
        assert solver.at(t).tolist() == pytest.approx(reach(whole, 0.0, ends).tolist(), rel=1e-15)


def test_an_interrupt_that_ctypes_drops_is_raised_all_the_same(monkeypatch):
    """Ctrl-C at the very first instruction of the callback is before any ``try`` in it."""
    dropped = []
    monkeypatch.setattr(sys, "unraisablehook", dropped.append)
    solver = started("rk4", riccati, 0.0, [1.0])

    def interrupt(frame, event, argument):
        if frame.f_code.co_name == "_evaluate":
            sys.settrace(None)
            raise KeyboardInterrupt

    tracer = sys.gettrace()
    sys.settrace(interrupt)
    try:
        with pytest.raises(KeyboardInterrupt):
            solver.step(1.0)
    finally:
        sys.settrace(tracer)
    assert len(dropped) == 1
    assert solver.step(2.0) == 2.0


@pytest.mark.parametrize("method", EMBEDDED)
def test_a_solution_that_ends_is_an_error(method):
    """x' = x^2 from 1 has no value at t = 1; neither has x' = nan."""
    message = f"solver {method}: at t = {{}} s the tolerance requires steps below"
    solver = started(method, lambda t, x: x * x, 0.0, [1.0])
    with pytest.raises(RunError, match=message.format(r"(1\.0|0\.999)\d*")):
        reach(solver, 0.0, [2.0])
    solver = started(method, lambda t, x: x * np.nan, 0.0, [1.0])
    with pytest.raises(RunError, match=message.format(r"0\.0")):
        solver.step(1.0)


@pytest.mark.parametrize("method", EMBEDDED)
def test_zeros_and_extremes_are_integrated(method):
    """x' = 0 from 0, and slopes of 1e100 and of 1e-100."""
    for slope in (0.0, 1e100, 1e-100):
        solver = started(method, lambda t, x, slope=slope: np.array([slope]), 0.0, [0.0])
        assert reach(solver, 0.0, [0.5, 2.0])[0] == pytest.approx(2.0 * slope, rel=1e-14)


@pytest.mark.parametrize("method", FIXED_STEP)
def test_within_a_fixed_step_is_a_shorter_step(method):
    """Bit for bit, so that locating an event adds no error."""
    solver = started(method, kepler, 0.0, orbit(0.0, 0.3))
    shorter = started(method, kepler, 0.0, orbit(0.0, 0.3))
    solver.step(0.1)
    shorter.step(0.04)
    assert np.array_equal(solver.at(0.04), shorter.at(0.04))
    assert np.array_equal(solver.at(0.1), solver.at(0.1))


@pytest.mark.parametrize("method", FIXED_STEP)
def test_states_that_know_nothing_of_each_other_have_the_bits_that_each_has_alone(method):
    """However many there are: few and many are summed by different loops, in the same order."""
    rates = np.random.default_rng(5).standard_normal(20)
    start = np.random.default_rng(6).standard_normal(20)
    times = [0.1, 0.25, 0.3]

    def alone(i):
        solver = started(method, lambda t, x: math.sin(t) - rates[i] * x * x, 0.0, [start[i]])
        return reach(solver, 0.0, times)[0]

    expected = np.array([alone(i) for i in range(20)])
    for n in (2, 7, 8, 20):
        solver = started(method, lambda t, x: math.sin(t) - rates[: len(x)] * x * x, 0.0, start[:n])
        assert reach(solver, 0.0, times).tobytes() == expected[:n].tobytes()
