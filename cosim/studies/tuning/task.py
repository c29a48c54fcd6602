"""What is to be tuned, and the study of which every trial is a member."""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from cosim.scenario.document.document import find
from cosim.studies.study_file import STUDY, StudyFile, is_log, read_study, study_of
from cosim.studies.tuning.searching import TuningSearch
from cosim.studies.tuning.trials import SAMPLES

OBJECTIVE: Final = "objective"  # the name of its column
_NAME: Final = "tuning"


@dataclass(frozen=True, slots=True)
class TuningTask:
    """What is to be tuned.

    Parameters
    ----------
    scenario : str
        Path, or name of a shipped scenario; or path of a log, which every trial replays.
    expression : str
        The metric.
    search : TuningSearch
        Its objective, first values and whether it is an rms are found later.
    set, swap, map
        The edits that all members have, as of :func:`cosim.run`.
    replay : str or sequence of str, optional
        The log that every trial replays.
    allow_code : bool
        As of :func:`cosim.replay`.
    timeout : float, optional
        Wall time that a member may take [s], as of :class:`WorkerPool`.
    """

    scenario: str
    expression: str
    search: TuningSearch
    set: Mapping[str, Any] = field(default_factory=dict)
    swap: Mapping[str, str | Path] = field(default_factory=dict)
    map: Mapping[str, Any] = field(default_factory=dict)
    replay: str | Sequence[str] | None = None
    allow_code: bool = False
    timeout: float | None = None

    @property
    def metrics(self) -> dict[str, str]:
        """The metrics of a member: the objective; of an rms the number of samples, too."""
        if not is_rms(self.expression):
            return {OBJECTIVE: self.expression}
        counted = self.expression.strip().removeprefix("rms")
        return {OBJECTIVE: self.expression, SAMPLES: f"count{counted}"}

    def study(self) -> StudyFile:
        """Return the study: that of the scenario, without what its table [study] says.

        Raises
        ------
        UsageError
            If there is no such scenario, or an option is wrong.
        """
        return _base(self.scenario).with_options(
            metrics=self.metrics,
            set=self.set,
            swap=self.swap,
            map=self.map,
            replay=self.replay,
            allow_code=self.allow_code or None,
            timeout=self.timeout,
        )


def is_rms(expression: object) -> bool:
    """Return whether a metric is the rms of one expression, with nothing around it."""
    if not isinstance(expression, str):
        return False
    try:
        node = ast.parse(expression.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return False
    is_call = isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    return is_call and node.func.id == "rms"  # type: ignore[attr-defined]


def _base(scenario: str) -> StudyFile:
    if is_log(scenario):
        return read_study(scenario)
    source = find(scenario).source
    path = str(Path(source).absolute()) if Path(source).is_file() else source
    study, problems = study_of({STUDY: {"scenario": path}}, source, _NAME)
    assert study is not None, problems
    return study
