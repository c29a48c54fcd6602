"""PID controllers against closed forms, the recursion of the book, and scipy's integration."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cosim.blocks.pid import Pid, PidParameters
from cosim.errors import UsageError
from tests.blocks.stepping import drive, times

H = 1e-3


def rows(setpoint, measurement):
    return np.column_stack(np.broadcast_arrays(setpoint, measurement))


def test_the_proportional_part_weights_the_setpoint():
    """y = K (b r - z) + I(0), with the bits of plain Python."""
    u = np.random.default_rng(1).standard_normal((30, 2))
    y = drive(Pid(PidParameters(2.0, setpoint_weight=0.25, initial_integral=3.0)), u)
    expected = [2.0 * (0.25 * r - z) + 0.0 + 3.0 for r, z in u.tolist()]
    assert y[:, 0].tolist() == expected
    assert (y[:, 1] == 3.0).all()


def test_the_integral_part_of_an_error_that_grows_is_a_parabola():
    """r - z = 1 + 2 t: I = I(0) + K/Ti (t + t^2), a rounding of at most 1 a step."""
    t = times(500)
    parameters = PidParameters(3.0, integral_time=0.5, initial_integral=-1.0)
    y = drive(Pid(parameters), rows(1.0 + t, -t))
    integral = -1.0 + 6.0 * (t + t**2)
    np.testing.assert_allclose(y[:, 1], integral, rtol=0, atol=500 * 4.0 * 2.0**-53)
    np.testing.assert_allclose(y[:, 0], 3.0 * (1.0 + 2.0 * t) + y[:, 1], rtol=0, atol=1e-14)


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_the_derivative_part_is_filtered_and_begins_at_zero(weight):
    """Of z = -t and r = c t: D = K Td (c r' - z') (1 - exp(-N t/Td))."""
    t = times(300)
    parameters = PidParameters(
        2.0,
        derivative_time=0.05,
        derivative_gain_limit=4.0,
        derivative_setpoint_weight=weight,
        setpoint_weight=0.0,
    )
    y = drive(Pid(parameters), rows(t, -t))[:, 0]
    derivative = -2.0 * 0.05 * (1.0 + weight) * np.expm1(-80.0 * t)
    np.testing.assert_allclose(y, 2.0 * t + derivative, rtol=0, atol=300 * 2.4 * 2.0**-52)


def reference(parameters, tracking_time, r, z, t, h):
    """Integrate the equations of the module's docstring, from one communication point to the next.

    Between these r and z are straight lines; D is solved in their closed form.
    """
    p = parameters
    lower, upper = p.limits

    def right_hand_side(s, x, r0, r1, z0, z1):
        w = s / h
        setpoint = (1.0 - w) * r0 + w * r1
        measurement = (1.0 - w) * z0 + w * z1
        integral, filtered = x
        d = 0.0
        filter_rate = 0.0
        if p.derivative_time:
            d = -p.gain * p.derivative_gain_limit * measurement
            filter_rate = p.derivative_gain_limit / p.derivative_time
        v = p.gain * (p.setpoint_weight * setpoint - measurement) + integral + d - filtered
        back = (min(max(v, lower), upper) - v) / tracking_time
        slope = p.gain / p.integral_time * (setpoint - measurement) + back
        return [slope, filter_rate * (d - filtered)]

    d0 = -p.gain * p.derivative_gain_limit * z[0] if p.derivative_time else 0.0
    x = np.array([p.initial_integral, d0])
    found = [x[0]]
    for k in range(len(t) - 1):
        ends = (r[k], r[k + 1], z[k], z[k + 1])
        solved = solve_ivp(
            right_hand_side, (0.0, h), x, "DOP853", args=ends, rtol=1e-11, atol=1e-13
        )
        x = solved.y[:, -1]
        found.append(x[0])
    return np.array(found)


@pytest.mark.parametrize("tracking_time", [None, 1e-3, 5.0])
@pytest.mark.parametrize("limits", [(-1.0, 0.8), (None, 0.3), (-0.6, None)])
def test_back_calculation_is_exact_between_straight_lines(limits, tracking_time):
    """A PI controller that reaches and leaves its limits within steps, as scipy integrates it.

    scipy's steps are chosen by an error of 1e-11, of which 60 steps keep at most 1e-9.
    """
    h = 0.05
    t = times(60, 50_000_000)
    r = np.sin(5.0 * t)
    z = 0.3 * np.cos(11.0 * t)
    lower, upper = limits
    parameters = PidParameters(
        1.5, integral_time=0.4, lower=lower, upper=upper, tracking_time=tracking_time
    )
    y = drive(Pid(parameters), rows(r, z), step_ns=50_000_000)
    expected = reference(parameters, tracking_time or 0.4, r, z, t, h)
    np.testing.assert_allclose(y[:, 1], expected, rtol=0, atol=1e-9)
    at_limit = np.isin(y[:, 0], [value for value in limits if value is not None])
    assert 3 < at_limit.sum() < 57


def test_with_a_derivative_part_back_calculation_is_of_second_order():
    """Halving the step divides the error by four: D is a straight line over a step only nearly."""
    parameters = PidParameters(
        1.5,
        integral_time=0.4,
        derivative_time=0.2,
        derivative_gain_limit=5.0,
        lower=-1.0,
        upper=0.8,
    )
    errors = []
    for count in (60, 120):
        step_ns = 3_000_000_000 // count
        t = times(count, step_ns)
        r = np.sin(5.0 * t)
        z = 0.3 * np.cos(7.0 * t)
        y = drive(Pid(parameters), rows(r, z), step_ns=step_ns)[:, 1]
        expected = reference(parameters, math.sqrt(0.08), r, z, t, step_ns / 1e9)
        errors.append(abs(y - expected).mean())
    assert 3.0 < errors[0] / errors[1] < 5.0


def test_an_output_at_its_limit_is_followed_by_the_integral_part():
    """At the upper limit v - upper goes to K/Ti (r - z) Tt as exp(-t/Tt)."""
    parameters = PidParameters(2.0, integral_time=0.5, upper=1.0, tracking_time=0.1)
    t = times(400)
    y = drive(Pid(parameters), rows(np.ones(401), 0.0), held=True)
    # v(0) = 2, and (v - 1)' = 4 - (v - 1)/0.1
    excess = 0.4 + 0.6 * np.exp(-t / 0.1)
    np.testing.assert_allclose(y[:, 1], excess - 1.0, rtol=0, atol=400 * 2.0**-52)
    assert (y[:, 0] == 1.0).all()


def test_the_sampled_controller_is_the_recursion_of_the_book():
    """Astrom and Hagglund (2006), chapter 13: with D in their form, to a rounding a step."""
    period = 0.02
    K, Ti, Td, N, b, c, Tt = 1.5, 0.4, 0.1, 8.0, 0.7, 0.3, 0.25
    parameters = PidParameters(K, Ti, Td, N, b, c, -1.0, 0.8, Tt, 0.2)
    t = times(200, 20_000_000)
    r = np.sign(np.sin(2.0 * t))
    z = 0.5 * np.sin(3.0 * t)
    y = drive(Pid(parameters, period=period), rows(r, z), step_ns=20_000_000)
    integral, D, before = 0.2, 0.0, c * r[0] - z[0]
    expected = []
    for setpoint, measurement in zip(r, z, strict=True):
        now = c * setpoint - measurement
        D = Td / (Td + N * period) * D + K * Td * N / (Td + N * period) * (now - before)
        v = K * (b * setpoint - measurement) + integral + D
        u = min(max(v, -1.0), 0.8)
        expected.append((u, integral))
        integral += K * period / Ti * (setpoint - measurement) + period / Tt * (u - v)
        before = now
    np.testing.assert_allclose(y, expected, rtol=0, atol=200 * 10.0 * 2.0**-52)
    assert 20 < (y[:, 0] == 0.8).sum() < 180


@pytest.mark.parametrize(
    ("parameters", "period", "text"),
    [
        ({"gain": 0.0}, None, r"gain:.*other than 0.*0\.0"),
        ({"integral_time": 0.0}, None, r"integral_time:.*a time.*0\.0"),
        ({"derivative_time": -1.0}, None, r"derivative_time:.*time.*0 s.*-1\.0"),
        ({"derivative_gain_limit": 0.0}, None, r"derivative_gain_limit:.*0\.0"),
        ({"lower": 1.0, "upper": 1.0}, None, r"lower and upper:.*lower.*upper.*\(1\.0, 1\.0\)"),
        (
            {"tracking_time": 1.0, "upper": 1.0},
            None,
            r"integral_time and lower or upper:.*time",
        ),
        ({"tracking_time": 1.0, "integral_time": 1.0}, None, r"integral_time and lower or.*time"),
        (
            {"integral_time": 0.01, "upper": 1.0},
            0.02,
            r"tracking_time:.*period of 0\.02 s.*0\.01 s",
        ),
    ],
)
def test_parameters_that_make_no_controller_are_refused(parameters, period, text):
    """With what was found and what is needed."""
    with pytest.raises(UsageError, match=text):
        Pid(PidParameters(**{"gain": 1.0, **parameters}), period=period)


def test_the_setpoint_feeds_through_only_where_it_has_a_weight():
    """An I-PD controller can stand in a loop through its setpoint."""
    assert Pid(PidParameters(1.0)).interface.feeds("y") == ("setpoint", "measurement")
    without = {"setpoint_weight": 0.0, "derivative_setpoint_weight": 1.0}
    assert Pid(PidParameters(1.0, **without)).interface.feeds("y") == ("measurement",)
    both = Pid(PidParameters(1.0, derivative_time=1.0, **without))
    assert both.interface.feeds("y") == ("setpoint", "measurement")
    assert both.interface.feeds("integral") == ()
