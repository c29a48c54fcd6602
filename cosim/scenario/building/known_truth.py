"""What the tables of a scenario say of the noise of y, and of theta, before any run."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any, Final

import numpy as np

from cosim.arrays import Matrix
from cosim.core.connections import Connection
from cosim.core.port import Port
from cosim.errors import UsageError, option
from cosim.scenario.building.parsing import Scenario
from cosim.scenario.kinds.control import SensorKind
from cosim.scenario.kinds.identification import IdentifierKind
from cosim.scenario.kinds.identified_plant import stated_covariance
from cosim.scenario.kinds.observers import UnknownInputObserverKind
from cosim.scenario.kinds.regressor import RegressorKind
from cosim.scenario.kinds.sources import DisturbanceKind
from cosim.scenario.kinds.terms import FamilyTerm, ValuedTerm

NOISE_NEEDED: Final = (
    "the noise of y is unknown; expected a sensor with noise that drives the observer directly, "
    "the deviation of the identifier, or"
)


def covariance_of(noise: Matrix, outputs: int) -> Matrix | None:
    """Return the covariance of noise from deviations, or as it is; None: they do not fit y."""
    if noise.ndim == 2:
        return noise
    if len(noise) not in (1, outputs):
        return None
    return np.diag(np.broadcast_to(noise, outputs) ** 2)


def noise_of(
    scenario: Scenario,
    identifier: str,
    observer: str,
    given: float | Sequence[float] | None = None,
) -> tuple[Matrix, str]:
    """Return deviations or covariance of the noise of y, and where they are from.

    Raises
    ------
    UsageError
        If nothing says what they are.
    """
    if given is not None:
        return _checked_deviations(given), option("noise")
    kind = scenario.specs[identifier]
    assert isinstance(kind, IdentifierKind)
    if kind.deviation is not None:
        return _checked_deviations(kind.deviation), f"{identifier}.deviation"
    if kind.covariance is not None:
        covariance = stated_covariance(None, kind.covariance, len(kind.covariance))
        assert covariance is not None
        return covariance, f"{identifier}.covariance"
    designed = scenario.specs[observer]
    assert isinstance(designed, UnknownInputObserverKind)
    if designed.noise is not None:
        return _checked_deviations(designed.noise), f"{observer}.noise"
    return _noise_of_sensor(scenario, observer)


def _checked_deviations(given: float | Sequence[float]) -> Matrix:
    deviations = np.atleast_1d(np.asarray(given, np.float64))
    usable = (deviations > 0.0) & (deviations < math.inf)
    if deviations.ndim != 1 or not usable.all():
        raise UsageError(f"noise: expected positive finite standard deviations, got {given}")
    return deviations


def _noise_of_sensor(scenario: Scenario, observer: str) -> tuple[Matrix, str]:
    """Return the noise of the sensor that drives y directly."""
    to = Port(observer, "y")
    connection: Connection | None = scenario.connections.get(to)
    name = scenario.driver(to)
    kind = None if name is None else scenario.specs.get(name)
    if connection is None or name is None or not isinstance(kind, SensorKind):
        raise UsageError(f"{NOISE_NEEDED} {option('noise')}")
    if connection.matrix.ndim:
        raise UsageError(
            f"'{to}' mixes the outputs of {name!r} by a matrix; give the noise of y by "
            f"{option('noise')}"
        )
    deviations = abs(float(connection.matrix)) * np.atleast_1d(np.asarray(kind.noise, np.float64))
    if not deviations.all():
        raise UsageError(f"{NOISE_NEEDED} {option('noise')}")
    return deviations, f"{name}.noise"


def disturbance_among(scenario: Scenario, components: Collection[str]) -> str | None:
    """Return the only component that makes a disturbance of the class; None: there is not one."""
    names = [name for name in components if isinstance(scenario.specs[name], DisturbanceKind)]
    return names[0] if len(names) == 1 else None


def parameters_by_term(
    scenario: Scenario, regressor: str, disturbance: str
) -> tuple[list[list[float]], list[int]]:
    """Return the parameters of every term of a regressor, and which of the disturbance it is.

    Raises
    ------
    UsageError
        If their terms differ.
    """
    kind = scenario.specs[regressor]
    makes = scenario.specs[disturbance]
    assert isinstance(kind, RegressorKind)
    assert isinstance(makes, DisturbanceKind)
    places = _places(kind.terms, makes.terms)
    if places is None:
        raise UsageError(
            f"expected the same alphas and families in {regressor!r} and in {disturbance!r}, the "
            "source of the disturbance, got different terms"
        )
    return [_values(makes.terms[place]) for place in places], places


def _places(terms: Sequence[FamilyTerm], others: Sequence[FamilyTerm]) -> list[int] | None:
    """Return which of the other terms each term is; None: they differ."""
    left = list(range(len(others)))
    places = []
    for term in terms:
        same = [place for place in left if _shape(others[place]) == _shape(term)]
        if not same:
            return None
        left.remove(same[0])
        places.append(same[0])
    return None if left else places


def _shape(term: FamilyTerm) -> dict[str, Any]:
    """Return what a term has without its parameters and constants."""
    return {key: getattr(term, key) for key in FamilyTerm.model_fields}


def _values(term: ValuedTerm) -> list[float]:
    theta = () if term.theta is None else term.theta
    return [float(value) for value in np.atleast_1d(theta)]
