"""The method as pure functions on frozen data.

Reduction, observer, disturbance class, regression, estimators, verdicts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from cosim.lazy import lazy_names

if TYPE_CHECKING:
    from cosim.theory.assessment.assessing import assess
    from cosim.theory.assessment.fitted_model import FittedModel
    from cosim.theory.assessment.problem import OutputErrorProblem
    from cosim.theory.assessment.smoothing import smoothed_signals
    from cosim.theory.assessment.validation import validate
    from cosim.theory.assessment.verdicts import Assessment, Verdict
    from cosim.theory.bounded.irregular_part import guaranteed_interval
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
    from cosim.theory.disturbed_plant import DataSet, DisturbedPlant
    from cosim.theory.estimators.least_squares import (
        Recovery,
        least_squares,
        plan,
        recover,
        trapezoid_weights,
    )
    from cosim.theory.estimators.output_error import OutputErrorFit, fit_output_error
    from cosim.theory.excitation import describe_excitation, information
    from cosim.theory.foreign_model import descriptor_system
    from cosim.theory.observer import (
        IdentificationStartTime,
        ObserverDesign,
        StateSpace,
        design,
        identification_start_time,
        realize,
    )
    from cosim.theory.regression import Term, chi, eta, expand, mu

_HOMES = {
    "AlphaGroup": "cosim.theory.disturbance",
    "assess": "cosim.theory.assessment.assessing",
    "Assessment": "cosim.theory.assessment.verdicts",
    "chi": "cosim.theory.regression",
    "coefficients": "cosim.theory.disturbance",
    "DataSet": "cosim.theory.disturbed_plant",
    "describe_excitation": "cosim.theory.excitation",
    "descriptor_system": "cosim.theory.foreign_model",
    "DescriptorSystem": "cosim.theory.descriptor",
    "design": "cosim.theory.observer",
    "disturbance_transfer": "cosim.theory.descriptor",
    "DisturbedPlant": "cosim.theory.disturbed_plant",
    "eta": "cosim.theory.regression",
    "expand": "cosim.theory.regression",
    "Exponential": "cosim.theory.disturbance",
    "Family": "cosim.theory.disturbance",
    "fit_output_error": "cosim.theory.estimators.output_error",
    "FittedModel": "cosim.theory.assessment.fitted_model",
    "group_by_alpha": "cosim.theory.disturbance",
    "guaranteed_interval": "cosim.theory.bounded.irregular_part",
    "identification_start_time": "cosim.theory.observer",
    "IdentificationStartTime": "cosim.theory.observer",
    "information": "cosim.theory.excitation",
    "invariant_zeros": "cosim.theory.descriptor",
    "least_squares": "cosim.theory.estimators.least_squares",
    "mu": "cosim.theory.regression",
    "ObserverDesign": "cosim.theory.observer",
    "OutputErrorFit": "cosim.theory.estimators.output_error",
    "OutputErrorProblem": "cosim.theory.assessment.problem",
    "pencil_index": "cosim.theory.descriptor",
    "plan": "cosim.theory.estimators.least_squares",
    "realize": "cosim.theory.observer",
    "recover": "cosim.theory.estimators.least_squares",
    "Recovery": "cosim.theory.estimators.least_squares",
    "reduce": "cosim.theory.descriptor",
    "ReducedSystem": "cosim.theory.descriptor",
    "Sine": "cosim.theory.disturbance",
    "smoothed_signals": "cosim.theory.assessment.smoothing",
    "StateSpace": "cosim.theory.observer",
    "Term": "cosim.theory.regression",
    "trapezoid_weights": "cosim.theory.estimators.least_squares",
    "validate": "cosim.theory.assessment.validation",
    "Verdict": "cosim.theory.assessment.verdicts",
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
