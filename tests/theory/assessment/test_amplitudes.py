"""Amplitudes and phases: their values at t = 0, and errors that come from all unknowns together."""

import numpy as np
import pytest

from cosim.theory.assessment.amplitude_verdicts import amplitude_verdicts
from cosim.theory.assessment.assessing import assess_near
from cosim.theory.disturbances.families import Exponential, Sine
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.documents import Verdict
from cosim.theory.estimators.output_error import OutputErrorProblem

H = 0.02
SINE = Sine()
TRUTH = np.array([1.3, 2.0, 0.5, 0.2])  # rate, amplitude, phase, x(first time)
LAG = DisturbedPlant(
    A=np.array([[-1.0]]),
    B=np.zeros((1, 0)),
    Bd=np.ones((1, 1)),
    C=np.ones((1, 1)),
    D=np.zeros((1, 0)),
    Dd=np.zeros((1, 1)),
)


def output(p, t):
    """Return x of x' = -x + A sin(w t + phi), x(t[0]) = x0, by hand: w, A, phi, x0 = p."""
    rate, amplitude, phase, x0 = p
    gain = amplitude / np.hypot(1.0, rate)
    forced = gain * np.sin(rate * t + phase - np.arctan(rate))
    return forced + (x0 - forced[0]) * np.exp(-(t - t[0]))


def by_lines(p, t):
    """Return the same for straight lines between samples, of which fits know no error."""
    rate, amplitude, phase, x0 = p
    d = amplitude * np.sin(rate * t + phase)
    decay = np.exp(-H)
    end = 1.0 - (1.0 - decay) / H
    begin = 1.0 - decay - end
    x = np.empty(len(t))
    x[0] = x0
    for k in range(len(t) - 1):
        x[k + 1] = decay * x[k] + begin * d[k] + end * d[k + 1]
    return x


def data(t, y):
    return DataSet(t, y[:, np.newaxis], np.zeros((len(t), 0)), np.ones((len(t), 1)))


def times(start=0.0, length=20.0):
    return start + np.arange(round(length / H) + 1) * H


def constants(records, family=SINE, start=TRUTH[0], **options):
    """Return the estimates of each data set by name."""
    assessment = assess_near(
        OutputErrorProblem(records, LAG, [family], **options), np.array([start])
    )
    return [
        {one.name: one for one in of_data} for of_data in amplitude_verdicts(assessment)
    ], assessment


def noise(sigma, seed, count):
    return sigma * np.random.default_rng(seed).standard_normal(count)


@pytest.mark.parametrize("start", [0.0, 3.0])
def test_amplitude_and_phase_are_those_at_t_0(start):
    """Whenever the record begins, so that they are the numbers of a scenario."""
    t = times(start)
    ((found,), _) = constants([data(t, by_lines(TRUTH, t))])
    assert found["amplitude[0]"].value == pytest.approx(2.0, rel=1e-9)
    assert found["phase[0]"].value == pytest.approx(0.5, rel=1e-9)
    assert found["amplitude[0]"].reason == "in amplitude[0] sin(theta[0] t + phase[0])"
    assert found["phase[0]"].reason == "in rad at t = 0"


@pytest.mark.parametrize("start", [0.0, 3.0])
def test_standard_errors_are_the_cramer_rao_bound_of_rate_amplitude_and_phase(start):
    """The bound does not depend on how unknowns are written: sin and cos give that of the phase.

    The reference is the Jacobian of the solution by hand, by central differences; lines between
    samples change it by h^2 w^2 / 12 = 6e-5.
    """
    t = times(start)
    sigma = 1e-2
    ((found,), assessment) = constants([data(t, by_lines(TRUTH, t) + noise(sigma, 1, len(t)))])
    columns = []
    for step in 1e-5 * np.eye(4):
        columns.append((output(TRUTH + step, t) - output(TRUTH - step, t)) / 2e-5)
    J = np.array(columns).T
    bound = assessment.fit.deviation * np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
    # the bound at the truth and at the estimate differ by a few standard errors, 0.2 % each
    assert found["amplitude[0]"].standard_error == pytest.approx(bound[1], rel=5e-3)
    assert found["phase[0]"].standard_error == pytest.approx(bound[2], rel=5e-3)
    assert assessment.parameters[0].standard_error == pytest.approx(bound[0], rel=5e-3)


def test_intervals_contain_the_truth_in_95_percent():
    """Of 100 records of 400 samples 88 to 99: what a binomial leaves in 99 of 100 cases."""
    t = times(length=8.0)
    y = by_lines(TRUTH, t)
    inside = np.zeros(2)
    for seed in range(100):
        ((found,), _) = constants([data(t, y + noise(3e-2, seed, len(t)))])
        for k, (name, true) in enumerate((("amplitude[0]", 2.0), ("phase[0]", 0.5))):
            one = found[name]
            if one.lower is not None:  # a false alarm has no interval
                inside[k] += one.lower <= true <= one.upper
    assert (inside >= 88).all()
    assert (inside < 100).all()


def test_every_data_set_has_its_own():
    """Theta is shared; of a record without the component amplitude and phase have no number."""
    t = times()
    other = np.array([1.3, 0.7, -2.0, 0.0])
    absent = np.array([1.3, 0.0, 0.0, 1.0])
    records = []
    for seed, p in enumerate((TRUTH, other, absent)):
        records.append(data(t, by_lines(p, t) + noise(1e-3, seed, len(t))))
    found, _ = constants(records)
    for p, one in zip((TRUTH, other), found, strict=False):
        for name, true in (("amplitude[0]", p[1]), ("phase[0]", p[2])):
            assert one[name].verdict is Verdict.IDENTIFIABLE
            assert one[name].value == pytest.approx(true, abs=5.0 * one[name].standard_error)
    for name in ("amplitude[0]", "phase[0]"):
        assert found[2][name].verdict is Verdict.NOT_IDENTIFIABLE
        assert found[2][name].value is None
        assert found[2][name].standard_error is None


def test_a_component_that_is_absent_has_no_numbers():
    """Neither amplitude nor phase, and the reason is that of theta."""
    t = times()
    y = np.exp(-t) + noise(1e-3, 2, len(t))
    ((found,), assessment) = constants([data(t, y)])
    assert assessment.parameters[0].value is None
    for name in ("amplitude[0]", "phase[0]"):
        assert found[name].value is None
        assert found[name].lower is None
        assert found[name].reason == assessment.parameters[0].reason


def test_an_amplitude_of_a_known_exponent_is_a_number_even_if_it_is_small():
    """It is linear: its interval holds, and contains 0; that of a large one does not."""
    t = times()
    rate = -0.2
    for amplitude, contains in ((0.0, True), (0.5, False)):
        d = amplitude / (1.0 + rate) * (np.exp(rate * t) - np.exp(-t))
        record = data(t, d + noise(1e-2, 5, len(t)))
        bounds = {0: (rate, rate)}
        ((found,), _) = constants([record], Exponential(), rate, bounds=bounds)
        one = found["amplitude[0]"]
        assert (one.lower <= 0.0 <= one.upper) is contains
        # x' = -x + b exp(a t): lines between samples err by h^2/12
        assert one.value == pytest.approx(amplitude, abs=4.0 * one.standard_error + 1e-4)


def test_constants_far_from_the_record_have_no_numbers():
    """exp(-0.2 t) read from t = 1e5 s on says nothing of t = 0 that a number could hold."""
    t = times(1e5)
    since = t - t[0]
    y = 0.5 / 0.8 * (np.exp(-0.2 * since) - np.exp(-since))
    record = data(t, y + noise(1e-3, 6, len(t)))
    ((found,), assessment) = constants([record], Exponential(), -0.2)
    assert assessment.parameters[0].verdict is Verdict.IDENTIFIABLE
    assert found["amplitude[0]"].value is None
    assert "t = 0 is too far off" in found["amplitude[0]"].reason
