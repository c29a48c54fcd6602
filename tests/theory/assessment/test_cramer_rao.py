"""Every family and mixtures of them: the estimate is as good as the noise allows.

The bound comes from a simulation of its own: scipy's response to inputs that are straight lines
between samples, differentiated by differences of theta. The noise is such that the largest of the
bounds of theta, or of the constants where there is no theta, is one part in a hundred.
"""

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import pytest
from scipy.stats import chi2

from cosim.theory.assessment.amplitude_verdicts import amplitude_verdicts
from cosim.theory.assessment.assessing import assess
from cosim.theory.disturbances.families import (
    DampedSine,
    Exponential,
    Polynomial,
    Sine,
    TExponential,
)
from cosim.theory.disturbed_plant import DataSet, disturbed_plant
from cosim.theory.estimators.output_error import OutputErrorProblem
from cosim.theory.plants.descriptor import reduce
from tests.theory.academic import academic
from tests.theory.closed_forms import ALPHAS, ClosedForm, T
from tests.theory.straight_lines import simulate_lines

DIFFERENCE = 1e-3
# of all seeds: how often another optimum is told that explains y as well
MOST_AMBIGUOUS = 0.05

EXPONENTIALS = [
    ClosedForm(Exponential(), (theta,), (size,))
    for theta, size in [(-0.05, 1.0), (-0.3, 1.2), (-0.8, 1.5), (-2.0, 2.0)]
]
SINE = ClosedForm(Sine(), (0.8,), (1.0, 0.5))
DAMPED = ClosedForm(DampedSine(), (0.15, 2.0), (1.0, 0.5))
# theta of other constants whose y is as good as the same under the noise, by case and sharing
RIVALS = {("3 exp", False): (-0.29968, -0.79547, -3.53672)}
CASES = {
    "exponential": EXPONENTIALS[1:2],
    "sine": [SINE],
    "damped-sine": [DAMPED],
    "constant": [ClosedForm(Polynomial(0, "constant"), (), (1.0,))],
    "ramp": [ClosedForm(Polynomial(1, "ramp"), (), (1.0, -0.1))],
    "polynomial": [ClosedForm(Polynomial(3), (), (1.0, -0.3, 0.05, -0.002))],
    "t-exponential": [ClosedForm(TExponential(), (-0.4,), (0.5, 1.0))],
    "2 exp": EXPONENTIALS[1:3],
    "sin + exp": [SINE, EXPONENTIALS[1]],
    "3 exp": EXPONENTIALS[1:],
    # under one alpha the fastest is reported first
    "2 sin": [ClosedForm(Sine(), (1.5,), (0.8, -0.5)), SINE],
    "4 exp": EXPONENTIALS,
    "damped sin + constant": [DAMPED, ClosedForm(Polynomial(0, "constant"), (), (0.7,))],
    "ramp + exp": [ClosedForm(Polynomial(1, "ramp"), (), (1.0, -0.1)), EXPONENTIALS[2]],
}


@cache
def signal(form):
    """Return f at all instants."""
    return np.array([form(t) for t in T])


@dataclass
class Case:
    """A disturbance of some terms, one alpha for all or one each."""

    forms: list
    shared: bool

    def __post_init__(self):
        self.plant = disturbed_plant(reduce(academic()), [0] * len(self.forms))
        system = self.plant
        self.system = (system.A, system.Bd[:, :1], system.C, system.Dd[:, :1])
        alphas = [ALPHAS[0] if self.shared else ALPHAS[i] for i in range(len(self.forms))]
        self.alpha = np.array(alphas).T
        self.clean = self.response([signal(form) for form in self.forms])

    def response(self, parts, x0=(0.0, 0.0)):
        """Return y of a disturbance that is a straight line between samples."""
        delta = np.sum(self.alpha * np.array(parts).T, axis=1)
        return simulate_lines(self.system, delta, T, x0)

    @property
    def names(self):
        """The unknowns whose bounds count: theta, or the constants where there is none."""
        places = [
            ("theta", i, j) for i, form in enumerate(self.forms) for j in range(len(form.theta))
        ]
        if places:
            return places
        return [
            ("constants", i, k) for i, form in enumerate(self.forms) for k in range(form.family.v)
        ]

    @property
    def truth(self):
        """Their values."""
        return np.array([getattr(self.forms[i], of)[j] for of, i, j in self.names])

    def moved(self, of, i, j, step):
        """Return y with one number changed."""
        parts = []
        for k, form in enumerate(self.forms):
            values = {"theta": list(form.theta), "constants": list(form.constants)}
            if k == i:
                values[of][j] += step
            own = ClosedForm(form.family, tuple(values["theta"]), tuple(values["constants"]))
            parts.append(signal(own))
        return self.response(parts)

    def slope(self, of, i, j):
        """Return dy by four differences, whose error is of the fourth order of their distance."""
        h = DIFFERENCE
        one = self.moved(of, i, j, h) - self.moved(of, i, j, -h)
        two = self.moved(of, i, j, 2 * h) - self.moved(of, i, j, -2 * h)
        return (8.0 * one - two) / (12.0 * h)

    @cached_property
    def bounds(self):
        """Return the Cramer-Rao bounds of the unknowns that count, for noise of deviation 1."""
        all_of = [
            (of, i, j)
            for i, form in enumerate(self.forms)
            for of in ("theta", "constants")
            for j in range(len(getattr(form, of)))
        ]
        columns = [self.slope(*place) for place in all_of]
        columns += [self.response(np.zeros((len(self.forms), len(T))), x0) for x0 in np.eye(2)]
        J = np.array(columns).T
        lengths = np.linalg.norm(J, axis=0)
        R = np.linalg.qr(J / lengths)[1]
        inverse = np.linalg.inv(R)
        errors = np.sqrt(np.sum(inverse**2, axis=1)) / lengths
        return np.array([errors[all_of.index(place)] for place in self.names])

    def noise(self):
        """Compute the deviation that makes the largest bound one part in a hundred."""
        return 0.01 / np.max(self.bounds / np.abs(self.truth))

    def assessment(self, sigma, seed):
        """Return what the package says of y with noise."""
        y = self.clean + sigma * np.random.default_rng(seed).standard_normal(len(T))
        no_input = np.zeros((len(T), self.plant.B.shape[1]))
        data = DataSet(T, y[:, np.newaxis], no_input, self.alpha)
        families = [form.family for form in self.forms]
        return assess(OutputErrorProblem([data], self.plant, families))

    def estimates(self, sigma, seed):
        """Return the estimate, and the other one that is told to explain y as well."""
        assessment = self.assessment(sigma, seed)
        if not assessment.parameters:
            values = [one.value for one in amplitude_verdicts(assessment)[0]]
            return np.array([values], np.float64)
        other = assessment.other_optimum
        both = [assessment.fit.theta] if other is None else [assessment.fit.theta, other]
        return np.array(both)

    def distance(self, theta):
        """Return how far y without noise is from what other exponentials explain."""
        parts = [np.exp(value * T) for value in theta]
        columns = [self.response(np.zeros((len(parts), len(T))), x0) for x0 in np.eye(2)]
        for k, part in enumerate(parts):
            alone = np.zeros((len(parts), len(T)))
            alone[k] = part
            columns.append(self.response(alone))
        J = np.array(columns).T
        solution = np.linalg.lstsq(J, self.clean, rcond=None)[0]
        return float(np.linalg.norm(self.clean - J @ solution))


def ratios(name, shared, seeds):
    """Return the errors, root mean square over seeds, over the bounds.

    Of two optima that are told the one near the truth counts: the data cannot say which it is.
    """
    case = Case(CASES[name], shared)
    sigma = case.noise()
    bounds = sigma * case.bounds
    errors = []
    told = 0
    for seed in range(seeds):
        of_each = (case.estimates(sigma, seed) - case.truth) / bounds
        errors.append(of_each[np.abs(of_each).max(axis=1).argmin()])
        told += len(of_each) > 1
    if (name, shared) not in RIVALS:
        assert told <= MOST_AMBIGUOUS * seeds
    print(f"{name}, {'one alpha' if shared else 'an alpha each'}: {told} of {seeds} told")
    return np.sqrt(np.mean(np.square(errors), axis=0))


@pytest.mark.parametrize(
    ("name", "shared"), [("3 exp", True), ("damped sin + constant", False), ("ramp", False)]
)
def test_estimates_of_mixtures_reach_the_bound(name, shared):
    """Of 3 seeds the sum of squares is a chi-square: this large with probability 1e-4."""
    assert (ratios(name, shared, seeds=3) ** 2 * 3 <= chi2.isf(1e-4, 3)).all()


@pytest.mark.parametrize(("name", "shared"), RIVALS)
def test_another_theta_explains_the_same_within_the_noise(name, shared):
    """By a simulation apart from the package: y differs by less than one deviation in all.

    So no test tells them apart, and a bound at the truth says nothing of it.
    """
    case = Case(CASES[name], shared)
    assert case.distance(RIVALS[name, shared]) < case.noise()


@pytest.mark.parametrize("seed", [1, 2])
def test_where_noise_chooses_between_two_optima_that_is_told(seed):
    """Three exponentials, an alpha each: of seed 1 a wrong theta explains more than the true one.

    In any case both are told, and one is within four bounds of the truth.
    """
    case = Case(CASES["3 exp"], False)
    sigma = case.noise()
    assessment = case.assessment(sigma, seed)
    bounds = sigma * case.bounds
    assert str(assessment.parameters[2].verdict) == "WEAK"
    both = [assessment.fit.theta, assessment.other_optimum]
    if seed == 1:
        both.reverse()
    assert (np.abs(both[0] - case.truth) <= 4.0 * bounds).all()
    np.testing.assert_allclose(both[1], RIVALS["3 exp", False], atol=0.1)


def test_four_exponentials_under_one_alpha_are_found():
    """Of this seed the grid leads to two that are close together, with amplitudes that cancel."""
    case = Case(CASES["4 exp"], True)
    sigma = case.noise()
    errors = case.estimates(sigma, seed=1)[0] - case.truth
    assert (np.abs(errors) <= 4.0 * sigma * case.bounds).all()


@pytest.mark.campaign
@pytest.mark.parametrize("shared", [True, False], ids=["one alpha", "an alpha each"])
@pytest.mark.parametrize("name", CASES)
def test_estimates_are_within_one_and_a_half_of_the_bound(name, shared):
    """Every family, and mixtures of up to four terms, from a search without any start."""
    if len(CASES[name]) == 1 and not shared:
        pytest.skip("one term has one alpha")
    found = ratios(name, shared, seeds=200)
    print(found)
    assert (found <= 1.5).all()
