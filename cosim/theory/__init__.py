"""The method as pure functions on frozen data.

Reduction, observer, disturbance class, regression, estimators.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from cosim.lazy import lazy_names

if TYPE_CHECKING:
    from cosim.theory.descriptor import (
        DescriptorSystem,
        ReducedSystem,
        disturbance_transfer,
        invariant_zeros,
        pencil_index,
        reduce,
    )
    from cosim.theory.disturbance import (
        AlphaGroup,
        Exponential,
        Family,
        Sine,
        coefficients,
        group_by_alpha,
    )
    from cosim.theory.estimators.least_squares import (
        Recovery,
        least_squares,
        plan,
        recover,
        trapezoid_weights,
    )
    from cosim.theory.observer import (
        IdentificationStartTime,
        ObserverDesign,
        StateSpace,
        design,
        identification_start_time,
        realize,
    )
    from cosim.theory.regression import Term, chi, eta, expand, mu
    from cosim.theory.uncertainty import information, verdict

_HOMES = {
    "AlphaGroup": "cosim.theory.disturbance",
    "chi": "cosim.theory.regression",
    "coefficients": "cosim.theory.disturbance",
    "DescriptorSystem": "cosim.theory.descriptor",
    "design": "cosim.theory.observer",
    "disturbance_transfer": "cosim.theory.descriptor",
    "eta": "cosim.theory.regression",
    "expand": "cosim.theory.regression",
    "Exponential": "cosim.theory.disturbance",
    "Family": "cosim.theory.disturbance",
    "group_by_alpha": "cosim.theory.disturbance",
    "identification_start_time": "cosim.theory.observer",
    "IdentificationStartTime": "cosim.theory.observer",
    "information": "cosim.theory.uncertainty",
    "invariant_zeros": "cosim.theory.descriptor",
    "least_squares": "cosim.theory.estimators.least_squares",
    "mu": "cosim.theory.regression",
    "ObserverDesign": "cosim.theory.observer",
    "pencil_index": "cosim.theory.descriptor",
    "plan": "cosim.theory.estimators.least_squares",
    "realize": "cosim.theory.observer",
    "recover": "cosim.theory.estimators.least_squares",
    "Recovery": "cosim.theory.estimators.least_squares",
    "reduce": "cosim.theory.descriptor",
    "ReducedSystem": "cosim.theory.descriptor",
    "Sine": "cosim.theory.disturbance",
    "StateSpace": "cosim.theory.observer",
    "Term": "cosim.theory.regression",
    "trapezoid_weights": "cosim.theory.estimators.least_squares",
    "verdict": "cosim.theory.uncertainty",
}

__all__ = [
    "AlphaGroup",
    "DescriptorSystem",
    "Exponential",
    "Family",
    "IdentificationStartTime",
    "ObserverDesign",
    "Recovery",
    "ReducedSystem",
    "Sine",
    "StateSpace",
    "Term",
    "chi",
    "coefficients",
    "design",
    "disturbance_transfer",
    "eta",
    "expand",
    "group_by_alpha",
    "identification_start_time",
    "information",
    "invariant_zeros",
    "least_squares",
    "mu",
    "pencil_index",
    "plan",
    "realize",
    "recover",
    "reduce",
    "trapezoid_weights",
    "verdict",
]

__getattr__ = lazy_names(__name__, _HOMES)


def __dir__() -> list[str]:
    return list(__all__)
