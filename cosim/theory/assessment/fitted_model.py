"""A fit by output error, and what its tests and bands compute from it, each once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from cosim.theory.assessment.accuracy import Accuracy, accuracy_of
from cosim.theory.assessment.linearized_fit import LinearizedFit, linearize_fit
from cosim.theory.disturbed_plant import NoiseModel
from cosim.theory.estimators.output_error import OutputErrorFit, OutputErrorProblem
from cosim.theory.fitted_response import FittedResponse, fitted_response
from cosim.theory.quantiles import CONFIDENCE, student_two_sided


@dataclass(frozen=True, eq=False)
class FittedModel:
    """A fit, the problem that it solves, and the noise that weighed it.

    Parameters
    ----------
    problem : OutputErrorProblem
    fit : OutputErrorFit
    noise : NoiseModel
        In units of ``fit.deviation``: stated, or that of the residual; ``a`` is not empty where the
        noise was found to be colored.
    """

    problem: OutputErrorProblem
    fit: OutputErrorFit
    noise: NoiseModel

    @cached_property
    def responses(self) -> tuple[FittedResponse, ...]:
        """The response of the model to each data set."""
        problem = self.problem
        return tuple(
            fitted_response(self.fit, index, data, problem.plant, problem.generators)
            for index, data in enumerate(problem.data)
        )

    @cached_property
    def accuracies(self) -> tuple[Accuracy, ...]:
        """The errors of each data set that are no noise."""
        pairs = zip(self.problem.data, self.responses, strict=True)
        return tuple(
            accuracy_of(self.problem.plant, data, response.disturbance) for data, response in pairs
        )

    @cached_property
    def linearized(self) -> tuple[LinearizedFit, ...]:
        """The regression of each data set near the minimum."""
        parts = zip(self.problem.data, self.responses, self.accuracies, strict=True)
        return tuple(linearize_fit(*part, self.noise) for part in parts)

    @property
    def quantile(self) -> float:
        """Half a 95 % interval over the standard error, as far as the noise is known."""
        freedom = 1.0 / (1.0 / max(self.fit.freedom, 1.0) + 1.0 / self.noise.freedom)
        return student_two_sided(CONFIDENCE, freedom)
