"""Reconstruction of delta: noise gains, biases and lags against closed forms and brute force."""

import cmath
import math
from dataclasses import replace
from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import savgol_coeffs

from cosim.blocks.averages import Windowed
from cosim.blocks.observer import averaged_observer, consistent_observer
from cosim.errors import AssumptionError
from cosim.native.numerics.linear import DiscretizedDynamics, first_order_hold
from cosim.theory.observers.observer import (
    design,
    identification_start_time,
    realize,
    realize_averages,
)
from cosim.theory.plants.descriptor import reduce
from cosim.theory.reconstruction.filter_choice import Conditions, choose
from cosim.theory.reconstruction.filters import (
    ConsistentFilter,
    FirstOrderFilter,
    SavitzkyGolay,
)
from cosim.theory.reconstruction.noise_gain import noise_gain, windowed_noise_gain
from cosim.theory.reconstruction.noise_level import noise_level
from tests.theory.academic import academic, ordinary

H = 1e-3
FREE = np.zeros(1, np.bool_)
HELD = np.ones(1, np.bool_)


def all_of_x_b():
    """Return a system whose algebraic state depends on the disturbance."""
    system = replace(academic(), Bd=np.array([[1.0], [0.0], [0.5]]), C=np.array([[2, 0, 0]]))
    return reduce(system)


# --- what each costs ---


def test_the_papers_filter_multiplies_noise_by_764():
    """With filter_rate 1e3 and 1 ms; 2^(1/2) s / (1 + a)^(1/2) with a = exp(-1)."""
    a = math.exp(-1.0)
    closed_form = (1.0 - a) / H * math.sqrt(2.0 / (1.0 + a))
    assert round(closed_form) == 764
    assert FirstOrderFilter(1e3, H).noise_gain() == pytest.approx(closed_form, rel=1e-14)
    assert ConsistentFilter(1e3, H).noise_gain() == FirstOrderFilter(1e3, H).noise_gain()


def test_a_window_of_200_ms_leaves_noise_of_about_1():
    """Deviation of the slope of a line or a cubic over 401 samples, from the power sums."""
    S2, S4, S6 = (2 * sum(k**p for k in range(1, 201)) for p in (2, 4, 6))
    line = math.sqrt(1 / S2) / H
    cubic = math.sqrt(Fraction(S6, S2 * S6 - S4**2)) / H
    assert (round(line, 2), round(cubic, 2)) == (0.43, 1.08)
    for order, gain in ((1, line), (2, line), (3, cubic), (4, cubic)):
        window = SavitzkyGolay(200, order, H)
        assert window.noise_gain() == pytest.approx(gain, rel=1e-14)
        assert np.sqrt(np.sum(window.taps**2)) == pytest.approx(gain, rel=1e-13)


def test_the_noise_gain_of_the_filter_is_that_of_its_discretization(subtests):
    """The sum of the squared responses of q' = rate (w - q) to one sample."""
    for rate, held in product([1.0, 200.0, 1e4], [False, True]):
        with subtests.test(rate=rate, held=held):
            discrete = first_order_hold(
                np.array([[-rate]]), np.array([[rate]]), H, HELD if held else FREE
            )
            gain = noise_gain(discrete, np.array([[-rate]]), np.array([[rate]]))
            # cancellation in Ad + B0 + B1 - 1
            assert gain[0, 0] == pytest.approx(
                FirstOrderFilter(rate, H).noise_gain(held=held), rel=1e-12
            )


@given(st.integers(1, 60), st.integers(1, 7))
def test_the_taps_are_those_of_savitzky_and_golay(half_width, order):
    """As scipy computes them, to its own rounding."""
    order = min(order, 2 * half_width)
    window = SavitzkyGolay(half_width, order, 0.5)
    expected = savgol_coeffs(2 * half_width + 1, order, deriv=1, delta=0.5, use="dot")
    # scipy solves with unscaled powers of k: their condition
    condition = np.linalg.cond(np.vander(np.arange(-half_width, half_width + 1.0), order + 1))
    assert np.abs(window.taps - expected).max() <= 1e-15 * condition * np.abs(expected).max()


def test_the_taps_are_rounded_once():
    """A line: k / S2 / h, exactly rounded."""
    taps = SavitzkyGolay(200, 2, 1.0).taps
    S2 = 2 * sum(k * k for k in range(1, 201))
    assert taps.tolist() == [k / S2 for k in range(-200, 201)]


@given(st.integers(1, 40), st.integers(1, 6))
def test_polynomials_of_the_order_have_no_error(half_width, order):
    """The fit of a polynomial is the polynomial, and the weights say the same of increments."""
    order = min(order, 2 * half_width)
    window = SavitzkyGolay(half_width, order, 1.0)
    k = np.arange(-half_width, half_width + 1) / half_width
    for degree in range(order + 1 + order % 2):
        values = k**degree
        slope = 1.0 / half_width if degree == 1 else 0.0
        increments = np.diff(values)
        # rounding of sums of terms whose absolute values add up to at most this
        bound = 4e-16 * (2 * half_width + 1) * np.sum(np.abs(window.taps))
        assert abs(window.taps @ values - slope) <= bound
        bound = 4e-16 * (2 * half_width + 1) * np.sum(np.abs(window.weights))
        assert abs(window.weights @ increments - slope) <= bound


def test_the_weights_are_a_moving_average():
    """Their sum is 1 over the window."""
    for order in (1, 3, 5):
        window = SavitzkyGolay(50, order, 0.25)
        assert window.weights.sum() * 0.25 == pytest.approx(1.0, rel=1e-13)
        assert (window.lag, window.window) == (12.5, 25.0)


RECONSTRUCTIONS = [
    FirstOrderFilter(50.0, H),
    FirstOrderFilter(1e3, H),
    ConsistentFilter(50.0, H),
    ConsistentFilter(1e3, H),
    *(SavitzkyGolay(20, order, H) for order in range(1, 7)),
]


def test_the_bias_is_what_slow_sines_lose(subtests):
    """The response is 1 + coefficient (i rate)^n + ..., with n lower by 1 where w is meant."""
    for number, reconstruction in enumerate(RECONSTRUCTIONS):
        with subtests.test(number=number):
            bias = reconstruction.bias
            n = bias.derivative - (bias.of == "G w")
            rate = 20.0 if n > 2 else 0.05
            error = reconstruction.response(rate) - 1.0
            # the next term is smaller by about (rate x time)^2, or by rate x time where n is odd
            assert error == pytest.approx(bias.coefficient * (1j * rate) ** n, rel=0.06)


def test_the_response_of_a_window_is_that_of_its_taps():
    """The slope of exp(i rate t)/(i rate) in the middle."""
    window = SavitzkyGolay(30, 4, H)
    times = np.arange(-30, 31) * H
    for rate in (3.0, 40.0, 300.0):
        signal = np.exp(1j * rate * times) / (1j * rate)
        assert window.response(rate) == pytest.approx(window.taps @ signal, rel=1e-11)
    assert window.response(0.0) == 1.0


def test_unsuitable_filters_are_refused():
    """A window needs samples, a polynomial as many as it has coefficients, a filter a rate."""
    for arguments, message in (
        ((0, 1, H), r"half width: .* 1 to 100000 samples, got 0"),
        ((100_001, 1, H), r"half width: .* got 100001"),
        ((1, 3, H), r"order: .* 1 to 10, and less than the 3 samples, got 3"),
        ((20, 0, H), r"order: .* got 0"),
        ((20, 11, H), r"order: .* got 11"),
        ((20, 2, 0.0), r"step: .* got 0"),
    ):
        with pytest.raises(AssumptionError, match=message):
            SavitzkyGolay(*arguments)
    for kind in (FirstOrderFilter, ConsistentFilter):
        with pytest.raises(AssumptionError, match=r"filter_rate: .* got 0"):
            kind(0.0, H)
        with pytest.raises(AssumptionError, match=r"step: .* got inf"):
            kind(1.0, math.inf)


# --- observers ---


def response(system, rate):
    """Return C (s I - A)^-1 B + D at s = i rate."""
    n = len(system.A)
    return system.C @ np.linalg.solve(1j * rate * np.eye(n) - system.A, system.B) + system.D


def of_delta(reduced, rate):
    """Return x_a, x_b and w of the plant for delta = exp(i rate t)."""
    n = len(reduced.A_a)
    x_a = np.linalg.solve(1j * rate * np.eye(n) - reduced.A_a, reduced.B_2a)[:, 0]
    x_b = reduced.Kx @ x_a + reduced.Kd[:, 0]
    return x_a, x_b, reduced.C3 @ x_a


def test_the_papers_filter_makes_an_error_of_w(subtests):
    """Through the plant to the estimate: delta + G (F(s) - 1) s w, whatever delta is."""
    for rate in [0.3, 7.0, 500.0]:
        with subtests.test(rate=rate):
            reduced = reduce(academic())
            designed = design(reduced, poles=[-4.0], filter_rate=50.0)
            _, _, w = of_delta(reduced, rate)
            estimates = response(realize(reduced, designed), rate) @ np.concatenate(
                [np.zeros(1), w]
            )
            filtered = 50.0 / (50.0 + 1j * rate)
            w_dot = 1j * rate * w[0]
            expected = 1.0 + designed.G[0, 0] * (filtered - 1.0) * w_dot
            assert estimates[2] == pytest.approx(expected, rel=1e-12)


def test_rate_and_level_of_the_window_are_delta(subtests):
    """rate + level' is delta, and x_b where that depends on it."""
    for rate in [0.3, 7.0]:
        with subtests.test(rate=rate):
            for reduced in (reduce(academic()), all_of_x_b()):
                realization = realize_averages(reduced, design(reduced, poles=[-4.0]))
                _, x_b, w = of_delta(reduced, rate)
                outputs = response(realization.system, rate) @ np.concatenate([np.zeros(1), w])
                width = realization.width
                sums = outputs[-2 * width : -width] + 1j * rate * outputs[-width:]
                assert sums[0] == pytest.approx(1.0, rel=1e-12)
                if width > 1:
                    assert sums[1] == pytest.approx(x_b[0], rel=1e-12)
                else:
                    assert outputs[2] == pytest.approx(x_b[0], rel=1e-12)


def test_a_consistent_filter_starts_without_a_transient_of_x_b():
    """What (8) has without delta is there from the start, and delta is 0."""
    reduced = all_of_x_b()
    averaged = averaged_observer(reduced, design(reduced, poles=[-4.0]))
    component = consistent_observer(averaged, reduced, 50.0)
    component.prepare(H, np.zeros(2, np.bool_), {})
    u = np.array([0.7, -1.2])
    y = component.initialize(0.0, u)
    columns = component.interface.output_columns()
    assert y[columns["delta"]] == 0.0
    expected = reduced.Kx @ y[columns["x_a"]] + reduced.Ku @ u[:1]
    assert y[columns["x_b"]] == pytest.approx(expected, rel=1e-14)


def test_an_observer_without_a_filter_has_no_realization_with_one():
    """Only a window does without."""
    reduced = reduce(academic())
    with pytest.raises(AssumptionError, match=r"filter_rate: .* got none"):
        realize(reduced, design(reduced, poles=[-4.0]))


def run_average(reconstruction, delta, y, n):
    """Return delta hat of an observer of x' = delta, y = x, and delta at its instants."""
    reduced = reduce(ordinary([[0.0]], [[1.0]], [[1.0]]))
    averaged = averaged_observer(reduced, design(reduced, L=[4.0]))
    if isinstance(reconstruction, SavitzkyGolay):
        component = Windowed(averaged, reconstruction.weights)
    else:
        component = consistent_observer(averaged, reduced, reconstruction.rate)
    component.prepare(H, HELD, {})
    t = np.arange(n + 1) * H
    u = y(t)[:, np.newaxis]
    first = component.initialize(0.0, u[0])
    rows = component.advance(t, H, u)
    column = component.interface.output_columns()["delta"].start
    estimated = np.concatenate([first[[column]], rows[:, column]])
    return estimated, delta(t - reconstruction.lag)


def test_a_polynomial_delta_has_no_error_up_to_the_order(subtests):
    """The output is one degree higher; there is no value until the window is full."""
    for order, degree in [(1, 1), (2, 1), (3, 3), (4, 3), (6, 5)]:
        with subtests.test(order=order):
            window = SavitzkyGolay(20, order, H)
            polynomial = np.polynomial.Polynomial([0.3, -1.0, 2.0, 0.7, -3.0, 5.0][: degree + 1])
            estimated, true = run_average(window, polynomial, polynomial.integ(k=[1.5]), 400)
            assert np.isnan(estimated[:40]).all()
            # rounding of y of up to 2, by the sum of the taps
            bound = 1e-15 * np.abs(window.taps).sum()
            assert np.abs(estimated[40:] - true[40:]).max() <= bound
            higher = polynomial + 100.0 * np.polynomial.Polynomial.basis(degree + 1)
            estimated, true = run_average(window, higher, higher.integ(k=[1.5]), 400)
            assert np.abs(estimated[40:] - true[40:]).max() > 10 * bound


def test_the_error_of_a_sine_is_the_predicted_one(subtests):
    """The response, the lag taken out, on a plant without dynamics; y is held between samples."""
    for number, reconstruction in enumerate(
        [SavitzkyGolay(20, 4, H), ConsistentFilter(200.0, H), ConsistentFilter(3e3, H)]
    ):
        with subtests.test(number=number):
            rate = 60.0
            response_there = reconstruction.response(rate)
            estimated, _ = run_average(
                reconstruction, np.cos, lambda t, rate=rate: np.sin(rate * t) / rate, 400
            )
            instants = np.arange(401) * H - reconstruction.lag
            expected = (response_there * np.exp(1j * rate * instants)).real
            # the start of the filter has decayed by exp(-200 x 0.3)
            assert estimated[300:] == pytest.approx(expected[300:], abs=1e-12)


def test_a_line_has_no_error_but_the_lag_of_the_consistent_filter():
    """Behind the start; at the paper's rate and 1 ms the lag is 1.082 ms, not 1 ms."""
    line = np.polynomial.Polynomial([0.3, -2.0])
    consistent = ConsistentFilter(1e3, H)
    estimated, true = run_average(consistent, line, line.integ(), 400)
    assert np.abs(estimated[50:] - true[50:]).max() < 1e-12
    assert consistent.lag == pytest.approx(0.5e-3 / math.tanh(0.5), rel=1e-15)


def test_the_noise_gain_counts_all_that_reaches_delta():
    """The sum of the squared responses to one sample of y, long enough to have passed."""
    reduced = reduce(academic())
    window = SavitzkyGolay(15, 4, H)
    averaged = averaged_observer(reduced, design(reduced, L=[4.0, 0.0]))
    component = Windowed(averaged, window.weights)
    arrays = component.prepare(H, np.zeros(2, np.bool_), {})
    discrete = DiscretizedDynamics(arrays["Ad"], arrays["B0"], arrays["B1"])
    increments = (arrays["Jx"], arrays["J0"], arrays["J1"])
    gains = windowed_noise_gain(discrete, increments, arrays["weights"])
    steps = 20_000  # exp(-2 x 20) is left
    t = np.arange(steps + 1) * H
    for column in range(2):
        u = np.zeros((steps + 1, 2))
        u[100, column] = 1.0
        component.initialize(0.0, u[0])
        delta = component.advance(t, H, u)[40:, -1]
        assert gains[0, column] == pytest.approx(math.sqrt(np.sum(delta**2)), rel=1e-9)
    # the drift adds to the gain of the derivative what a window averages
    assert gains[0, 1] == pytest.approx(window.noise_gain(), rel=0.01)


def test_the_noise_gain_does_not_depend_on_how_slow_an_observer_is():
    """The sum of a geometric series, of 1e12 steps here."""
    a = 1.0 - 2.0**-40
    discrete = replace(
        first_order_hold(np.zeros((1, 1)), np.ones((1, 1)), 1.0, HELD), Ad=np.array([[a]])
    )
    gain = noise_gain(discrete, np.ones((1, 1)), np.zeros((1, 1)))
    # rounding of 1 - a^2 in the doubled powers
    assert gain[0, 0] == pytest.approx(math.sqrt(1.0 / (1.0 - a * a)), rel=1e-3)


def test_a_window_adds_its_length_to_the_start_time():
    """(36): nothing older has a weight, so that no fraction of it is left."""
    options = {"lambda_obs": 2.0, "delays": (1.0, 3.0)}
    fractions = {"epsilon_observer": 1e-3, "epsilon_filter": 1e-3}
    times = identification_start_time(window=0.4, **options, **fractions)
    assert times.T_f == 0.4
    assert times.T_id == math.log(1e3) / 2.0 + 0.4 + 3.0
    unfiltered = identification_start_time(**options, **fractions)
    assert unfiltered.T_f == 0.0
    assert unfiltered.T_id == math.log(1e3) / 2.0 + 3.0
    with pytest.raises(AssumptionError, match="filter_rate or window, got both"):
        identification_start_time(window=0.4, filter_rate=1.0, **options, **fractions)
    with pytest.raises(AssumptionError, match=r"window: .* time, got 0"):
        identification_start_time(window=0.0, **options, **fractions)


# --- the choice ---


def test_the_choice_is_the_best_of_all_windows(subtests):
    """Against every length up to the widest, by the response and the noise of each."""
    for noise, bandwidth in product([0.0, 1e-9, 1e-5, 1e-2, 0.3], [0.05, 0.3, 2.0]):
        with subtests.test(noise=noise, bandwidth=bandwidth):
            conditions = Conditions(noise, 2.0, bandwidth, 1.0)
            choice = choose(conditions)
            best = math.inf
            for order in (2, 4, 6):
                for half_width in range((order + 1) // 2, math.floor(4.4 / bandwidth) + 1):
                    window = SavitzkyGolay(half_width, order, 1.0)
                    by_noise = noise * math.sqrt(np.sum(window.taps**2))
                    k = np.arange(-half_width, half_width + 1)
                    slope = window.taps @ np.exp(1j * bandwidth * k) / (1j * bandwidth)
                    best = min(best, math.hypot(by_noise, 2.0 * abs(slope - 1.0)))
            # both sides round their biases by 1e-16 times the sum of the taps
            assert choice.error.total == pytest.approx(best, rel=1e-6, abs=1e-14)
            assert choice.error.total == conditions.error(choice.window).total


def test_no_filter_is_as_good_as_the_chosen_window(subtests):
    """At no rate up to 1/step; so a filter is no candidate."""
    for noise, bandwidth in product([0.0, 1e-9, 1e-5, 1e-2, 0.3], [1e-3, 0.05, 0.3, 2.0]):
        with subtests.test(noise=noise, bandwidth=bandwidth):
            conditions = Conditions(noise, 2.0, bandwidth, 1.0)
            total = choose(conditions).error.total
            for rate in np.geomspace(bandwidth / 10.0, 1.0, 300):
                assert conditions.error(ConsistentFilter(float(rate), 1.0)).total > total


def test_a_choice_needs_conditions_that_it_can_meet():
    """Noise that drowns delta, and numbers that are none, are refused."""
    with pytest.raises(AssumptionError, match=r"leaves an error of .* in delta with the best"):
        choose(Conditions(100.0, 1.0, 0.5, 1.0))
    for change, message in (
        ({"noise": -1.0}, "noise: .* got -1"),
        ({"amplitude": 0.0}, "amplitude: .* got 0"),
        ({"bandwidth": math.nan}, "bandwidth: .* got nan"),
        ({"bandwidth": 2.3}, "bandwidth: .* less than 2.2 rad/s .* every 1 s, got 2.3"),
    ):
        numbers = {"noise": 0.0, "amplitude": 1.0, "bandwidth": 1.0, "step": 1.0}
        with pytest.raises(AssumptionError, match=message):
            Conditions(**(numbers | change))


# --- the noise in a signal ---


def test_the_deviation_of_white_noise_is_found_under_a_smooth_signal(subtests):
    """The standard error of differences of order 4 is 3 % at most with 4000 samples."""
    for deviation in [1e-12, 1e-6, 1e-3, 1.0]:
        with subtests.test(deviation=deviation):
            t = np.arange(4000) * H
            signal = 0.3 + t + np.sin(1.7 * t) * np.exp(-0.1 * t)
            noise = np.random.default_rng(5).standard_normal(len(t))
            assert noise_level(signal + deviation * noise) == pytest.approx(deviation, rel=0.1)


def test_a_signal_without_noise_has_that_of_rounding():
    """A constant has none at all."""
    t = np.arange(4000) * H
    assert noise_level(np.sin(1.7 * t)) < 1e-15
    assert noise_level(np.full(300, 7.0)) == 0.0


def test_signals_not_smooth_against_their_samples_are_refused():
    """Nothing is guessed: estimates that do not settle, samples that are none, too few of them."""
    fast = np.sin(1.5 * np.arange(400))
    for samples, message in (
        (fast, "noise level: .* the signal is too fast"),
        (np.zeros(199), "at least 200 samples, got 199"),
        (np.full(300, np.nan), "expected finite samples"),
    ):
        with pytest.raises(AssumptionError, match=message):
            noise_level(samples)


def test_a_lag_is_taken_out_of_the_response():
    """A slow filter at its own rate: half the power, a phase of 1 - pi/4."""
    expected = cmath.exp(1j * (1.0 - math.pi / 4.0)) / math.sqrt(2.0)
    # the step adds (rate h)^2/12 relatively, of the order of 1e-7
    assert ConsistentFilter(1.0, H).response(1.0) == pytest.approx(expected, rel=1e-6)
    assert ConsistentFilter(1.0, H).lag == pytest.approx(1.0, rel=1e-6)


def test_a_noise_gain_beyond_all_numbers_is_no_result():
    """A log could not have it: it is refused where it is computed."""
    dynamics = first_order_hold(np.array([[-1.0]]), np.array([[1.0]]), H, FREE)
    with pytest.raises(FloatingPointError, match="overflow"):
        noise_gain(dynamics, np.array([[1e200]]), np.zeros((1, 1)))
