"""Outputs sampled at instants of their own count there, whatever the communication step."""

from __future__ import annotations

import pickle
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import cosim
from cosim.blocks.estimator import Estimator
from cosim.blocks.output_error_identifier import OutputErrorIdentifier
from cosim.core.contracts import Stopped, prepare
from cosim.errors import AssumptionError, RunError
from cosim.fmi.component import load
from cosim.fmi.exporting.export import export
from cosim.fmi.exporting.identifier import output_error
from cosim.fmi.exporting.kernels import DiscreteModel
from cosim.fmi.options import FmuOptions
from cosim.scenario.building.build import Builder
from cosim.theory.disturbances.families import Exponential
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
from cosim.theory.estimators.output_error import fit_output_error
from cosim.theory.forced_response import simulate
from cosim.theory.plants.descriptor import reduce
from tests.theory.academic import THETA, academic, alpha, delta

H = 1e-2
STEPS = 2000
SIGMA = 1e-3
MOST = 2


@pytest.fixture(scope="module")
def run():
    """Return a scenario with output error, and a run of it."""
    changes = {
        "identifier.method": "output-error",
        "identifier.period": 2.0,
        "scenario.stop": STEPS * H,
        "scenario.step": H,
        "observer.filter_rate": 50.0,
    }
    scenario = cosim.load("academic").set(changes)
    return scenario, cosim.run(scenario)


def identifier(scenario, *, most=MOST, plant=None, at_points=False) -> Estimator:
    with ExitStack() as resources:
        built = Builder(scenario, resources).components["identifier"]._component.method
    problem = built.problem
    if plant is not None:
        object.__setattr__(problem, "plant", plant)
    unbounded = np.full(2, np.inf)
    method = OutputErrorIdentifier(
        problem, built.schedule, offset=False, lower=-unbounded, upper=unbounded, most=most
    )
    method = replace(method, at_points=at_points)
    made = Estimator(method)
    n_u = made.interface.n_u
    made.prepare(H, np.zeros(n_u, np.bool_), {})
    return made


def outputs_at(t):
    """Solve the plant for the true disturbance, to 1e-12."""
    reduced = reduce(academic())

    def rate(t, x):
        forced = reduced.B_1a[:, 0] * np.sin(t) + reduced.B_2a[:, 0] * delta(np.array([t]))[0]
        return reduced.A_a @ x + forced

    solution = solve_ivp(
        rate, (0.0, STEPS * H), [1.0, -1.0], method="DOP853", rtol=1e-12, atol=1e-13, t_eval=t
    )
    return (reduced.C3 @ solution.y)[0] + reduced.C4[0, 0] * np.sin(t)


def rows(log, times, y):
    """Return the inputs of an identifier that gets samples at times of their own."""
    t = log.time("plant.y")
    samples = np.full((len(t), MOST), np.nan)
    instants = np.full((len(t), MOST), np.nan)
    for time, value in zip(times, y, strict=True):
        k = np.searchsorted(t, time)
        place = int(np.isfinite(instants[k]).sum())
        instants[k, place] = time
        samples[k, place] = value
    columns = [log["regressor.mu"], log["observer.delta"][:, np.newaxis]]
    columns += [log["plant.y"][:, np.newaxis], samples, instants, log["u.y"][:, np.newaxis]]
    return t, np.ascontiguousarray(np.hstack(columns))


def estimate(component, t, u):
    component.initialize(t[0], u[0])
    return component.advance(t, H, u)


def test_samples_at_the_communication_points_are_the_outputs_there(run):
    """Bit for bit the same estimates, and different ones without the samples of some points."""
    scenario, log = run
    t, u = rows(log, log.time("plant.y"), log["plant.y"])
    plain = identifier(scenario, most=0)
    u_plain = np.delete(u, range(8, 8 + 2 * MOST), axis=1)
    expected = estimate(plain, t, u_plain)
    found = estimate(identifier(scenario), t, u)
    np.testing.assert_array_equal(found, expected)
    assert np.isfinite(found[-1]).all()
    u[::7, 8 : 8 + 2 * MOST] = np.nan
    assert not np.array_equal(estimate(identifier(scenario), t, u)[-1], expected[-1])


def test_samples_between_communication_points_count_at_their_instants(run):
    """The estimate is that of a fit over the samples alone, and y at the points does not matter."""
    scenario, log = run
    rng = np.random.default_rng(1)
    times = 0.8 * H * np.arange(1, 2400) + rng.uniform(0.0, 1e-3, 2399)
    times = np.sort(rng.choice(times, 2376, replace=False))
    y = outputs_at(times) + SIGMA * rng.standard_normal(len(times))
    t, u = rows(log, times, y)
    component = identifier(scenario)
    found = estimate(component, t, u)[-1]
    used = times[times <= t[-2]]
    data = DataSet(used, y[: len(used), np.newaxis], np.sin(used)[:, np.newaxis], alpha(used))
    families = (Exponential(), Exponential())
    fit = fit_output_error([data], component.method.problem.plant, families, np.array(THETA))
    # both take straight lines for curves, of 10 ms and of 8 ms: 5e-7 at 1 ms, by the square
    assert (np.abs(found[:2] - fit.theta) < 5e-5).all()
    assert (np.abs(found[:2] - fit.theta) < 0.05 * fit.standard_error).all()
    np.testing.assert_allclose(found[2:4], fit.standard_error, rtol=1e-2)
    assert found[4] == pytest.approx(fit.deviation, rel=1e-3)
    u[:, 7] += 1.0
    np.testing.assert_array_equal(estimate(component, t, u)[-1], found)


def test_a_sample_outside_its_step_stops_the_run(run):
    """What belongs to no step would be taken for a sample of another instant."""
    scenario, log = run
    t, u = rows(log, [0.5 * H, 1.5 * H], [1.0, 1.0])
    u[2, 8 + MOST] = 0.5 * H
    component = identifier(scenario)
    component.initialize(t[0], u[0])
    with pytest.raises(Stopped, match=r"a sample at 0\.02 s"):
        component.advance(t, H, u)


def test_samples_of_an_unstable_plant_are_refused(run):
    """A predicted output needs the measured one before it."""
    scenario, _ = run
    plant = DisturbedPlant(
        A=np.diag([0.8, -1.0]),
        B=np.ones((2, 1)),
        Bd=np.ones((2, 2)),
        C=np.ones((1, 2)),
        D=np.zeros((1, 1)),
        Dd=np.zeros((1, 2)),
    )
    with pytest.raises(AssumptionError, match="the plant is unstable"):
        identifier(scenario, plant=plant)


UNSTABLE = DisturbedPlant(
    A=np.array([[0.4, 0.3], [0.0, -1.0]]),
    B=np.array([[1.0], [0.5]]),
    Bd=np.ones((2, 2)),
    C=np.array([[1.0, 0.5]]),
    D=np.full((1, 1), 0.3),
    Dd=np.array([[0.2, 0.2]]),
)


def unstable_rows():
    """Return times, the inputs of an identifier, and a record with a gap and every fifth lost."""
    t = np.arange(STEPS + 1) * H
    u = np.sin(t)
    forcing = np.column_stack([u, alpha(t) * np.exp(np.outer(t, THETA))])
    inputs = np.hstack([UNSTABLE.B, UNSTABLE.Bd])
    x = simulate(UNSTABLE.A, inputs, t, forcing, np.array([0.1, -0.2]), np.zeros(3, np.bool_))
    rng = np.random.default_rng(1)
    y = x @ UNSTABLE.C[0] + forcing @ np.hstack([UNSTABLE.D, UNSTABLE.Dd])[0]
    y = y + 1e-2 * rng.standard_normal(len(t))
    lost = rng.random(len(t)) < 0.2
    lost[600:700] = True
    lost[0] = True
    samples = np.where(lost, np.nan, y)
    nothing = np.full((len(t), 6), np.nan)
    times = np.where(lost, np.nan, t)
    rows = np.column_stack([nothing, np.zeros(len(t)), y, samples, times, u])
    used = slice(None, -1)
    record = DataSet(t[used], samples[used, np.newaxis], u[used, np.newaxis], alpha(t[used]))
    return t, rows, record


def test_missing_samples_of_an_unstable_plant_are_predictions_without_correction(run):
    """The estimate has the interval that a fit of the record has, whatever comes in one call."""
    scenario, _ = run
    t, u, record = unstable_rows()
    component = identifier(scenario, most=1, plant=UNSTABLE, at_points=True)
    found = estimate(component, t, u)[-1]
    families = (Exponential(), Exponential())
    fit = fit_output_error([record], UNSTABLE, families, np.array(THETA))
    # the fit goes on until a step is small, online it ends a little earlier
    assert (np.abs(found[:2] - fit.theta) < 0.05 * fit.standard_error).all()
    np.testing.assert_allclose(found[2:4], fit.standard_error, rtol=0.02)
    assert found[4] == pytest.approx(fit.deviation, rel=1e-3)
    component.initialize(t[0], u[0])
    component.advance(t[:651], H, u[:651])
    state = component.save()
    component.advance(t[650:801], H, u[650:801])
    component.restore(state)
    np.testing.assert_array_equal(component.advance(t[650:], H, u[650:])[-1], found)
    another = identifier(scenario, most=1, plant=UNSTABLE, at_points=True)
    another.initialize(t[0], u[0])
    another.restore(pickle.loads(pickle.dumps(state)))
    np.testing.assert_array_equal(another.advance(t[650:], H, u[650:])[-1], found)


def test_a_pickled_state_has_the_samples_between_the_points(run):
    """In another identifier, which has taken others before."""
    scenario, log = run
    times = 0.8 * H * np.arange(1, 2400)
    t, u = rows(log, times, outputs_at(times))
    component = identifier(scenario)
    component.initialize(t[0], u[0])
    component.advance(t[:1201], H, u[:1201])
    state = pickle.dumps(component.save())
    expected = component.advance(t[1200:], H, u[1200:])
    assert np.isfinite(expected[-1]).all()
    another = identifier(scenario)
    others = u.copy()
    others[:, 8 : 8 + MOST] *= 1.5
    estimate(another, t[:801], others[:801])
    another.restore(pickle.loads(state))
    np.testing.assert_array_equal(another.advance(t[1200:], H, u[1200:]), expected)


def test_an_unstable_plant_with_all_its_samples_is_predicted_with_a_constant_gain(run):
    """Which is where the gains of a predictor settle that begins with their covariance."""
    scenario, _ = run
    t, u, _ = unstable_rows()
    u[:, 8] = u[:, 7]
    u[:, 9] = t
    found = estimate(identifier(scenario, most=1, plant=UNSTABLE, at_points=True), t, u)[-1]
    plain = identifier(scenario, most=0, plant=UNSTABLE)
    expected = estimate(plain, t, np.delete(u, [8, 9], axis=1))[-1]
    np.testing.assert_allclose(found, expected, rtol=1e-7)


def test_samples_between_the_points_stop_an_unstable_plant(run):
    """One is said to be of a communication point, and is not."""
    scenario, _ = run
    t, u, _ = unstable_rows()
    u[50, 8:10] = 0.0, t[50] - 0.5 * H
    component = identifier(scenario, most=1, plant=UNSTABLE, at_points=True)
    component.initialize(t[0], u[0])
    with pytest.raises(
        Stopped,
        match=r"a sample at 0\.5 s has a time stamp before the previous communication point",
    ):
        component.advance(t, H, u)


def test_inputs_that_are_held_are_held_up_to_the_sample(run):
    """With u constant over a step, also what is between its ends is that of a constant u."""
    scenario, log = run
    reduced = reduce(academic())
    t = log.time("plant.y")
    u = np.sin(t)
    part = 0.4
    times = t[:-1] + part * H

    def rate(time, x):
        return reduced.A_a @ x + reduced.B_2a[:, 0] * delta(np.array([time]))[0]

    free = solve_ivp(
        rate, (0.0, t[-1]), [1.0, -1.0], method="DOP853", rtol=1e-12, atol=1e-13, t_eval=times
    )
    whole, after_part = (held_response(reduced, h) for h in (H, part * H))
    x = np.zeros(2)
    y = reduced.C3 @ free.y
    for k in range(len(times)):
        y[:, k] += reduced.C3 @ (after_part[0] @ x + after_part[1] * u[k]) + reduced.C4[0] * u[k]
        x = whole[0] @ x + whole[1] * u[k]
    _, rows_held = rows(log, times, y[0])
    component = identifier(scenario)
    held = np.zeros(component.interface.n_u, np.bool_)
    held[-1] = True
    component.prepare(H, held, {})
    found = estimate(component, t, rows_held)[-1]
    # straight lines for the curves of the disturbance: 5e-7 at 1 ms, by the square
    assert (np.abs(found[:2] - THETA) < 5e-5).all()
    component.prepare(H, np.zeros_like(held), {})
    assert np.abs(estimate(component, t, rows_held)[-1][:2] - THETA).max() > 1e-3


def held_response(reduced, h):
    """Return expm(A h) and the response to a constant input after h."""
    generator = np.zeros((3, 3))
    generator[:2, :2] = reduced.A_a
    generator[:2, 2] = reduced.B_1a[:, 0]
    exponential = expm(generator * h)
    return exponential[:2, :2], exponential[:2, 2]


@pytest.mark.slow
def test_an_exported_identifier_takes_the_samples_too(run, tmp_path):
    """Bit for bit as the component, and it names what stops it as the component does."""
    scenario, log = run
    times = 0.8 * H * np.arange(1, 2400)
    t, u = rows(log, times, outputs_at(times))
    component = identifier(scenario)
    expected = estimate(component, t, u)
    held = np.zeros(component.interface.n_u, np.bool_)
    design = component.method.design(H, held)
    kernel = output_error(component.method.constants(H, held, design))
    model = DiscreteModel(component.interface, kernel, round(H * 1e9), "it is discrete")
    path = tmp_path / "identifier.fmu"
    export(model, path, name="identifier", fmi="3")

    def advance(u):
        with load(path, FmuOptions(interface_type="cs")) as fmu:
            prepare(fmu.component, H, held, {})
            return estimate(fmu.component, t, u)

    assert np.isfinite(expected[-1]).all()
    np.testing.assert_array_equal(advance(u), expected)
    u[7, 8 + MOST] = t[7] + 0.5 * H
    with pytest.raises(RunError, match="instant that is not since the communication point before"):
        advance(u)
