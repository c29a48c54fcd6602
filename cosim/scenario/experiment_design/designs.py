"""What the ranking of the choices for an experiment consists of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from cosim.arrays import Vector


@dataclass(frozen=True, eq=False, kw_only=True)
class RankedDesign:
    """A choice, and the error of theta that is to be expected with it.

    Parameters
    ----------
    choice : str
        What is chosen: ``scenario`` for all as it is, ``delays``, ``filter``, ``step``, ``window``,
        ``input``, or ``together``.
    settings : mapping of dotted key to value
        What the choice sets.
    method : str
        Of the estimator.
    bias, standard_error, error : Vector, shape (P,)
        Mean of the estimates less theta, their deviation, and both together as root mean square;
        infinite where the estimator finds no theta.
    ratio : float
        The largest error over the Cramer-Rao bound of y with the scenario as it is.
    """

    choice: str
    settings: Mapping[str, Any]
    method: str
    bias: Vector
    standard_error: Vector
    error: Vector
    ratio: float

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "choice": self.choice,
            "settings": dict(self.settings),
            "method": self.method,
            "bias": self.bias.tolist(),
            "standard_error": self.standard_error.tolist(),
            "error": self.error.tolist(),
            "ratio": self.ratio,
        }


@dataclass(frozen=True, eq=False, kw_only=True)
class OmittedDesigns:
    """Choices that have no error to be expected, all for one reason.

    Parameters
    ----------
    choice : str
        As of a :class:`RankedDesign`.
    method : str
        Of the estimator; empty: all of them.
    settings : tuple of mapping of dotted key to value
        What each choice sets.
    reason : str
    """

    choice: str
    method: str
    settings: tuple[Mapping[str, Any], ...]
    reason: str

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "choice": self.choice,
            "method": self.method,
            "settings": [dict(settings) for settings in self.settings],
            "reason": self.reason,
        }


@dataclass(frozen=True, eq=False, kw_only=True)
class ExperimentDesign:
    """Choices for a scenario, ranked by the error of theta that is to be expected.

    Parameters
    ----------
    scenario : str
    identifier : str
    theta : Vector, shape (P,)
    deviations : Vector, shape (n_y,)
        Of the noise of y.
    noise_source : str
    bound : Vector, shape (P,)
        The least standard errors of theta from y, by output error, with the scenario as it is.
    designs : tuple of RankedDesign
        By choice; within a choice and a method the best first. Those of the scenario as it is may
        have an infinite error, no others.
    omitted : tuple of OmittedDesigns
        What was not tried, is refused, or finds no theta.
    notes : tuple of str
    """

    scenario: str
    identifier: str
    theta: Vector
    deviations: Vector
    noise_source: str
    bound: Vector
    designs: tuple[RankedDesign, ...]
    omitted: tuple[OmittedDesigns, ...]
    notes: tuple[str, ...]

    def of(self, choice: str, method: str) -> tuple[RankedDesign, ...]:
        """Return the designs of a choice and a method, the best first."""
        return tuple(
            design for design in self.designs if design.choice == choice and design.method == method
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "scenario": self.scenario,
            "identifier": self.identifier,
            "theta": self.theta.tolist(),
            "deviations": self.deviations.tolist(),
            "noise": self.noise_source,
            "bound": self.bound.tolist(),
            "designs": [design.to_dict() for design in self.designs],
            "omitted": [omitted.to_dict() for omitted in self.omitted],
            "notes": list(self.notes),
        }
