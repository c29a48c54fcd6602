"""What the tables of a scenario say of the noise of y, and of theta, before any run."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any, Final

import numpy as np

from cosim.arrays import Matrix
from cosim.core.port import Port
from cosim.errors import UsageError, option, quoted
from cosim.scenario.kinds.base import Scenario
from cosim.scenario.kinds.control import SensorKind
from cosim.scenario.kinds.identification import IdentifierKind
from cosim.scenario.kinds.identified_plant import stated_covariance
from cosim.scenario.kinds.observers import UnknownInputObserverKind
from cosim.scenario.kinds.regressor import RegressorKind
from cosim.scenario.kinds.sources import DisturbanceKind
from cosim.scenario.kinds.terms import FamilyTerm

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
    kind = scenario.specs[identifier]
    designed = scenario.specs[observer]
    assert isinstance(kind, IdentifierKind)
    assert isinstance(designed, UnknownInputObserverKind)
    if given is None and kind.deviation is None and kind.covariance is not None:
        covariance = stated_covariance(None, kind.covariance, len(kind.covariance))
        assert covariance is not None
        return covariance, f"{identifier}.covariance"
    stated = {
        option("noise"): given,
        f"{identifier}.deviation": kind.deviation,
        f"{observer}.noise": designed.noise,
    }
    for source, values in stated.items():
        if values is not None:
            try:
                deviations = np.atleast_1d(np.asarray(values, np.float64))
                usable = (deviations > 0.0) & (deviations < math.inf)
                is_row = deviations.ndim == 1 and bool(usable.all())
            except (TypeError, ValueError):
                is_row = False
            if not is_row:
                raise UsageError(
                    f"{source}: expected positive finite standard deviations, got {quoted(values)}"
                )
            return deviations, source
    return _noise_of_sensor(scenario, observer)


def _noise_of_sensor(scenario: Scenario, observer: str) -> tuple[Matrix, str]:
    """Return the noise of the sensor that drives y directly."""
    to = Port(observer, "y")
    connection = scenario.connections.get(to)
    name = scenario.driver(to)
    kind = None if name is None else scenario.specs.get(name)
    if connection is None or not isinstance(kind, SensorKind):
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
    left: list[dict[str, Any] | None] = list(map(_shape, makes.terms))
    places = []
    for term in kind.terms:
        if _shape(term) in left:
            places.append(left.index(_shape(term)))
            left[places[-1]] = None
    if not len(places) == len(kind.terms) == len(left):
        raise UsageError(
            f"expected the same alphas and families in {regressor!r} and in {disturbance!r}, the "
            "source of the disturbance, got different terms"
        )
    parameters = []
    for place in places:
        theta = makes.terms[place].theta
        values = () if theta is None else theta
        parameters.append(np.atleast_1d(np.asarray(values, np.float64)).tolist())
    return parameters, places


def _shape(term: FamilyTerm) -> dict[str, Any]:
    """Return what a term has without its parameters and constants."""
    return {key: getattr(term, key) for key in FamilyTerm.model_fields}
