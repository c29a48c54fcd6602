"""Verdicts on identifiers at the end of a run, from the signals that were recorded of it.

The same for every method: output error is fitted to what the observer took in as y and u, and what
the identifier says is held against it. Where the identifier takes samples of y at times of their
own, it is fitted to these; where it has a moving window, to the last one. They are results, not
signals: they rest on linear algebra whose last bits depend on the processor.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Block
from cosim.core.graph import Graph
from cosim.core.signals import Channel
from cosim.errors import AssumptionError, RunError
from cosim.scenario.identification.feedback import inputs_in_feedback
from cosim.scenario.identification.model import IdentifiedPlant, SampleRows
from cosim.scenario.record import IdentifierVerdicts, IrregularPart
from cosim.theory.assessment.advice import advised
from cosim.theory.assessment.amplitude_verdicts import amplitude_verdicts
from cosim.theory.assessment.assessing import assess
from cosim.theory.assessment.undetected import undetected_errors
from cosim.theory.assessment.verdicts import Assessment, judge
from cosim.theory.disturbed_plant import DataSet

OUTPUT_ERROR: Final = "output-error"
IDENTIFY_WITH_OFFSET: Final = "`cosim identify --offset`"


class Assessor:
    """Keeps what verdicts need of the rows of a run.

    Parameters
    ----------
    graph : Graph
    identified : mapping of identifier to IdentifiedPlant
    """

    def __init__(self, graph: Graph, identified: Mapping[str, IdentifiedPlant]) -> None:
        self._identifiers = []
        for name, plant in identified.items():
            sources = (name, plant.observer, plant.regressor)
            channels = tuple(graph.layout[source] for source in sources)
            held = graph.held[plant.observer]
            in_feedback = inputs_in_feedback(graph, plant.observer)
            self._identifiers.append(_IdentifierData(name, plant, channels, held, in_feedback))

    def take(self, block: Block, signals: Matrix) -> None:
        """Keep the rows of a block."""
        for identifier in self._identifiers:
            identifier.take(block, signals)

    def results(self) -> dict[str, Any]:
        """Return the verdicts by identifier, as plain values."""
        return {own.name: own.result().to_dict() for own in self._identifiers}


class _IdentifierData:
    """The data of one identifier: y and u of its observer, the alphas, its last estimate."""

    def __init__(
        self,
        name: str,
        identified: IdentifiedPlant,
        channels: tuple[Channel, ...],
        held: Mask,
        in_feedback: Mask,
    ) -> None:
        own, observer, regressor = channels
        self.name = name
        self._identified = identified
        outputs = own.interface.output_columns()
        of_theta = outputs.get("theta", slice(0, 0))  # there is none without parameters
        self._theta = _shifted(of_theta, own.outputs.start)
        self._error: slice | None = None
        if "standard_error" in outputs:
            self._error = _shifted(outputs["standard_error"], own.outputs.start)
        inputs = observer.interface.input_columns()
        self._y = _shifted(inputs["y"], observer.inputs.start)
        u = inputs.get("u", slice(0, 0))
        self._u = _shifted(u, observer.inputs.start)
        known = regressor.interface.input_columns().get("alpha", slice(0, 0))
        self._alpha = _shifted(known, regressor.inputs.start)
        self._held = held[u]
        self._in_feedback = in_feedback
        self._sample_columns: tuple[slice, slice] | None = None
        taken = own.interface.input_columns()
        if "samples" in taken:
            times = _shifted(taken["sample_times"], own.inputs.start)
            self._sample_columns = times, _shifted(taken["samples"], own.inputs.start)
        self._sample_times: list[Matrix] = []
        self._samples: list[Matrix] = []
        self._times: list[Vector] = []
        self._outputs: list[Matrix] = []
        self._inputs: list[Matrix] = []
        self._alphas: list[Matrix] = []
        self._last = np.zeros(0)

    def take(self, block: Block, signals: Matrix) -> None:
        """Keep the rows of a block."""
        first = 1 if self._times else 0
        self._times.append(block.time[first:].copy())
        self._outputs.append(signals[first:, self._y].copy())
        self._inputs.append(signals[first:, self._u].copy())
        self._alphas.append(signals[first:, self._alpha].copy())
        if self._sample_columns is not None:
            times, samples = self._sample_columns
            self._sample_times.append(signals[first:, times].copy())
            self._samples.append(signals[first:, samples].copy())
        self._last = signals[-1].copy()

    def result(self) -> IdentifierVerdicts:
        """Return the verdict on the last estimate."""
        if not self._times:
            return IdentifierVerdicts(problem="the run ended before there were data")
        if self._identified.problem:
            return IdentifierVerdicts(problem=self._identified.problem)
        theta = self._last[self._theta]
        try:
            return self._assessed(theta)
        except (AssumptionError, np.linalg.LinAlgError) as error:
            return IdentifierVerdicts(problem=str(error))

    def _assessed(self, theta: Vector) -> IdentifierVerdicts:
        identified = self._identified
        problem = identified.problem_of([self._data()])
        assessment = advised(assess(problem, theta), [identified.alpha])
        error = None if self._error is None else self._last[self._error]
        amplitudes = amplitude_verdicts(assessment)
        with_offset = "`offset = true`" if identified.has_offset_key else IDENTIFY_WITH_OFFSET
        irregular = None
        if identified.irregular is not None:
            irregular = _irregular(assessment, identified.irregular)
        return replace(
            verdicts_of(assessment),
            extent=identified.extent,
            amplitudes=amplitudes,
            undetected=undetected_errors(assessment, amplitudes, with_offset=with_offset),
            estimate=judge(assessment, theta, error),
            irregular=irregular,
        )

    def _data(self) -> DataSet:
        t = np.concatenate(self._times)
        y = np.concatenate(self._outputs)
        u = np.concatenate(self._inputs)
        samples = None
        if self._sample_columns is not None:
            samples = SampleRows(t, *map(np.concatenate, (self._sample_times, self._samples)))
        alphas = np.concatenate(self._alphas)
        whole = self._identified.data_set(t, y, u, self._held, self._in_feedback, alphas, samples)
        return whole.last(self._identified.window)


def verdicts_of(assessment: Assessment) -> IdentifierVerdicts:
    """Return what a fit by output error says of theta, and of the noise."""
    return IdentifierVerdicts(**assessment.to_dict() | {"parameters": assessment.parameters})


def _irregular(assessment: Assessment, bound: float) -> IrregularPart:
    """Return what an irregular part within its bound leaves open, or why that is not known."""
    # rarely needed
    from cosim.scenario.identification.irregular import interval_of, irregular_part
    from cosim.theory.bounded.irregular_part import Programs

    try:
        interval = interval_of(assessment, bound, Programs.BEYOND_FIRST_ORDER)
    except (AssumptionError, RunError) as error:
        return IrregularPart(bound, problem=str(error))
    return irregular_part(bound, interval)


def _shifted(columns: slice, offset: int) -> slice:
    return slice(columns.start + offset, columns.stop + offset)
