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

from cosim.arrays import Matrix, Vector
from cosim.core.contracts import Block
from cosim.core.graph import Graph
from cosim.errors import AssumptionError, RunError
from cosim.scenario.kinds.feedback import inputs_in_feedback
from cosim.scenario.kinds.identified_plant import IdentifiedPlant, SampleRows
from cosim.scenario.record import IdentifierVerdicts, IrregularPart
from cosim.theory.assessment.advice import advised
from cosim.theory.assessment.amplitude_verdicts import amplitude_verdicts
from cosim.theory.assessment.assessing import assess
from cosim.theory.assessment.undetected import undetected_errors
from cosim.theory.assessment.verdicts import Assessment, judge

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
        self._identifiers = {
            name: _IdentifierData(graph, name, one) for name, one in identified.items()
        }

    def take(self, block: Block, signals: Matrix) -> None:
        """Keep the rows of a block."""
        for data in self._identifiers.values():
            data.take(block, signals)

    def results(self) -> dict[str, Any]:
        """Return the verdicts by identifier, as plain values."""
        return {name: data.verdicts().to_dict() for name, data in self._identifiers.items()}


class _IdentifierData:
    """The data of one identifier: y and u of its observer, the alphas, its last estimate."""

    def __init__(self, graph: Graph, name: str, identified: IdentifiedPlant) -> None:
        own = graph.layout[name].signal_columns
        observer = graph.layout[identified.observer]
        of_observer = observer.signal_columns
        none = slice(0, 0)
        self._identified = identified
        self._theta = own.get("theta", none)  # there is none without parameters
        self._error = own.get("standard_error")
        self._kept = {
            "y": of_observer["y"],
            "u": of_observer.get("u", none),
            "alpha": graph.layout[identified.regressor].signal_columns.get("alpha", none),
        }
        if "samples" in own:
            self._kept |= {key: own[key] for key in ("sample_times", "samples")}
        u = observer.interface.input_columns().get("u", none)
        self._held = graph.held[identified.observer][u]
        self._in_feedback = inputs_in_feedback(graph, identified.observer)
        self._times: list[Vector] = []
        self._rows: dict[str, list[Matrix]] = {key: [] for key in self._kept}
        self._last = np.zeros(0)

    def take(self, block: Block, signals: Matrix) -> None:
        """Keep the rows of a block."""
        first = 1 if self._times else 0
        self._times.append(block.time[first:].copy())
        for key, columns in self._kept.items():
            self._rows[key].append(signals[first:, columns].copy())
        self._last = signals[-1].copy()

    def verdicts(self) -> IdentifierVerdicts:
        """Return the verdicts on the last estimate, or why there are none."""
        if not self._times:
            return IdentifierVerdicts(problem="the run ended before there were data")
        if self._identified.problem:
            return IdentifierVerdicts(problem=self._identified.problem)
        try:
            return self._assessed()
        except (AssumptionError, np.linalg.LinAlgError) as error:
            return IdentifierVerdicts(problem=str(error))

    def _assessed(self) -> IdentifierVerdicts:
        identified = self._identified
        t = np.concatenate(self._times)
        rows = {key: np.concatenate(parts) for key, parts in self._rows.items()}
        samples = None
        if "samples" in rows:
            samples = SampleRows(t, rows["sample_times"], rows["samples"])
        data = identified.data_set(
            t, rows["y"], rows["u"], self._held, self._in_feedback, rows["alpha"], samples
        )
        theta = self._last[self._theta]
        fitted = assess(identified.problem_of([data.last(identified.window)]), theta)
        assessment = advised(fitted, [identified.alpha])
        amplitudes = amplitude_verdicts(assessment)
        with_offset = "`offset = true`" if identified.has_offset_key else IDENTIFY_WITH_OFFSET
        error = None if self._error is None else self._last[self._error]
        bound = identified.irregular
        return replace(
            verdicts_of(assessment),
            extent=identified.extent,
            amplitudes=amplitudes,
            undetected=undetected_errors(assessment, amplitudes, with_offset=with_offset),
            estimate=judge(assessment, theta, error),
            irregular=None if bound is None else _irregular(assessment, bound),
        )


def verdicts_of(assessment: Assessment) -> IdentifierVerdicts:
    """Return what a fit by output error says of theta, and of the noise."""
    return IdentifierVerdicts(**assessment.to_dict() | {"parameters": assessment.parameters})


def _irregular(assessment: Assessment, bound: float) -> IrregularPart:
    """Return what an irregular part within its bound leaves open, or why that is not known."""
    # rarely needed
    from cosim.scenario.kinds.irregular import interval_of, irregular_part
    from cosim.theory.bounded.irregular_part import Programs

    try:
        interval = interval_of(assessment, bound, Programs.BEYOND_FIRST_ORDER)
    except (AssumptionError, RunError) as error:
        return IrregularPart(bound, problem=str(error))
    return irregular_part(bound, interval)
