"""What is said to help a WEAK parameter does, and what is said not to help does not."""

import re

import numpy as np
import pytest

from cosim.native.numerics.linear import first_order_hold, linear_step
from cosim.theory.assessment.advice import advised
from cosim.theory.assessment.assessing import assess
from cosim.theory.disturbances.families import Exponential
from cosim.theory.disturbed_plant import DataSet
from cosim.theory.documents import Verdict
from cosim.theory.estimators.output_error import OutputErrorProblem
from tests.theory.experiments import FAMILIES, THETA, design
from tests.theory.experiments import alpha as alpha_of_example
from tests.theory.experiments import noisy as noisy_example
from tests.theory.first_order import experiment, sine


def with_offset(**options):
    return experiment(
        [Exponential()],
        [-0.2],
        lambda t: 2.0 * np.exp(-0.2 * t),
        **{"length": 20.0, "sigma": 0.8, "constant": 0.5, "offset": True, **options},
    )


def fading(length=10.0, sigma=0.2, seed=1, **options):
    """Return what is said of two exponentials; with seed 0 another optimum explains as much."""
    return experiment(
        [Exponential(), Exponential()],
        [-0.1, -0.3],
        lambda t: (waves(t) * np.exp(np.outer(t, [-0.1, -0.3]))).sum(axis=1),
        **{"length": length, "sigma": sigma, "seed": seed, "alpha": waves, **options},
    )


def waves(t):
    return np.stack([np.ones(len(t)), 1.0 + 0.3 * np.sin(t)], axis=1)


def said(parameter):
    """Return what helps and what does not, each with the standard error that is expected."""
    assert parameter.verdict is Verdict.WEAK
    advice = parameter.reason.partition(" is missing; ")[2]
    advice = advice.rpartition(" (in brackets")[0]
    helps, _, rest = advice.rpartition(" would supply it")
    perhaps, _, fails = rest.rpartition(" may by chance")
    return _outlooks(helps), _outlooks(fails.removesuffix(" would not")), _outlooks(perhaps)


def _outlooks(text):
    outlooks = {}
    for part in re.split(", | or ", text.removeprefix(", ")):
        if part:
            what, error = re.fullmatch(r"(.+?)(?: \[([^\]]+)\])?", part).groups()
            outlooks[what] = None if error is None else float(error)
    return outlooks


def factor_of(outlooks):
    """Return how many times larger a disturbance must be over the noise, and the error then."""
    (text,) = [what for what in outlooks if what.startswith("a disturbance")]
    return float(re.search(r"(\d+) times", text)[1]), outlooks[text]


def test_data_of_the_length_that_is_said_are_enough():
    """The error is the expected one, but for that of the estimate which the prediction is from."""
    helps, _, _ = said(sine(length=3.0)[0])
    expected = helps["6 s of data"]
    errors = []
    for seed in range(1, 6):
        (parameter,) = sine(length=6.0, seed=seed)
        assert parameter.verdict is Verdict.IDENTIFIABLE
        errors.append(parameter.standard_error)
    assert 0.6 * expected < np.median(errors) < 1.6 * expected


def test_components_that_fade_need_more_than_time():
    """Where no length is said to be enough, eight times the data have no smaller error."""
    _, fails, _ = said(fading()[1])
    longer = fading(length=80.0)[1]
    assert longer.standard_error == pytest.approx(fails["data of any length"], rel=0.2)
    assert longer.verdict is Verdict.WEAK


def test_a_known_parameter_that_does_not_help_is_said():
    """With theta[0] fixed at its truth the error is the expected one, and the verdict WEAK."""
    _, fails, _ = said(fading(seed=2)[1])
    known, fixed = fading(seed=2, bounds={0: (-0.1, -0.1)})
    assert known.verdict is Verdict.IDENTIFIABLE
    assert fixed.standard_error == pytest.approx(fails["theta[0] known"], rel=0.2)
    assert fixed.verdict is Verdict.WEAK


@pytest.mark.parametrize("case", [fading, sine])
def test_less_noise_as_it_is_said_is_enough(case):
    """As a disturbance that is larger would be: their ratio counts."""
    options = {} if case is fading else {"length": 3.0}
    sigma = 0.2 if case is fading else 0.8
    helps, _, _ = said(case(**options)[-1])
    factor, expected = factor_of(helps)
    quiet = case(**options, sigma=sigma / factor)[-1]
    assert quiet.verdict is Verdict.IDENTIFIABLE
    assert quiet.standard_error == pytest.approx(expected, rel=0.3)


def test_what_helps_is_said_where_longer_data_leave_all_numbers():
    """Of e^(8 t): after 25 s it is e^200, and squares of what it is after 50 s are no numbers.

    Of such data nothing is said.
    """

    def growing(size):
        def disturbance(t):
            return size * np.exp(8.0 * (t - 25.0))[:, np.newaxis].sum(axis=1)

        (parameter,) = experiment(
            [Exponential()], [8.0], disturbance, length=25.0, sigma=0.8, seed=1
        )
        return parameter

    weak = growing(40.0)
    helps, fails, _ = said(weak)
    assert fails == {}
    assert "inf" not in weak.reason
    factor, expected = factor_of(helps)
    larger = growing(40.0 * factor)
    assert larger.verdict is Verdict.IDENTIFIABLE
    assert larger.standard_error == pytest.approx(expected, rel=0.3)


def test_an_offset_that_is_not_there_need_not_be_estimated():
    """Where that is said to help by chance, the same data without one are enough here."""
    (weak,) = with_offset()
    _, _, helps = said(weak)
    (without,) = with_offset(constant=0.0, offset=False)
    assert without.verdict is Verdict.IDENTIFIABLE
    # the prediction is made at an estimate, and errors go with one over its amplitude, here +- 20 %
    assert without.standard_error == pytest.approx(helps["no offset on y"], rel=0.4)
    assert without.standard_error < 0.7 * weak.standard_error
    assert "no offset on y" not in sine(length=3.0)[0].reason


def test_another_input_does_not_help():
    """Errors are those of the same noise with any other u; of a plant without u nothing is said."""
    data = noisy_example("good", 0.14, seed=3, h=2e-2)
    found = {}
    for name, u in (("same", data.u), ("other", 5.0 * np.cos(3.0 * data.t)[:, np.newaxis])):
        y = data.y + response_to(u - data.u, data.t)
        other = DataSet(data.t, y, u, data.alpha)
        plant = design()
        assessment = assess(OutputErrorProblem([other], plant, FAMILIES), np.array(THETA))
        found[name] = advised(assessment, [alpha_of_example]).parameters[1]
    assert said(found["same"])[1]["another u"] is None
    same, other = (found[name].standard_error for name in ("same", "other"))
    assert other == pytest.approx(same, rel=1e-6)
    assert "another u" not in sine(length=3.0)[0].reason


def response_to(u, t):
    """Return the response of the example to u from rest, by the matrices of its design."""
    plant = design()
    n = len(plant.A)
    discrete = first_order_hold(plant.A, plant.B, t[1] - t[0], np.zeros(1, np.bool_))
    step = linear_step(discrete, np.eye(n), np.zeros((n, 1)))
    x = np.vstack([np.zeros(n), step.advance(t, t[1] - t[0], np.ascontiguousarray(u))])
    return x @ plant.C.T + u @ plant.D.T


def test_of_an_alpha_without_later_values_no_length_is_said():
    """Data beyond those there are need an alpha there."""

    def alpha(t):
        return np.where(t <= 3.0, 1.0, np.nan)[:, np.newaxis]

    (parameter,) = sine(length=3.0, alpha=alpha)
    helps, fails, _ = said(parameter)
    assert not any("data" in what for what in (*helps, *fails))
    assert helps


def test_a_parameter_that_is_not_weak_has_no_advice():
    """Nothing is added to what is said of it."""
    (parameter,) = sine(length=6.0)
    assert parameter.verdict is Verdict.IDENTIFIABLE
    assert "would" not in parameter.reason
