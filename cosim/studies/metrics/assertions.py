"""What runs must fulfil: comparisons of metrics, such as ``rms(plant.y) < 0.1``.

Several are joined by ``and``. A metric without a value fulfils nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Final, final

from cosim.core.passing_recorders import TwoRecorders
from cosim.core.recording import Recorder
from cosim.errors import UsageError, option
from cosim.scenario.recordings.recording import LiveView
from cosim.studies.metrics.language import parse_comparisons
from cosim.studies.metrics.metrics import parse_metrics
from cosim.studies.metrics.recorder import MetricRecorder

NO_METRICS: Final[Mapping[str, str]] = MappingProxyType({})


@final
class Assertions:
    """Assertions about a run, such as ``rms(plant.y) < 0.1 and last(plant.y) > 0``.

    Parameters
    ----------
    texts : iterable of str
    known : mapping of str to str, optional
        Metrics of a study by name, which may stand for their texts.

    Attributes
    ----------
    metrics : dict of str to str
        All metrics in them by name; of those that have none their texts are the names.

    Raises
    ------
    UsageError
        If a text is none; whether there are its signals is not known here.
    """

    def __init__(self, texts: Iterable[str], known: Mapping[str, str] = NO_METRICS) -> None:
        self._comparisons = {}
        self.metrics: dict[str, str] = {}
        for text in texts:
            try:
                self._comparisons[text] = parse_comparisons(text, known)
            except UsageError as error:
                raise UsageError(f"{option('assert')}: {error}") from error
            for one in self._comparisons[text]:
                for name in (one.left, one.right):
                    if isinstance(name, str):
                        self.metrics[name] = known.get(name, name)

    def view(self, other: LiveView | None = None) -> AssertedView:
        """Return what computes them of a run, beside what shows it."""
        return AssertedView(self, other)

    def problems(self, values: Mapping[str, float | None]) -> dict[str, str]:
        """Return why assertions are not fulfilled, by their texts; those that are are left out.

        Parameters
        ----------
        values : mapping of str to float or None
            Of all metrics.
        """
        problems = {}
        for text, comparisons in self._comparisons.items():
            found = []
            for one in comparisons:
                names = [name for name in (one.left, one.right) if isinstance(name, str)]
                left = values[one.left] if isinstance(one.left, str) else one.left
                right = values[one.right] if isinstance(one.right, str) else one.right
                if left is None or right is None or not one.holds(left, right):
                    for name in names:
                        value = values[name]
                        found.append(f"{name} = {'no value' if value is None else repr(value)}")
            if found:
                problems[text] = ", ".join(dict.fromkeys(found))
        return problems


@final
class AssertedView:
    """Computes what assertions need of a run while it goes on; a :class:`LiveView`.

    Parameters
    ----------
    assertions : Assertions
    other : LiveView or None
        What shows the run.
    """

    def __init__(self, assertions: Assertions, other: LiveView | None = None) -> None:
        self._assertions = assertions
        self._other = other
        self._recorder = MetricRecorder(parse_metrics(assertions.metrics, f"{option('assert')} "))

    def beside(self, recorder: Recorder, kinds: Mapping[str, str]) -> Recorder:
        """Return what takes the run, too; it refuses one that lacks a signal before it begins."""
        shown = recorder if self._other is None else self._other.beside(recorder, kinds)
        return TwoRecorders(self._recorder, shown)

    @property
    def problems(self) -> dict[str, str]:
        """Why assertions are not fulfilled, by their texts."""
        return self._assertions.problems(self._recorder.values())
