"""What the kernels of estimation hold: what is too much is refused, all else is right.

Their arrays of fixed size stand on the stack of the process, so that a size that nobody checks is a
wrong number at best.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, final

import numpy as np
import pytest

import cosim
import cosim.native
from cosim.core.contracts import Stopped
from cosim.errors import AssumptionError, UsageError
from cosim.native.estimation import output_error
from cosim.native.estimation.rayleigh import MOST_ROWS, MOST_TERMS
from cosim.native.estimation.start_grid import MOST_STARTS, StartGridModel
from cosim.theory.disturbances.families import (
    Exponential,
    SearchBox,
    Sine,
    coefficients,
    generators,
    group_by_alpha,
)
from cosim.theory.disturbances.regression import chi, expand
from cosim.theory.disturbed_plant import DataSet, DisturbedPlant, sample_plant, white_noise
from cosim.theory.estimators.output_error import fit_output_error
from cosim.theory.estimators.rayleigh import rayleigh_constants
from cosim.theory.estimators.start_grid import start_grid
from tests.native.estimation.online import H, online
from tests.theory.closed_forms import static_plant
from tests.theory.estimators.passes import extended_kalman, noise_covariance, rayleigh

T = np.arange(1001) * H


@final
@dataclass(frozen=True)
class Harmonics:
    """A periodic signal of known rates: many basis functions, no parameter."""

    count: int
    name: ClassVar[str] = "harmonics"
    parameters: ClassVar[tuple[str, ...]] = ()
    even: ClassVar[tuple[bool, ...]] = ()
    graded: ClassVar[tuple[bool, ...]] = ()

    @property
    def v(self):
        return 2 * self.count

    @property
    def c(self):
        return np.tile([1.0, 0.0], self.count)

    def G(self, theta):
        matrix = np.zeros((self.v, self.v))
        for k in range(self.count):
            rate = 0.7 * (k + 1)
            matrix[2 * k, 2 * k + 1] = rate
            matrix[2 * k + 1, 2 * k] = -rate
        return matrix

    def search(self, span, shortest):
        return ()

    def theta_from_roots(self, z, spacing):
        return np.zeros(0)


@final
@dataclass(frozen=True)
class Constant:
    """An unknown factor of alpha: one basis function, no parameter."""

    name: ClassVar[str] = "constant"
    parameters: ClassVar[tuple[str, ...]] = ()
    even: ClassVar[tuple[bool, ...]] = ()
    graded: ClassVar[tuple[bool, ...]] = ()
    v: ClassVar[int] = 1

    @property
    def c(self):
        return np.ones(1)

    def G(self, theta):
        return np.zeros((1, 1))

    def search(self, span, shortest):
        return ()

    def theta_from_roots(self, z, spacing):
        return np.zeros(0)


def lightly_damped(states, components, outputs=1):
    """Return oscillators beside each other, driven and seen together."""
    A = np.zeros((states, states))
    for i in range(0, states - 1, 2):
        rate = 1.0 + 0.85 * i
        A[i : i + 2, i : i + 2] = [[-0.01, rate], [-rate, -0.01]]
    return DisturbedPlant(
        A=A,
        B=np.ones((states, 1)),
        Bd=np.ones((states, components)),
        C=np.linspace(1.0, 2.0, outputs)[:, np.newaxis] * np.ones((outputs, states)),
        D=np.zeros((outputs, 1)),
        Dd=np.zeros((outputs, components)),
    )


def test_the_limits_are_those_of_the_kernels():
    """Every one of the headers has its number in the file that checks it."""
    folder = Path(cosim.native.__file__).parent
    headers = "".join(path.read_text() for path in sorted(folder.rglob("*.h")))
    limits = dict(re.findall(r"#define COSIM_(MOST_\w+) (\d+)", headers))
    checked = {
        "MOST_COLUMNS": output_error.MOST_COLUMNS,
        "MOST_PARAMETERS": output_error.MOST_PARAMETERS,
        "MOST_TERMS": MOST_TERMS,
        "MOST_ROWS": MOST_ROWS,
        "MOST_STARTS": MOST_STARTS,
    }
    assert {name: int(limit) for name, limit in limits.items()} == checked


def test_a_plant_of_many_states_has_no_identifier_by_output_error():
    """60 states, 2 amplitudes and their 2 derivatives; 47 columns in all are possible."""
    with pytest.raises(AssumptionError, match=r"60 states.*64 columns.*and 47 columns.*least"):
        online(lightly_damped(60, 2)).prepare(H, np.zeros(9, np.bool_), {})
    online(lightly_damped(43, 2)).prepare(H, np.zeros(9, np.bool_), {})


def test_an_observer_of_many_modes_has_none_either():
    """Its transients are unknowns of the fit to delta."""
    identifier = online(lightly_damped(2, 2), modes=60)
    with pytest.raises(AssumptionError, match=r"fit to delta has 2 .* 60 modes of the observer"):
        identifier.prepare(H, np.zeros(9, np.bool_), {})


def test_a_plant_of_many_states_is_not_fitted():
    """The same sentence for recorded data."""
    data = DataSet(T, np.ones((len(T), 1)), np.zeros((len(T), 1)), np.ones((len(T), 1)))
    with pytest.raises(AssumptionError, match=r"60 states.*62 columns"):
        fit_output_error([data], lightly_damped(60, 1), [Exponential()], np.array([-0.1]))


def test_many_outputs_are_fitted():
    """70 of them: theta of samples that the model made is that of the model."""
    plant = lightly_damped(4, 1, outputs=70)
    alpha = 1.35 + 0.25 * np.sin(1.7 * T)[:, np.newaxis]
    silent = DataSet(T, np.zeros((len(T), 70)), np.sin(T)[:, np.newaxis], alpha)
    matrices = generators([Exponential()])
    record = sample_plant(plant, matrices, silent, noise=white_noise(70)).record(silent)
    response = record.rows(np.array([-0.3]))[:, :, 0]
    data = replace(silent, y=1.5 * response - record.residual)
    fit = fit_output_error([data], plant, [Exponential()], np.array([-0.1]))
    assert fit.converged
    # rounding of 70 000 rows, over what they say of theta
    np.testing.assert_allclose(fit.theta, [-0.3], rtol=1e-9)


def test_the_identifier_takes_many_outputs():
    """70 of them, each with noise of its own: theta has no value, as with one."""
    rng = np.random.default_rng(1)
    samples = rng.standard_normal((201, 70))
    rest = rng.standard_normal((201, 8))
    estimates = []
    for outputs in (1, 70):
        plant = lightly_damped(2, 2)
        plant = replace(
            plant,
            C=np.repeat(plant.C, outputs, axis=0),
            D=np.repeat(plant.D, outputs, axis=0),
            Dd=np.repeat(plant.Dd, outputs, axis=0),
        )
        identifier = online(plant)
        y = samples[:, :outputs]
        inputs = np.hstack([rest[:, :7], y, rest[:, 7:]])
        identifier.prepare(H, np.zeros(inputs.shape[1], np.bool_), {})
        identifier.initialize(0.0, inputs[0])
        estimates.append(identifier.advance(T[:201], H, inputs)[-1])
    one, many = estimates
    # noise is no disturbance
    assert np.isnan(one[:2]).all()
    assert np.isnan(many[:2]).all()


def test_samples_beyond_the_room_stop_the_identifier():
    """It has that of a run; the estimates before are returned."""
    identifier = online(lightly_damped(2, 2))
    rows = np.random.default_rng(0).standard_normal((1011, 9))
    identifier.prepare(H, np.zeros(9, np.bool_), {})
    identifier.initialize(0.0, rows[0])
    with pytest.raises(Stopped, match=r"no room for more samples at 10\.0 s") as caught:
        identifier.advance(np.arange(1011) * H, H, rows)
    assert caught.value.steps == 1000


def test_many_components_without_parameters_are_fitted():
    """40 known signals of unknown size: linear least squares, beside numpy's."""
    alphas = np.stack([np.cos(0.31 * (i + 1) * T) for i in range(40)], axis=1)
    y = alphas @ np.linspace(1.0, 2.0, 40)
    y += 1e-3 * np.random.default_rng(0).standard_normal(len(T))
    data = DataSet(T, y[:, np.newaxis], np.zeros((len(T), 0)), alphas)
    fit = fit_output_error([data], static_plant(40), [Constant()] * 40, np.zeros(0))
    expected = np.linalg.lstsq(alphas, y, rcond=None)[0]
    np.testing.assert_allclose(fit.amplitudes[0], expected, rtol=1e-10)
    covariance = np.linalg.inv(alphas.T @ alphas)
    statistics = expected**2 / np.diag(covariance) / fit.deviation**2
    np.testing.assert_allclose(fit.presence, statistics, rtol=1e-9)


def test_a_component_of_many_basis_functions_is_there():
    """20 of them: their statistic is beta' C^-1 beta of linear least squares."""
    family = Harmonics(10)
    rates = 0.7 * np.arange(1, 11)
    columns = []
    for rate in rates:
        columns += [np.cos(rate * T), np.sin(rate * T)]
    basis = np.stack(columns, axis=1)
    y = basis @ np.linspace(1.0, 2.0, 20)
    y += 1e-3 * np.random.default_rng(0).standard_normal(len(T))
    data = DataSet(T, y[:, np.newaxis], np.zeros((len(T), 0)), np.ones((len(T), 1)))
    fit = fit_output_error([data], static_plant(1), [family], np.zeros(0))
    solution = np.linalg.lstsq(basis, y, rcond=None)[0]
    np.testing.assert_allclose(fit.amplitudes[0], solution, rtol=1e-9)
    statistic = np.sum(np.square(basis @ solution)) / fit.deviation**2
    np.testing.assert_allclose(fit.presence, [statistic], rtol=1e-8)


def test_the_grid_of_starts_takes_many_components():
    """40 known signals beside one exponential: the best point is theta."""
    families = [Exponential(), *[Constant()] * 40]
    alphas = np.stack([np.cos(0.31 * i * T) for i in range(41)], axis=1)
    plant = static_plant(41)
    y = np.exp(-0.55 * T)[:, np.newaxis] + alphas[:, 1:].sum(axis=1, keepdims=True)
    data = DataSet(T, y, np.zeros((len(T), 0)), alphas)
    sampled = sample_plant(plant, generators(families), data, noise=white_noise(1))
    constants = sampled.model.constants
    grid = StartGridModel(
        start_grid(constants, SearchBox(np.array([-2.0]), np.array([0.0])), points=20, average=1)
    )
    record = sampled.record(data)
    samples = type(record)(grid.model, record.residual, record.alpha)
    triangle = samples.make(np.zeros(0))
    starts = grid.search([triangle], 3)
    np.testing.assert_allclose(starts[0], [-0.55], rtol=1e-12)
    with pytest.raises(UsageError, match="most: expected 1 to 16, got 17 starts"):
        grid.search([triangle], 17)


def test_the_quotient_of_many_rows_is_that_of_the_determinants():
    """Six sines under one alpha: 13 rows, 13 terms; chi beside numpy's determinants."""
    families = [Sine()] * 6
    groups = group_by_alpha(["1"] * 6, families)
    terms = expand((12,))
    delays = [0.25 * (j + 1) for j in range(13)]
    constants = rayleigh_constants(families, groups, terms, delays)
    mu = np.random.default_rng(0).standard_normal((800, 13))
    N = noise_covariance(terms, np.ones((800, 13)))
    theta = np.linspace(0.7, 7.2, 6)
    found = rayleigh(replace(constants, lower=theta, upper=theta), mu, N, theta=theta)
    rates = [np.array([rate]) for rate in theta]
    vector = np.array(chi(terms, [coefficients(families, rates, delays)]))
    quotient = (vector @ (mu.T @ mu) @ vector) / (vector @ N @ vector)
    # the condition of 12 of the rows is 4e3 at most
    assert found.variance == pytest.approx(quotient, rel=1e-10)


def test_a_regression_of_too_many_rows_is_refused():
    """24 sines under one alpha need 49 delays."""
    families = [Sine()] * 24
    groups = group_by_alpha(["1"] * 24, families)
    delays = [0.25 * (j + 1) for j in range(49)]
    with pytest.raises(AssumptionError, match=f"at most {MOST_ROWS} delays, got 49"):
        rayleigh_constants(families, groups, expand((48,)), delays)


def test_a_regression_of_too_many_parameters_is_refused():
    """17 exponentials under one alpha."""
    families = [Exponential()] * 17
    groups = group_by_alpha(["1"] * 17, families)
    delays = [0.25 * (j + 1) for j in range(18)]
    with pytest.raises(AssumptionError, match="at most 16 parameters, got 17"):
        rayleigh_constants(families, groups, expand((17,)), delays)


def test_the_extended_filter_takes_many_components():
    """60 that reach no output change nothing but the rounding."""
    plant = lightly_damped(2, 1)
    y = 1e-2 * np.random.default_rng(0).standard_normal((len(T), 1))
    y += np.exp(-0.3 * T)[:, np.newaxis]
    u = np.sin(T)[:, np.newaxis]
    alone = extended_kalman(T, y, u, ["1"], plant, [Exponential()])
    unseen = replace(
        plant,
        Bd=np.hstack([plant.Bd, np.zeros((2, 60))]),
        Dd=np.hstack([plant.Dd, np.zeros((1, 60))]),
    )
    families = [Exponential(), *[Constant()] * 60]
    beside = extended_kalman(T, y, u, ["1"] * 61, unseen, families)
    np.testing.assert_allclose(beside.theta, alone.theta, rtol=1e-6)
    np.testing.assert_allclose(beside.standard_error, alone.standard_error, rtol=1e-6)


def test_the_extended_filter_takes_many_states():
    """60 of them: it needs no room for columns."""
    plant = lightly_damped(60, 1)
    y = np.zeros((50, 1))
    filtered = extended_kalman(T[:50], y, y, ["1"], plant, [Exponential()])
    assert filtered.theta.shape == (49, 1)


@pytest.mark.slow
def test_a_run_whose_samples_do_not_fit_into_memory_is_refused_with_their_size():
    """Before its first step; a method that keeps none runs, and a check goes on."""
    edits = {"scenario.stop": 1e8}  # of 1e11 steps, 6 numbers each
    with pytest.raises(UsageError, match=r"100000000000 steps need 4\.47e\+03 GiB"):
        cosim.run("academic", set=edits)
    report = cosim.check_assumptions("academic", set=edits)
    assert "GiB" in str(report.to_dict())
    assert cosim.check_assumptions("academic", set={**edits, "identifier.method": "gradient"})
