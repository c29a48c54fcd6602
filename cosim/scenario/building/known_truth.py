"""What the tables of a scenario say of the noise of y, and of theta, before any run."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix
from cosim.core.port import Port
from cosim.errors import UsageError, option
from cosim.scenario.building.parsing import Scenario
from cosim.scenario.kinds.control import SensorKind
from cosim.scenario.kinds.identification import IdentifierKind
from cosim.scenario.kinds.identified_plant import diagonal_covariance, stated_covariance
from cosim.scenario.kinds.observers import UnknownInputObserverKind
from cosim.scenario.kinds.regressor import RegressorKind
from cosim.scenario.kinds.sources import DisturbanceKind
from cosim.scenario.kinds.terms import FamilyTerm

NOISE_NEEDED: Final = (
    "the noise of y is unknown; expected a sensor with noise that drives the observer directly, "
    "the deviation of the identifier, or"
)


def noise_of(
    scenario: Scenario,
    identifier: str,
    observer: str,
    outputs: int,
    given: float | Sequence[float] | None = None,
) -> tuple[Matrix, str]:
    """Return the covariance of the noise of y, and where it is from.

    Parameters
    ----------
    scenario : Scenario
    identifier, observer : str
    outputs : int
        The number of elements of y.
    given : float or sequence of float, optional
        Deviations, in place of what the tables say.

    Raises
    ------
    UsageError
        If nothing says what it is, or deviations are not positive, or not as many.
    """
    kind = scenario.specs[identifier]
    designed = scenario.specs[observer]
    assert isinstance(kind, IdentifierKind)
    assert isinstance(designed, UnknownInputObserverKind)
    if given is None and kind.deviation is None and kind.covariance is not None:
        covariance = stated_covariance(None, kind.covariance, outputs)
        assert covariance is not None
        return covariance, f"{identifier}.covariance"
    stated = {
        option("noise"): given,
        f"{identifier}.deviation": kind.deviation,
        f"{observer}.noise": designed.noise,
    }
    for source, values in stated.items():
        if values is not None:
            return diagonal_covariance(source, values, outputs), source
    source, deviations = _noise_of_sensor(scenario, observer)
    return diagonal_covariance(source, deviations, outputs), source


def _noise_of_sensor(scenario: Scenario, observer: str) -> tuple[str, NDArray[np.float64]]:
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
    deviations = abs(float(connection.matrix)) * np.array(kind.noise, np.float64)
    if not deviations.all():
        raise UsageError(f"{NOISE_NEEDED} {option('noise')}")
    return f"{name}.noise", np.asarray(deviations)


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
