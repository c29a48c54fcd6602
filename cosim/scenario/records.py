"""What a log keeps of an experiment beside its signals, and what the run and its FMUs have to say while it is written."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from types import TracebackType
from typing import Any, Self

from cosim.arrays import Matrix, Vector
from cosim.core.contracts import Block, MessageLevel, Plan, Stopped
from cosim.core.port import Port
from cosim.errors import Interrupted
from cosim.log import Attachment, McapRecorder
from cosim.log.interrupts import uninterrupted
from cosim.scenario.build import Experiment, fingerprint
from cosim.units import Conversion

SCENARIO_FILE = "scenario.toml"


class MessageRecorder:
    """Hands everything on to the recorder of a log, and puts the messages of the run and of its FMUs on ``/cosim/log``."""

    def __init__(self, recorder: McapRecorder, experiment: Experiment) -> None:
        self._recorder, self._experiment, self._reached = recorder, experiment, 0
        self._last: Vector | None = None

    def __enter__(self) -> Self:
        self._recorder.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            with uninterrupted():
                self._conclude(error)
        finally:
            self._recorder.__exit__(kind, error, trace)

    def _conclude(self, error: BaseException | None) -> None:
        self._tell()
        if error is not None:
            self._recorder.message(
                self._reached, _level(error), "run", str(error) or type(error).__name__
            )
        if self._last is not None:
            values = zip(self._experiment.graph.labels(), self._last.tolist(), strict=True)
            last = {label: value if math.isfinite(value) else None for label, value in values}
            self._recorder.result({"last": last})

    def begin(self, plan: Plan) -> None:
        """Hand on, then tell what is to be known before the first step."""
        self._recorder.begin(plan)
        for name, text in self._experiment.warnings:
            self._recorder.message(0, "warning", name, text)

    def message(self, time_ns: int, level: MessageLevel, source: str, text: str) -> None:
        """Pass on."""
        self._recorder.message(time_ns, level, source, text)

    def result(self, values: Mapping[str, Any]) -> None:
        """Pass on."""
        self._recorder.result(values)

    def write(self, block: Block, signals: Matrix) -> None:
        """Tell what was said in this block, and hand on."""
        self._tell()
        self._reached = int(block.time_ns[-1])
        self._recorder.write(block, signals)
        self._last = signals[-1].copy()

    def _tell(self) -> None:
        """Put what FMUs said at the time they said it; where that is not known, at the time reached before."""
        for name, fmu in self._experiment.fmus.items():
            for time, level, category, text in fmu.drain():
                time_ns = self._reached if time is None else round(time * 1e9)
                self._recorder.message(
                    time_ns, level, name, f"{category}: {text}" if category else text
                )


def _level(error: BaseException) -> MessageLevel:
    match error:
        case Stopped(failed=False):
            return "info"
        case Interrupted() | KeyboardInterrupt():
            return "warning"
        case _:
            return "error"


def metadata_of(experiment: Experiment) -> dict[str, dict[str, str]]:
    """Give the metadata records of a run: scenario, edits, connections, and each component's table, metadata and fingerprint."""
    scenario = experiment.scenario
    settings = scenario.file.scenario
    records = {
        "cosim.run": {
            "scenario": scenario.name,
            "edits": scenario.document.edits(),
            "stop": repr(settings.stop),
            "step": repr(settings.step),
            "truth": json.dumps(dict(experiment.truth)),
            "schedule": json.dumps([stage.description for stage in experiment.graph.stages]),
            "warnings": json.dumps(experiment.warnings),
        },
        "cosim.connections": {
            to: json.dumps(_plain(wire, experiment.graph.conversions.get(Port.parse(to), ())))
            for to, wire in scenario.connections.items()
        },
    }
    for name in scenario.specs:
        records[f"cosim.component.{name}"] = {
            "table": json.dumps(scenario.tree["components"][name]),
            "metadata": json.dumps(experiment.metadata.get(name, {})),
            "fingerprint": fingerprint(scenario, name, experiment.reads[name]),
        }
    return records


def _plain(wire: Any, conversions: tuple[Conversion, ...]) -> dict[str, Any]:
    """Give a connection in plain values; its conversion only where units are converted."""
    plain = {
        "from": wire.label,
        "gain": wire.gain.tolist(),
        "offset": wire.offset,
        "unit": wire.unit,
    }
    if not conversions:
        return plain
    return {**plain, "conversions": [asdict(conversion) for conversion in conversions]}


def attachments_of(experiment: Experiment) -> list[Attachment]:
    """Give the files that go into the log: the scenario's text, and each FMU's modelDescription.xml."""
    text = experiment.scenario.document.text
    files = {SCENARIO_FILE: ("application/toml", text)}
    files |= {name: ("application/xml", xml) for name, xml in experiment.attachments.items()}
    return [Attachment(name, media, data.encode()) for name, (media, data) in files.items()]
