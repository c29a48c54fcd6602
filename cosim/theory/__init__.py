"""The method as pure functions on frozen data.

Reduction, observer, disturbance class, regression, estimators, verdicts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from cosim.lazy import lazy_names

if TYPE_CHECKING:
    from cosim.theory.assessment.assessing import assess
    from cosim.theory.assessment.fitted_model import FittedModel
    from cosim.theory.assessment.smoothing import smoothed_signals
    from cosim.theory.assessment.validation import validate
    from cosim.theory.assessment.verdicts import Assessment
    from cosim.theory.bounded.irregular_part import guaranteed_interval
    from cosim.theory.disturbances.excitation import describe_excitation, information
    from cosim.theory.disturbances.families import (
        AlphaGroup,
        Exponential,
        Family,
        Sine,
        coefficients,
        group_by_alpha,
    )
    from cosim.theory.disturbances.regression import Term, chi, eta, expand, mu
    from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
    from cosim.theory.documents import Verdict
    from cosim.theory.estimators.least_squares import (
        Recovery,
        least_squares,
        plan,
        recover,
        trapezoid_weights,
    )
    from cosim.theory.estimators.output_error import (
        OutputErrorFit,
        OutputErrorProblem,
        fit_output_error,
    )
    from cosim.theory.observers.observer import (
        IdentificationStartTime,
        ObserverDesign,
        StateSpace,
        design,
        identification_start_time,
        realize,
    )
    from cosim.theory.plants.descriptor import (
        DescriptorSystem,
        ReducedSystem,
        disturbance_transfer,
        invariant_zeros,
        pencil_index,
        reduce,
    )
    from cosim.theory.plants.foreign_model import descriptor_system

_HOMES = {
    "AlphaGroup": "cosim.theory.disturbances.families",
    "assess": "cosim.theory.assessment.assessing",
    "Assessment": "cosim.theory.assessment.verdicts",
    "chi": "cosim.theory.disturbances.regression",
    "coefficients": "cosim.theory.disturbances.families",
    "DataSet": "cosim.theory.disturbed_plant",
    "describe_excitation": "cosim.theory.disturbances.excitation",
    "descriptor_system": "cosim.theory.plants.foreign_model",
    "DescriptorSystem": "cosim.theory.plants.descriptor",
    "design": "cosim.theory.observers.observer",
    "disturbance_transfer": "cosim.theory.plants.descriptor",
    "DisturbedPlant": "cosim.theory.disturbed_plant",
    "eta": "cosim.theory.disturbances.regression",
    "expand": "cosim.theory.disturbances.regression",
    "Exponential": "cosim.theory.disturbances.families",
    "Family": "cosim.theory.disturbances.families",
    "fit_output_error": "cosim.theory.estimators.output_error",
    "FittedModel": "cosim.theory.assessment.fitted_model",
    "group_by_alpha": "cosim.theory.disturbances.families",
    "guaranteed_interval": "cosim.theory.bounded.irregular_part",
    "identification_start_time": "cosim.theory.observers.observer",
    "IdentificationStartTime": "cosim.theory.observers.observer",
    "information": "cosim.theory.disturbances.excitation",
    "invariant_zeros": "cosim.theory.plants.descriptor",
    "least_squares": "cosim.theory.estimators.least_squares",
    "mu": "cosim.theory.disturbances.regression",
    "ObserverDesign": "cosim.theory.observers.observer",
    "OutputErrorFit": "cosim.theory.estimators.output_error",
    "OutputErrorProblem": "cosim.theory.estimators.output_error",
    "pencil_index": "cosim.theory.plants.descriptor",
    "plan": "cosim.theory.estimators.least_squares",
    "realize": "cosim.theory.observers.observer",
    "recover": "cosim.theory.estimators.least_squares",
    "Recovery": "cosim.theory.estimators.least_squares",
    "reduce": "cosim.theory.plants.descriptor",
    "ReducedSystem": "cosim.theory.plants.descriptor",
    "Sine": "cosim.theory.disturbances.families",
    "smoothed_signals": "cosim.theory.assessment.smoothing",
    "StateSpace": "cosim.theory.observers.observer",
    "Term": "cosim.theory.disturbances.regression",
    "trapezoid_weights": "cosim.theory.estimators.least_squares",
    "validate": "cosim.theory.assessment.validation",
    "Verdict": "cosim.theory.documents",
}

__all__ = [
    "AlphaGroup",
    "Assessment",
    "DataSet",
    "DescriptorSystem",
    "DisturbedPlant",
    "Exponential",
    "Family",
    "FittedModel",
    "IdentificationStartTime",
    "ObserverDesign",
    "OutputErrorFit",
    "OutputErrorProblem",
    "Recovery",
    "ReducedSystem",
    "Sine",
    "StateSpace",
    "Term",
    "Verdict",
    "assess",
    "chi",
    "coefficients",
    "describe_excitation",
    "descriptor_system",
    "design",
    "disturbance_transfer",
    "eta",
    "expand",
    "fit_output_error",
    "group_by_alpha",
    "guaranteed_interval",
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
    "smoothed_signals",
    "trapezoid_weights",
    "validate",
]

__getattr__ = lazy_names(__name__, _HOMES)


def __dir__() -> list[str]:
    return list(__all__)
