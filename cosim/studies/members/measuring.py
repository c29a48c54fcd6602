"""What is kept of the run of a member: its metrics, how far it came and how it ended."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from types import TracebackType
from typing import Protocol, final

from cosim.arrays import Matrix
from cosim.core.contracts import Block, Design
from cosim.core.passing_recorders import PassingRecorder
from cosim.core.recorded.signals import DistinctWarnings, RunMessage, warning_texts
from cosim.core.recorders import EndOfRun, end_of_run, error_text
from cosim.core.recording import MessageLevel, Plan, Recorder
from cosim.studies.contracts import MetricValue
from cosim.temporary import without_folders


class MetricSink(Recorder, Protocol):
    """A recorder that keeps of a run what metrics say of it."""

    def values(self) -> Mapping[str, MetricValue]:
        """Return the metrics by name, when the run is over."""
        ...


@final
class MemberRecorder(PassingRecorder):
    """Passes a run on to what keeps its metrics, and knows how far it came and how it ended.

    Attributes
    ----------
    sink : MetricSink
    steps : int
        Communication steps that were completed.
    end : EndOfRun
    plan : Plan or None
        None: it did not begin.
    setting_designs : mapping of str to Design
        Of what actions set in it, by time and component.
    recorded : collection of str
        Of a replay: the components whose designs are from its log.
    """

    def __init__(self, sink: MetricSink) -> None:
        super().__init__(sink)
        self.sink = sink
        self.steps = 0
        self.end = EndOfRun()
        self.plan: Plan | None = None
        self.setting_designs: Mapping[str, Design] = {}
        self.recorded: Collection[str] = ()
        self._warnings = DistinctWarnings()

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.end = end_of_run(error)
        super().__exit__(error_type, error, trace)

    @property
    def warnings(self) -> list[str]:
        """What the run warned of, as lines in alphabetical order."""
        return sorted(without_folders(text, "fmu") for text in warning_texts(self._warnings))

    def message(self, time_ns: int, level: MessageLevel, source: str, text: str) -> None:
        """Keep a warning, and pass on."""
        self._warnings.add(RunMessage(time_ns, level, source, text))
        self._recorder.message(time_ns, level, source, text)

    def begin(self, plan: Plan) -> None:
        """Pass on."""
        self.plan = plan
        self._recorder.begin(plan)

    def write(self, block: Block, signals: Matrix) -> None:
        """Pass on."""
        self.steps = block.index + block.steps
        self._recorder.write(block, signals)


def reason_of(error: BaseException) -> str:
    """Return why a member failed, with the same text wherever its FMUs were unpacked."""
    return without_folders(error_text(error), "fmu")
