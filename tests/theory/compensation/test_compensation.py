"""The compensator's gains and the proof that its loop is stable, against other tools."""

import re
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import StateSpace as ScipyStateSpace
from scipy.signal import place_poles

from cosim.errors import AssumptionError
from cosim.theory.compensation.certificate import SampledLoop, certify
from cosim.theory.compensation.design import (
    CompensatorGains,
    ControlledPlant,
    certify_compensator,
    sampled_loop,
    saturated_loop,
    scheduled,
    stabilize,
)
from cosim.theory.compensation.internal_model import ParameterBox, internal_model
from cosim.theory.compensation.schedule import Schedule
from cosim.theory.compensation.state_feedback import (
    RegulatedPlant,
    feedforward,
    no_gain,
    reference_gain,
    regulated_plant,
    state_feedback,
)
from cosim.theory.compensation.steady_input import KnownDisturbance, steady_input
from cosim.theory.compensation.transmission_zeros import blocks_of, check_zeros, closest_mode
from cosim.theory.disturbances.families import (
    FAMILIES,
    DampedSine,
    Exponential,
    Polynomial,
    Sine,
)
from cosim.theory.disturbances.linear_family import LinearFamily
from cosim.theory.observers.observer import StateSpace, design, realize
from cosim.theory.plants.descriptor import DescriptorSystem, reduce
from tests.theory.compensated import designed, drive, growth, loop_matrix, plant_of, sampled

H = 1e-2
SLOW = 0.2  # a step at which the loop is unstable from 5.1 rad/s on


def random_plant(seed, n=4, m=2):
    """Return a stable plant with as many regulated outputs as inputs."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n)) - 3.0 * np.eye(n)
    D = rng.normal(size=(m, m)) * (seed % 2)
    return RegulatedPlant(
        A=A,
        B=rng.normal(size=(n, m)),
        Bd=rng.normal(size=(n, 1)),
        C=rng.normal(size=(m, n)),
        D=D,
        Dd=np.zeros((m, 1)),
        zeros=np.zeros(0, np.complex128),
    )


# --- state feedback and feedforward ---


def test_the_regulator_of_a_double_integrator_is_that_of_the_textbooks():
    """With Q = I, R = 1 the gain is (1, sqrt 3)."""
    K = state_feedback(np.eye(2, k=1), np.array([[0.0], [1.0]]), Q=[1.0, 1.0])
    assert np.allclose(K, [[1.0, np.sqrt(3.0)]], rtol=1e-12)


def test_poles_are_placed(subtests):
    """With one input also a double one; with several against scipy's placement."""
    for m in [1, 2]:
        with subtests.test(m=m):
            plant = random_plant(3, n=3, m=m)
            wanted = [-1.0, -1.0, -4.0] if m == 1 else [-1.0, -2.0, -4.0]
            K = state_feedback(plant.A, plant.B, poles=wanted)
            reached = np.poly(np.linalg.eigvals(plant.A - plant.B @ K))
            assert np.allclose(reached, np.poly(wanted), rtol=1e-8)
            if m == 2:
                other = place_poles(plant.A, plant.B, wanted).gain_matrix
                assert np.allclose(np.poly(np.linalg.eigvals(plant.A - plant.B @ other)), reached)


def test_a_constant_disturbance_and_reference_leave_no_error(subtests):
    """The static gain of the closed loop, by scipy, is 0 from delta and 1 from r."""
    for seed in range(4):
        with subtests.test(seed=seed):
            plant = random_plant(seed)
            K = state_feedback(plant.A, plant.B, Q=np.ones(4))
            F = feedforward(plant, K).gain
            N = reference_gain(plant, K).gain
            B = np.hstack([plant.Bd + plant.B @ F, plant.B @ N])
            D = np.hstack([plant.Dd + plant.D @ F, plant.D @ N])
            closed = ScipyStateSpace(plant.A - plant.B @ K, B, plant.C - plant.D @ K, D)
            static = closed.D - closed.C @ np.linalg.solve(closed.A, closed.B)
            assert np.allclose(static, np.hstack([np.zeros((2, 1)), np.eye(2)]), atol=1e-12)


def test_a_matched_disturbance_is_cancelled_exactly():
    """Where Bd = B M and nothing feeds through, F = -M."""
    plant = random_plant(2)
    M = np.array([[0.7], [-1.3]])
    matched = replace(plant, Bd=plant.B @ M)
    K = state_feedback(plant.A, plant.B, Q=np.ones(4))
    assert np.allclose(feedforward(matched, K).gain, -M, rtol=1e-12)


def test_a_state_feedback_that_is_none_is_refused(subtests):
    """With what was found and what was needed."""
    for options, message in [
        ({}, "one of K, poles and Q, got none"),
        ({"K": [[1.0, 1.0]], "Q": [1.0, 1.0]}, "one of K, poles and Q, got K and Q"),
        ({"K": [[1.0, 1.0]], "R": [1.0]}, "R, the weight of u, needs Q"),
        ({"K": [[0.0, 0.0]]}, r"not Hurwitz: eigenvalue \+1"),
        ({"K": [[1.0]]}, r"K: .* \(1, 2\), .* got shape \(1, 1\)"),
        ({"Q": [1.0]}, "Q: expected 2 numbers"),
        ({"Q": [-1.0, 1.0]}, "Q is not positive semidefinite"),
        ({"Q": [1.0, 1.0], "R": [0.0]}, "R: expected a positive definite"),
        ({"poles": [-1.0, -2.0, -3.0]}, "state feedback: expected 2 poles, as many as K .* got 3"),
    ]:
        with subtests.test(message=message):
            A = np.array([[1.0, 1.0], [0.0, -1.0]])
            with pytest.raises(AssumptionError, match=message):
                state_feedback(A, np.array([[0.0], [1.0]]), **options)


def test_an_unstable_mode_that_u_does_not_reach_is_refused():
    """It is named; a stable one stays where it is."""
    B = np.array([[0.0], [1.0]])
    with pytest.raises(AssumptionError, match=r"reach the mode \+1.* \(NOT_STABILIZABLE\)"):
        state_feedback(np.diag([1.0, 2.0]), B, poles=[-1.0])
    K = state_feedback(np.diag([-1.0, 2.0]), B, poles=[-3.0])
    assert np.allclose(K, [[0.0, 5.0]])


def test_regulated_outputs_that_no_controller_holds_are_refused():
    """More of them than inputs; one that is not there; a zero at 0 under a constant."""
    reduced = drive()
    with pytest.raises(AssumptionError, match="FEWER_INPUTS_THAN_REGULATED_OUTPUTS"):
        regulated_plant(reduced, [0, 1])
    with pytest.raises(AssumptionError, match=r"regulated: .* from 0 to 1, got \[2\]"):
        regulated_plant(reduced, [2])
    velocity = regulated_plant(reduced, [1])
    with pytest.raises(AssumptionError, match=r"feedforward of delta: .* zero at 0"):
        feedforward(velocity, np.zeros((1, 4)))


def test_the_input_that_rejects_a_disturbance_inverts_the_plant():
    """The transfers to the position are (0.8 s + 4) / d of u and (s^2 + 1.8 s + 5) / d of delta.

    Of 1 + 2 t it is a - 2.5 t with 0.8 (-2.5) + 4 a = -(1.8 x 2 + 5), of exp(-0.3 t) a multiple.
    """
    plant = regulated_plant(drive(), [0])
    t = H * np.arange(1001)
    ramp = KnownDisturbance([Polynomial(1)], [np.zeros(0)], 1.0 + 2.0 * t, H)
    # v at the end is 1000 steps of rounding from that at the start
    tolerance = {"rtol": 0.0, "atol": 1e-11}
    u = steady_input(plant, ramp)
    np.testing.assert_allclose(u[:, 0], -6.6 / 4.0 - 2.5 * t, **tolerance)
    decay = np.exp(-0.3 * t)
    u = steady_input(plant, KnownDisturbance([Exponential()], [np.array([-0.3])], decay, H))
    np.testing.assert_allclose(u[:, 0], -4.55 / 3.76 * decay, **tolerance)


def test_no_input_is_said_for_another_disturbance_or_at_a_zero():
    """A course that the components do not make; a constant that s/(s + 1) of u cannot reject."""
    t = H * np.arange(1001)
    other = KnownDisturbance([Exponential()], [np.array([-0.4])], np.exp(-0.3 * t), H)
    assert steady_input(regulated_plant(drive(), [0]), other) is None
    washed_out = RegulatedPlant(
        A=-np.eye(2),
        B=np.array([[0.0], [1.0]]),
        Bd=np.array([[1.0], [0.0]]),
        C=np.array([[1.0, -1.0]]),
        D=np.array([[1.0]]),
        Dd=np.zeros((1, 1)),
        zeros=np.zeros(1, np.complex128),
    )
    constant = KnownDisturbance([Polynomial(0)], [np.zeros(0)], np.ones(1001), H)
    assert steady_input(washed_out, constant) is None


# --- the internal model ---


def test_the_internal_model_has_the_modes_of_the_class_once_for_each_output():
    """Of several polynomials the largest stays: it contains the others."""
    constant = FAMILIES["constant"]
    families = [constant, Sine(), FAMILIES["ramp"], Exponential(), constant]
    model = internal_model(families, 2)
    eigenvalues = np.linalg.eigvals(model.S(np.array([1.5, -0.2])))
    once = [0.0, 0.0, 1.5j, -1.5j, -0.2]
    assert np.allclose(np.poly(eigenvalues), np.poly(2 * once), atol=1e-12)
    assert model.b.shape == (10, 2)


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 10_000), rate=st.floats(0.1, 2.0))
def test_the_gain_moves_the_modes_of_the_internal_model_and_no_others(seed, rate):
    """Those slower than half the decay rate to their mirror image; the law of least effort."""
    plant = random_plant(seed)
    K = state_feedback(plant.A, plant.B, Q=np.ones(4))
    model = internal_model([Sine(), FAMILIES["constant"]], 2)
    box = ParameterBox(np.array([1.0]), np.array([2.0]))
    gains = stabilize(plant, K, model, box.center, rate)
    u_of_x = -K + gains.K_w @ gains.X
    of_x = np.hstack([plant.A + plant.B @ u_of_x, -plant.B @ gains.K_w])
    of_e = np.hstack([plant.C + plant.D @ u_of_x, -plant.D @ gains.K_w])
    of_w = model.b @ of_e + np.hstack([np.zeros((6, 4)), model.S(box.center)])
    closed = np.linalg.eigvals(np.vstack([of_x, of_w]))
    moved = np.tile([-rate, -rate + 1.5j, -rate - 1.5j], 2)
    kept = np.linalg.eigvals(plant.A - plant.B @ K)
    expected = np.poly(np.concatenate([kept, moved]))
    # double eigenvalues: compare characteristic polynomials, relative to their largest coefficient
    assert np.abs(np.poly(closed) - expected).max() <= 1e-6 * np.abs(expected).max()


def test_a_mode_that_decays_at_half_the_rate_by_itself_is_no_obstacle():
    """There the mirror image of the mode is itself: it may stay, or move somewhat."""
    plant = random_plant(1)
    K = state_feedback(plant.A, plant.B, Q=np.ones(4))
    model = internal_model([Exponential(), FAMILIES["ramp"]], 2)
    gains = stabilize(plant, K, model, np.array([-0.25]), 0.5)
    closed = model.S(np.array([-0.25])) - gains.B_w @ gains.K_w
    assert np.linalg.eigvals(closed).real.max() <= -0.25 + 1e-6


def test_a_transmission_zero_at_a_mode_of_the_disturbance_is_refused():
    """The zero is named with the theta where it meets the internal model, also inside a box."""
    zero = 1.3
    A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-6.0, -11.0, -6.0]])
    system = DescriptorSystem.partitioned(
        A=A,
        Bu=np.array([[0.0], [0.0], [1.0]]),
        Bd=np.array([[0.0], [0.0], [1.0]]),
        C=np.array([[zero**2, 0.0, 1.0]]),
        n_a=3,
    )
    plant = regulated_plant(reduce(system), [0])
    model = internal_model([Sine()], 1)
    box = ParameterBox(np.array([1.0]), np.array([2.0]))
    with pytest.raises(AssumptionError, match=r"theta = 1\.3, .* \(TRANSMISSION_ZERO\)"):
        check_zeros(plant, model, box)
    check_zeros(plant, model, ParameterBox(np.array([1.4]), np.array([2.0])))


def test_the_mode_closest_to_a_zero_is_found_among_six_parameters():
    """A block whose six parameters are the coefficients of its polynomial, beside one with two.

    The zero is an eigenvalue for a theta inside the box, so that the distance is none.
    """
    companion = np.eye(6, k=1)
    slopes = []
    for j in range(6):
        slope = np.zeros((6, 6))
        slope[5, j] = -1.0
        slopes.append(tuple(map(tuple, slope.tolist())))
    names = tuple(f"a{j}" for j in range(6))
    rows = tuple(map(tuple, companion.tolist()))
    linear = LinearFamily(rows, tuple(slopes), (1.0, 0.0, 0.0, 0.0, 0.0, 0.0), names, None)
    model = internal_model([linear, DampedSine()], 2)
    blocks = blocks_of(model)
    assert sorted(block.parameters for block in blocks) == [(0, 1, 2, 3, 4, 5), (6, 7)]
    a = np.poly([-0.2, -0.5, -0.3 + 0.9j, -0.3 - 0.9j, -0.1 + 1.4j, -0.1 - 1.4j]).real[:0:-1]
    box = ParameterBox(np.append(a - 0.02, [0.0, 3.0]), np.append(a + 0.01, [0.1, 4.0]))
    theta, mode = closest_mode(-0.1 + 1.4j, blocks, box)
    assert abs(mode - (-0.1 + 1.4j)) < 1e-8
    assert abs(np.linalg.eigvals(model.S(theta)) - mode).min() < 1e-12
    # the other block is closer to what it makes
    theta, mode = closest_mode(-0.03 + 3.2j, blocks, box)
    assert np.allclose(theta[6:], [0.03, 3.2], rtol=0.0, atol=1e-8)


def test_of_several_transmission_zeros_the_one_that_is_a_mode_is_named():
    """The velocity y = s (s + 5) / (...) u has the zeros 0 and -5; 0 is a mode for every theta."""
    A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-6.0, -11.0, -6.0]])
    B = np.array([[0.0], [0.0], [1.0]])
    system = DescriptorSystem.general(A=A, Bu=B, Bd=B, C=[[0.0, 5.0, 1.0]])
    plant = regulated_plant(reduce(system), [0])
    model = internal_model([Sine(), FAMILIES["constant"]], 1)
    box = ParameterBox(np.array([1.0]), np.array([2.0]))
    with pytest.raises(AssumptionError, match=r"transmission zero \+0 from .* disturbance, where"):
        check_zeros(plant, model, box)


def test_a_transmission_zero_at_0_is_refused_under_a_constant_in_any_coordinates(subtests):
    """The velocity of a mass, where rounding moves the zero; no theta is named without one."""
    for seed in range(4):
        with subtests.test(seed=seed):
            A = np.array([[0.0, 1.0, 0.0], [-1.0, -2.0, 1.0], [0.0, 0.0, -3.0]])
            B = np.array([[0.0], [1.0], [0.5]])
            T, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
            system = DescriptorSystem.general(
                A=T @ A @ T.T, Bu=T @ B, Bd=T @ B, C=[[0, 1, 0]] @ T.T
            )
            plant = regulated_plant(reduce(system), [0])
            no_parameters = ParameterBox(np.zeros(0), np.zeros(0))
            with pytest.raises(
                AssumptionError, match=r"a mode of the disturbance, .*TRANSMISSION_ZERO"
            ):
                check_zeros(plant, internal_model([FAMILIES["constant"]], 1), no_parameters)


# --- the certificate ---


def loop_of(reduced, gains, *, delta=False, parts=4):
    """Return the sampled loop with gains at so many nodes and one."""
    schedule = scheduled(gains, gains.box, parts)
    return sampled_loop(sampled(reduced, H, delta=delta), gains, schedule)


def rate_at(reduced, gains, schedule, theta, *, h=H, delta=False):
    """Return how fast the loop grows at a theta, by other tools."""
    at = schedule.at(np.atleast_1d(theta))
    return growth(loop_matrix(reduced, gains, theta, h, at=at, delta=delta), h)


def test_the_loop_is_that_of_other_tools(subtests):
    """Written step by step with scipy's exponential, its gains between two nodes."""
    for delta in [False, True]:
        with subtests.test(delta=delta):
            reduced = drive()
            gains = designed(reduced, lower=1.0, upper=2.0, ff=delta)
            loop = loop_of(reduced, gains, delta=delta)
            for theta in (1.0, 1.7):
                at = loop.schedule.at(np.array([theta]))
                expected = loop_matrix(reduced, gains, theta, H, at=at, delta=delta)
                assert np.allclose(loop.Phi(np.array([theta])), expected, rtol=0.0, atol=1e-11)


def test_gains_are_interpolated_between_the_thetas_they_are_designed_for():
    """At a node those designed there, between two the weighted means; of two parameters, too."""
    reduced = drive()
    families = (Sine(), Sine())
    gains = designed(reduced, lower=[1.0, 2.5], upper=[2.0, 4.0], families=families)
    schedule = scheduled(gains, gains.box, 4)
    nodes = {}
    for theta in ((1.25, 2.5), (1.5, 2.5), (1.25, 2.875), (1.5, 2.875)):
        here = np.array(theta)
        nodes[theta] = stabilize(gains.plant, gains.K, gains.model, here, gains.decay_rate)
        assert np.allclose(schedule.at(here).K_w, nodes[theta].K_w, rtol=1e-12, atol=1e-12)
    middle = schedule.at(np.array([1.375, 2.6875]))
    for name in ("K_w", "X", "B_w"):
        mean = sum(getattr(node, name) for node in nodes.values()) / 4.0
        assert np.allclose(getattr(middle, name), mean, rtol=1e-12, atol=1e-12)
    assert len(schedule.cells()) == 16


@settings(max_examples=5, deadline=None)
@given(
    middle=st.floats(0.8, 2.5),
    width=st.floats(0.05, 1.9),
    rate=st.floats(0.1, 2.5),
    delta=st.booleans(),
)
def test_loops_proven_stable_are_stable_everywhere(middle, width, rate, delta):
    """By the eigenvalues of a loop that was written with other tools; else there is a reason.

    A loop that is not proven is unstable at the theta that is named, or decays slowly there.
    """
    reduced = drive()
    lower = max(middle - 0.5 * width * middle, 0.05)
    upper = middle + 0.5 * width * middle
    gains = designed(reduced, lower=lower, upper=upper, rate=rate, ff=delta)
    loop = loop_of(reduced, gains, delta=delta)
    certificate = certify(loop)
    if certificate.proven:
        for theta in np.linspace(lower, upper, 6):
            assert rate_at(reduced, gains, loop.schedule, theta, delta=delta) < 0.0
        return
    found = rate_at(reduced, gains, loop.schedule, certificate.theta, delta=delta)
    assert found == pytest.approx(-certificate.rate, abs=1e-6)


def test_a_proof_with_one_cell_holds_for_a_theta_that_varies():
    """Products of steps with random theta contract; the proof is of every sequence."""
    reduced = drive()
    gains = designed(reduced, lower=1.45, upper=1.55)
    loop = loop_of(reduced, gains, parts=1)
    assert certify(loop).cells == 1
    rng = np.random.default_rng(5)
    steps = [loop.Phi(np.array([theta])) for theta in rng.uniform(1.45, 1.55, 50)]
    state = rng.normal(size=(len(steps[0]), 20))
    largest = np.abs(state).max()
    for index in rng.integers(0, 50, 2000):
        state = steps[index] @ state
    assert np.abs(state).max() < 1e-2 * largest


def test_the_proof_succeeds_whatever_the_units_of_the_states(subtests):
    """The same loop in units a million times larger and smaller."""
    for scale in [(1e6, 1.0, 1e-3, 1.0), (1.0, 1e-4, 1.0, 1e3)]:
        with subtests.test(scale=scale):
            units = np.array(scale)
            reduced = drive(units)
            weights = np.array([1.0, 10.0, 1.0, 1.0]) / units**2
            gains = designed(reduced, lower=1.0, upper=2.0, Q=weights)
            certificate = certify(loop_of(reduced, gains))
            assert certificate.proven
            same = certify(loop_of(drive(), designed(drive(), lower=1.0, upper=2.0)))
            assert certificate.rate == pytest.approx(same.rate, rel=1e-3)


def test_the_proof_does_not_depend_on_the_units_of_u_and_y(subtests):
    """What drives the internal model, e and the rest of u, is as large as its units make it."""
    for of_u, of_y in [(1e6, 1.0), (1.0, 1e6), (1.0, 1e-6)]:
        with subtests.test(of_y=of_y):
            inner = drive()
            reduced = replace(inner, B_1a=of_u * inner.B_1a, C3=of_y * inner.C3)
            gains = designed(reduced, lower=1.5, upper=2.5, R=[of_u**2])
            certified = certify_compensator(gains, sampled(reduced, H))
            expected = certify_compensator(designed(inner, lower=1.5, upper=2.5), sampled(inner, H))
            assert certified.rate == pytest.approx(expected.rate, rel=1e-6)
            assert certified.cells <= 8 * expected.cells


def test_the_proof_depends_neither_on_the_unit_of_time_nor_on_the_step(subtests):
    """A vibration and a ramp, all rates a thousand times lower, the step a thousandth, or both.

    In the other unit of time the loop is the same one, to rounding. With a step far shorter than
    all that happens it is that of continuous time; the step of 0.01 s is worth 2 % of the rate.
    """
    for slower, steps in [(1.0, 1.0), (1e3, 1.0), (1.0, 1e3), (1e3, 1e3)]:
        with subtests.test(slower=slower, steps=steps):
            inner = drive()
            reduced = replace(
                inner, A_a=inner.A_a / slower, B_1a=inner.B_1a / slower, B_2a=inner.B_2a / slower
            )
            families = (Sine(), FAMILIES["ramp"])
            gains = designed(reduced, lower=1.0 / slower, upper=2.0 / slower, families=families)
            poles = [-6.0 / slower, -8.0 / slower]
            observed = realize(reduced, design(reduced, poles=poles, filter_rate=50.0 / slower))
            observer = StateSpace(observed.A, observed.B, observed.C[:4], observed.D[:4])
            h = H * slower / steps
            system = ControlledPlant(
                plant=plant_of(reduced), observer=observer, regulated=(0,), h=h
            )
            certified = certify_compensator(gains, system)
            expected = certify_compensator(
                designed(inner, lower=1.0, upper=2.0, families=families), sampled(inner, H)
            )
            assert certified.rate * slower == pytest.approx(
                expected.rate, rel=1e-5 if steps == 1.0 else 0.02
            )
            assert certified.cells <= 2 * expected.cells


def test_the_gain_of_a_polynomial_is_accurate_at_any_rate(subtests):
    """All modes at 0 move to minus the rate: the coefficients of (s + rate)^(degree + 1)."""
    for rate, degree in product([0.4, 2e-3], [1, 5]):
        with subtests.test(rate=rate, degree=degree):
            n = degree + 1
            model = internal_model([Polynomial(degree)], 1)
            A = np.array([[-1.0]])
            one = np.eye(1)
            plant = regulated_plant(
                reduce(DescriptorSystem.general(A=A, Bu=one, Bd=one, C=one)), [0]
            )
            gains = stabilize(plant, np.zeros((1, 1)), model, np.zeros(0), rate)
            closed = model.S(np.zeros(0)) - gains.B_w @ gains.K_w
            units = rate ** -np.arange(float(n))  # in which the model has entries of its rate
            scaled = closed * units / units[:, np.newaxis] / rate
            assert np.allclose(np.poly(scaled), np.poly(-np.ones(n)), rtol=0.0, atol=1e-9)


def test_a_loop_far_from_what_can_be_proven_is_refused():
    """A ramp over a step of 1000 s: the bound of the proof is beyond the range of numbers."""
    model = internal_model([FAMILIES["ramp"], Exponential()], 1)
    box = ParameterBox(np.array([-2e-3]), np.array([-1e-3]))
    nodes = {"K_w": np.zeros((1, 1, 3)), "X": np.zeros((1, 3, 1)), "B_w": np.zeros((1, 3, 1))}
    loop = SampledLoop(
        fixed=np.zeros((3, 3)),
        of_u=np.zeros((3, 1)),
        deviation=np.zeros((1, 3)),
        w=np.eye(3),
        error=np.ones((1, 3)),
        model=model,
        schedule=Schedule(box=box, counts=(0,), **nodes),
        h=1e3,
        at_limit=False,
    )
    assert not certify(loop).proven


def test_an_instability_between_the_points_of_the_grid_is_found():
    """A loop of one state, w, that e = -9 w drives: Phi = c - K_w + exp(theta) - 9 phi(theta).

    K_w and c are such that its largest value is 1.001, at theta = 0.05. Its second derivative is
    about 1 - 9/3 = -2, so that 0.05 beside it, at the next points of the grid, it is below 0.999.
    """
    peak, largest = 0.05, 1.001

    def own(theta):
        phi = np.expm1(theta) / theta if theta else 1.0
        return np.exp(theta) - 9.0 * phi

    slope = (own(peak + 1e-4) - own(peak - 1e-4)) / 2e-4
    c = largest - own(peak) + slope * peak
    ends = np.array([-0.4, 0.4])
    nodes = {"K_w": slope * ends, "X": np.zeros(2), "B_w": np.zeros(2)}
    loop = SampledLoop(
        fixed=np.array([[c]]),
        of_u=np.eye(1),
        deviation=np.zeros((1, 1)),
        w=np.eye(1),
        error=np.array([[-9.0]]),
        model=internal_model([Exponential()], 1),
        schedule=Schedule(
            box=ParameterBox(ends[:1], ends[1:]),
            counts=(1,),
            **{name: values.reshape(2, 1, 1) for name, values in nodes.items()},
        ),
        h=1.0,
        at_limit=False,
    )
    for theta in np.linspace(-0.4, 0.4, 9):
        Phi = c - slope * theta + own(theta)
        assert loop.radius(np.array([theta])) == pytest.approx(Phi, abs=1e-12)
        assert Phi < 0.999
    found = certify(loop)
    assert not found.proven
    assert found.theta == pytest.approx([peak], abs=0.03)  # beyond, Phi is below 1
    assert found.rate == pytest.approx(-np.log(largest), rel=1e-2)


def test_the_internal_model_decays_alike_in_the_whole_interval():
    """At 0.3 rad/s as at 3: the gains follow theta. One gain for all would not be stable."""
    reduced = drive()
    gains = designed(reduced, lower=0.3, upper=3.0)
    certified = certify_compensator(gains, sampled(reduced, H))
    assert certified.rate > 0.9 * gains.decay_rate
    one = stabilize(gains.plant, gains.K, gains.model, gains.box.center, gains.decay_rate)
    assert growth(loop_matrix(reduced, gains, 0.3, H, at=one), H) > 0.1


def test_an_interval_where_the_loop_is_unstable_is_refused():
    """At 7 rad/s a step of 0.2 s is too long, by the eigenvalues of another loop."""
    reduced = drive()
    gains = designed(reduced, lower=1.0, upper=7.0)
    schedule = scheduled(gains, gains.box, 16)
    rate = rate_at(reduced, gains, schedule, 7.0, h=SLOW)
    assert rate > 0.1
    grows = rf"at theta = 7 it grows at {rate:.3g} 1/s .NOT_.*"
    message = rf"{grows}; the largest .* about the same center .* would do: \["
    with pytest.raises(AssumptionError, match=message) as refused:
        certify_compensator(gains, sampled(reduced, SLOW))
    lower, upper = re.search(r"would do: \[(.*), (.*)\]", str(refused.value)).groups()
    smaller = designed(reduced, lower=float(lower), upper=float(upper))
    assert certify_compensator(smaller, sampled(reduced, SLOW)).rate > 0.0
    # and one a tenth wider is not stable: it is no interval of convenience
    end = 4.0 + 1.1 * (float(upper) - 4.0)
    wider = designed(reduced, lower=8.0 - end, upper=end)
    schedule = scheduled(wider, wider.box, 16)
    assert rate_at(reduced, wider, schedule, end, h=SLOW) > 0.0


def test_two_sines_whose_intervals_overlap_are_refused():
    """Where both have one rate, one copy of the mode is driven by nothing."""
    reduced = drive()
    gains = designed(reduced, lower=[1.0, 1.5], upper=[2.0, 2.5], families=(Sine(), Sine()))
    with pytest.raises(AssumptionError, match=r"2 modes of it are alike, .*NOT_STABILIZABLE"):
        certify_compensator(gains, sampled(reduced, H))


def test_the_internal_model_decays_at_a_limit_of_u():
    """Whatever u does there, for every theta of the box: that is the anti-windup."""
    reduced = drive()
    gains = designed(reduced, lower=1.0, upper=2.0)
    schedule = scheduled(gains, gains.box, 4)
    certificate = certify(saturated_loop(sampled(reduced, H), gains, schedule))
    assert certificate.proven
    at = schedule.at(np.array([1.5]))
    closed = gains.model.S(np.array([1.5])) - at.B_w @ at.K_w
    slowest = -np.linalg.eigvals(closed).real.max()
    assert slowest == pytest.approx(gains.decay_rate, rel=1e-9)
    # the correction is held over a step, a difference of the order of the step, and the gains are
    # interpolated
    assert certificate.rate == pytest.approx(slowest, rel=5.0 * H)


def test_a_sampled_loop_that_is_not_stable_is_refused_without_an_internal_model_too():
    """A step as long as the time constants of the loop."""
    reduced = drive()
    gains = replace(
        designed(reduced, lower=1.0, upper=2.0, Q=(1e4, 1e5, 1.0, 1.0)), decay_rate=None
    )
    with pytest.raises(AssumptionError, match=r"sampled loop of state feedback is not stable"):
        certify_compensator(gains, sampled(reduced, 0.5))


def test_feedforward_that_makes_the_loop_unstable_is_named():
    """Where u reaches y through one integrator, delta_hat answers to u with its filter's lag.

    Here by G C3 B = 3, of which F makes 6, more than 1: the loop is unstable at any step.
    """
    reduced = reduce(
        DescriptorSystem.partitioned(
            A=np.array([[-1.0, 1.0], [-1.0, -2.0]]),
            Bu=np.array([[3.0], [-5.0]]),
            Bd=np.array([[1.0], [0.0]]),
            C=np.array([[1.0, 0.0]]),
            n_a=2,
        )
    )
    plant = regulated_plant(reduced, [0])
    K = state_feedback(plant.A, plant.B, Q=np.ones(2))
    model = internal_model([Sine()], 1)
    box = ParameterBox(np.array([1.0]), np.array([1.0]))
    observer = realize(reduced, design(reduced, poles=[-4.0], filter_rate=50.0))
    outputs = StateSpace(observer.A, observer.B, observer.C[:3], observer.D[:3])
    system = ControlledPlant(plant=plant_of(reduced), observer=outputs, regulated=(0,), h=H)
    gains = CompensatorGains(
        plant=plant,
        K=K,
        F=feedforward(plant, K),
        N=no_gain(plant, 1),
        model=model,
        box=box,
        decay_rate=None,
    )
    with pytest.raises(
        AssumptionError, match=r"state feedback and feedforward .* delta_hat answers"
    ):
        certify_compensator(gains, system)
