"""The assumptions one by one: systems with known verdicts, in any coordinates and units."""

from functools import partial

import numpy as np
import pytest

from cosim.errors import AssumptionError
from cosim.theory.observers import observer
from cosim.theory.observers.assumptions import (
    DECOUPLING,
    DETECTABILITY,
    DIRECT_PATH,
    HURWITZ,
    checked,
    gain_evidence,
    observer_verdicts,
    outputs_verdict,
    plant_verdicts,
    undecided,
)
from cosim.theory.plants.descriptor import reduce
from tests.theory.academic import academic
from tests.theory.known_systems import GOOD, KnownSystem, matrices, systems

SYSTEMS = systems()


def model_verdicts(system, *, L=None, poles=None):
    """Return all verdicts of a design model, with those of an observer with a gain or poles."""
    verdicts = list(plant_verdicts(system))
    has_gain = L is not None or poles is not None
    later = [DIRECT_PATH, DECOUPLING, DETECTABILITY, *([HURWITZ] if has_gain else [])]
    try:
        reduced = reduce(system)
    except AssumptionError:
        without = {name: undecided(name, "there is no reduced system") for name in later}
        without[DECOUPLING] = outputs_verdict(*system.Dd.shape)
        return (*verdicts, *without.values())
    verdicts += observer_verdicts(reduced)
    if has_gain:
        failing = [verdict.name for verdict in verdicts if verdict.fulfilled is False]
        if failing:
            verdicts.append(undecided(HURWITZ, f"{failing[0]} is not fulfilled"))
        else:
            gain = partial(observer.design, reduced, L=L, poles=poles)
            verdicts.append(checked(HURWITZ, lambda: gain_evidence(gain())))
    return tuple(verdicts)


def poles_for(known: KnownSystem):
    """Return as many poles as can be placed, spread so that any output can place them."""
    reduced = reduce(known.matrices.system)
    free = len(reduced.A_a) - len(known.zeros or ())
    return [-1.0 - 0.5 * k for k in range(free)]


def in_coordinates(known: KnownSystem, coordinates: str, seed: int):
    """Return the system as it is, mixed, or in other units."""
    rng = np.random.default_rng(seed)
    if coordinates == "mixed":
        return known.matrices.scrambled(rng)
    if coordinates == "units":
        return known.matrices.in_other_units(rng)
    return known.matrices


@pytest.mark.parametrize("coordinates", ["as it is", "mixed", "units"])
def test_verdicts_are_those_that_are_known(coordinates, subtests):
    """Of every system the one verdict, by its name; its zeros; and of good ones nothing fails."""
    for known in SYSTEMS:
        with subtests.test(name=known.name):
            for seed in range(1 if coordinates == "as it is" else 3):
                system = in_coordinates(known, coordinates, seed).system
                verdicts = model_verdicts(system)
                failing = [verdict for verdict in verdicts if verdict.fulfilled is False]
                assert [verdict.verdict for verdict in failing] == [known.verdict] * (
                    known.verdict != GOOD
                )
                for verdict in failing:
                    assert verdict.evidence
                    assert verdict.cure
                if known.zeros is not None:
                    (found,) = [
                        one.values["zeros"] for one in verdicts if one.name == DETECTABILITY
                    ]
                    zeros = np.sort_complex(np.array(found, np.complex128))
                    np.testing.assert_allclose(zeros, np.sort_complex(known.zeros), atol=1e-7)


def test_there_are_30_systems():
    """Every verdict among them, and both sides of their borders."""
    assert len(SYSTEMS) >= 30
    named = {known.verdict.rstrip("0123456789") for known in SYSTEMS}
    assert named == {
        GOOD,
        "PENCIL_SINGULAR",
        "INDEX_",
        "FEWER_OUTPUTS_THAN_DISTURBANCES",
        "DEPENDENT_DISTURBANCES",
        "RELATIVE_DEGREE",
        "NO_TRANSFER",
        "NOT_DETECTABLE",
    }


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "a tank that flows nowhere",
            r"rank 1, got rank 0 at every s .*: delta\[0\] never reaches y",
        ),
        ("the second of two flows nowhere", r"rank 2, got rank 1 at every s .*: delta\[1\] never"),
        ("two in one path", "rank 2, got rank 1 at every s .*: some disturbances .* same paths"),
    ],
)
def test_a_disturbance_that_never_reaches_y_needs_another_output(name, words):
    """No derivative of y, and no fit to it, has what y does not have: that is no cure."""
    (known,) = [one for one in SYSTEMS if one.name == name]
    with pytest.raises(AssumptionError, match=words) as caught:
        observer.design(reduce(known.matrices.system), poles=[])
    assert caught.value.cure.startswith("measure an")
    assert "integrator" not in str(caught.value)
    assert "offline" not in str(caught.value)


def test_a_report_says_what_the_errors_say(subtests):
    """Where the observer is refused, its error is the evidence and the cure of the verdict."""
    for known in SYSTEMS:
        with subtests.test(name=known.name):
            verdicts = model_verdicts(known.matrices.system)
            said = [f"{one.evidence}; {one.cure}" for one in verdicts if one.fulfilled is False]
            if known.verdict == GOOD:
                assert not said
                reduced = reduce(known.matrices.system)
                assert observer.error_dynamics(reduced).fixed_modes.real.max(initial=-1.0) < 0.0
                continue
            with pytest.raises(AssumptionError) as caught:
                observer.design(reduce(known.matrices.system), poles=[-1.0])
            error = caught.value
            assert error.verdict == known.verdict
            if known.verdict == "PENCIL_SINGULAR":  # the index fails with it
                assert str(error).endswith(said[0])
            else:
                assert [str(error)] == said


def test_assumptions_that_rest_on_a_failing_one_are_not_decided_and_the_others_are():
    """Of an index of 2 with too few outputs both; of a relative degree of 2 also the zeros."""
    E = np.diag([1.0, 1.0, 0.0])
    A = [[-1, 0, 1], [0, -2, 1], [1, 1, 0]]
    both = matrices(A, [[1, 0], [0, 1], [1, 0]], [[1, 0, 0]], E=E)
    verdicts = {one.name: one for one in model_verdicts(both.system, poles=[-1.0])}
    failing = {one.verdict for one in verdicts.values() if one.fulfilled is False}
    assert failing == {"INDEX_2", "FEWER_OUTPUTS_THAN_DISTURBANCES"}
    assert verdicts[HURWITZ].fulfilled is None
    position = matrices([[0, 1, 0], [0, -1, 1], [0, 0, -3]], [[0], [1], [0]], [[1, 0, 0]])
    verdicts = {one.name: one for one in model_verdicts(position.system)}
    assert verdicts[DECOUPLING].verdict == "RELATIVE_DEGREE"
    assert verdicts[DETECTABILITY].values["zeros"] == pytest.approx([-3.0])


@pytest.mark.parametrize(("L", "fulfilled"), [([[4.0], [0.0]], True), ([[0.0], [0.0]], False)])
def test_a_gain_is_judged_by_the_eigenvalues(L, fulfilled):
    """Of the paper's example -4 and -2; without a gain one of them is 0."""
    verdicts = model_verdicts(academic(), L=L)
    (gain,) = [one for one in verdicts if one.name == HURWITZ]
    assert gain.fulfilled is fulfilled
    if fulfilled:
        assert sorted(gain.values["eigenvalues"]) == pytest.approx([-4.0, -2.0])
        assert gain.values["lambda_obs"] == pytest.approx(2.0)
    else:
        assert "eigenvalue +0" in gain.evidence
        assert gain.cure.startswith("another L moves it")


def test_a_model_without_disturbance_has_no_observer():
    """The plant is fine; what an observer is for is missing."""
    alone = matrices([[-1.0]], np.zeros((1, 0)), [[1.0]])
    verdicts = model_verdicts(alone.system, poles=[])
    assert [one.fulfilled for one in verdicts] == [True, True, None, False, None, None]
    assert "no disturbance" in verdicts[3].evidence
