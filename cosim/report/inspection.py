"""What a log, a recording of another tool, a table of samples or a scenario contains."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from decimal import Decimal
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

import numpy as np

from cosim.core.connections import AS_IS, element_units
from cosim.core.graph import Graph
from cosim.core.recorded.partial import declared_channels
from cosim.core.recorded.signals import RunMessage
from cosim.core.recording import SignalEvent
from cosim.core.signals import Interface
from cosim.errors import LogError
from cosim.instants import NANOSECONDS, step_value
from cosim.log.metadata import WRITTEN
from cosim.report.certificate import certificate_of
from cosim.report.summary import summarize
from cosim.report.tables.console import Section
from cosim.scenario import record
from cosim.scenario.building.build import Builder, describe
from cosim.scenario.building.coupling import described_gains, gain_values
from cosim.scenario.data_files.field_file import field_data
from cosim.scenario.document.document import find
from cosim.scenario.document.schema import ActionTable
from cosim.units import units_text

if TYPE_CHECKING:
    from cosim.core.stages.substep_control import SubstepCounts
    from cosim.log import Log
    from cosim.log.foreign.samples import TopicSurvey

_Found = TypeVar("_Found")

VERSIONS: Final = ("cosim", "python", "numpy", "scipy", "mcap")
MOST_MESSAGES = 10_000  # that are shown of a log
MOST_TEXT = 2**22  # characters of them
MOST_OVERRIDES = 10  # and releases
MOST_FIELDS = 1000  # of a recording of another tool


def _limited(title: str, rows: Sequence[Section], most: int, more: int = 0) -> Section:
    """Return the first rows as a section, and how many more there are, where there are any."""
    more += max(len(rows) - most, 0)
    content: Section = {title: rows[:most]} if rows else {}
    return {**content, f"more {title}": {"not shown": more}} if more else content


# --- logs ---


def describe_log(path: str) -> Section:
    """Describe a log: the run, its components and their signals, metadata and messages."""
    from cosim.log import open_log

    log = open_log(path)
    events = log.events()
    problems: dict[str, None] = {}

    def read(reader: Callable[[Log], _Found]) -> _Found | None:
        """Note what cannot be understood; the rest of the log is described all the same."""
        try:
            return reader(log)
        except LogError as error:
            problems[str(error)] = None
            return None

    window = read(record.recorded_window)
    start = window[0] if window else read(record.recorded_start) or 0.0
    about = _about_run(log, events, start)
    if "replay" in record.run_metadata(log):
        origin = read(record.replay_origin)
        about |= {} if origin is None else {"replay of": asdict(origin)}
    content: Section = {"run": about}
    if log.partial is not None:
        missing = log.partial.missing(log.channels)
        content["partial"] = {**log.partial.overview(log.channels), "not recorded": missing}
    content["loops"] = [gain_values(gain) for gain in read(record.recorded_loop_gains) or ()]
    counts = read(record.recorded_substep_counts)
    content |= {"substeps": list(map(_substep_row, counts))} if counts else {}
    signals = [
        row
        for name, channel in log.channels.items()
        for row in _signal_rows(name, log.kinds.get(name, ""), channel.interface)
    ]
    metadata = {}
    differences = {}
    for name in declared_channels(log.channels):
        entry = read(partial(record.component_table, component=name)) or {}
        report = entry.pop("swap_report", {})
        if report:
            rows = report.get("ports", [])
            differences[name] = [row for row in rows if row["verdict"] not in ("ok", "unknown")]
        if entry:
            metadata[name] = entry
    content |= {"signals": signals, "metadata": metadata, "differences": differences}
    overrides = [event for event in events if event.cause not in ("follow", "jump")]
    content |= _limited("overrides", list(map(_event_row, overrides)), MOST_OVERRIDES)
    content |= read(_certificate) or {}
    content |= _messages(log)
    return {**content, "problems": list(problems)} if problems else content


def _about_run(log: Log, events: Sequence[SignalEvent], start: float) -> Section:
    """Return how a run went, and by what and on which machine it was recorded."""
    run = record.run_metadata(log)
    recorded = log.metadata.get("cosim.env", {})
    versions = [f"{name} {recorded[name]}" for name in VERSIONS if name in recorded]
    machine = [recorded[name] for name in ("processor", "platform") if name in recorded]
    about: Section = {
        "scenario": run.get("scenario", ""),
        "status": log.status,
        "until": run.get("until"),
        "stop reason": log.reason or None,
        "end": _clock(start, log.end_ns / 1e9, log.steps, step_value(log.step_ns)),
        "content hash": log.recorded_hash,
        "schedule": ", ".join(log.schedule),
        "attachments": ", ".join(log.attachments),
        "written": log.metadata.get(WRITTEN, {}).get("time"),
        "written by": ", ".join(versions) or None,
        "machine": ", ".join(machine) or None,
    }
    counts = Counter(event.cause for event in events)
    jumps = counts.pop("jump", 0)
    causes = ", ".join(f"{cause} {count}" for cause, count in counts.items())
    texts = [f"{counts.total()} by overrides: {causes}"] if counts else []
    texts += [f"{jumps} jumps of continuous outputs"] if jumps else []
    return {**about, "events": "; ".join(texts)} if texts else about


def _clock(start: float, stop: float, steps: int, step: object) -> str:
    return f"{f'{start} s to ' if start else ''}{stop} s in {steps} steps of {step} s"


def _event_row(event: SignalEvent) -> Section:
    """Return an override, a fault or a release; of a swap its component, by what has a path."""
    cause = f"{event.cause} {_numbers(event.parameters)}".rstrip()
    signal = event.signal
    values = _numbers(event.values)
    if event.cause == "swap":
        signal, _, values = signal.partition(".")
    return {"t": event.time_ns / 1e9, "signal": signal, "cause": cause, "values": values}


def _numbers(values: Iterable[float], separator: str = " ") -> str:
    return separator.join(f"{value:.6g}" for value in values)


def _substep_row(counts: SubstepCounts) -> Section:
    return {
        "loop": ", ".join(counts.components),
        "taken": counts.accepted,
        "refused": counts.rejected,
        "up to an event": counts.events,
        "shortest": counts.shortest,
        "beyond the tolerance": counts.missed,
        "largest error": _digits(counts.worst_error),
        "t": counts.worst_time,
    }


def _certificate(log: Log) -> Section:
    """Return the certificate of a run, where it has one."""
    if record.recorded_certificate(log) is None:  # a summary reads all signals
        return {}
    certificate = certificate_of(log, summarize(log))
    assert certificate is not None
    notes = enumerate(certificate.notes(), start=1)
    about: Section = {
        "step": f"{certificate.step:g} s",
        "others": ", ".join(f"{step:g} s" for step in certificate.finer_steps),
        "problem": certificate.problem or None,
        **dict(certificate.search()),
        **{share.estimate: str(share) for share in certificate.shares},
        **{f"note {number}": note for number, note in notes},
    }
    rows = [
        {
            "signal": signal.signal,
            "largest": _digits(signal.largest),
            "t": signal.time,
            "at the end": _digits(signal.last),
            "order": _digits(signal.order),
            "at most": _digits(signal.bound) if signal.is_bounded else None,
            "no estimate": signal.reason or None,
        }
        for signal in certificate.signals
    ]
    return {"certificate": about, "error of the step": rows}


def _digits(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.3g}")


def _messages(log: Log) -> Section:
    """Return the messages in the order of time, and how many there are beyond those shown."""
    kept: list[RunMessage] = []
    size = 0
    more = 0
    for message in log.each_message():
        size += len(message.source) + len(message.text)
        if len(kept) < MOST_MESSAGES and size <= MOST_TEXT:
            kept.append(message)
        else:
            more += 1
    rows = [
        {"t": time_ns / 1e9, "level": level, "from": source, "text": text}
        for time_ns, level, source, text in sorted(kept, key=lambda message: message.time_ns)
    ]
    return _limited("messages", rows, MOST_MESSAGES, more)


# --- recordings of other tools, tables of samples ---


def describe_recording(path: str) -> Section:
    """Describe a recording of another tool: topics, times, order, numeric fields.

    Raises
    ------
    LogError
        If it cannot be read, or is damaged.
    """
    from cosim.log.foreign.samples import survey

    topics = survey(Path(path))
    spacings = [topic.spacing for topic in topics if topic.spacing is not None]
    about: Section = {
        "topics": len({topic.channel.topic for topic in topics}),
        "messages": sum(spacing.count for spacing in spacings),
    }
    if spacings:
        first = min(spacing.first_ns for spacing in spacings)
        last = max(spacing.last_ns for spacing in spacings)
        about["log times"] = f"{_seconds(first)} s to {_seconds(last)} s"
        about["duration"] = f"{_seconds(last - first)} s"
    fields = [
        {"field": name, "type": type_name}
        for topic in topics
        for name, type_name in topic.fields.items()
    ]
    content = {"recording": about, "topics": list(map(_topic_row, topics)), "fields": []}
    content |= _limited("fields", fields, MOST_FIELDS)
    problems = {topic.channel.topic: topic.problem for topic in topics if topic.problem}
    return {**content, **_unread("topic", problems)}


def _unread(what: str, problems: Mapping[str, str]) -> Section:
    """Return the section of what could not be read, and why, if there is any."""
    rows = [{what: name, "problem": problem} for name, problem in problems.items()]
    return {"not read": rows} if rows else {}


def _topic_row(topic: TopicSurvey) -> Section:
    channel, spacing, _, _ = topic
    name, encoding, _ = channel.schema or ("", "", b"")
    row: Section = {
        "topic": channel.topic,
        "encoding": channel.encoding,
        "schema": f"{name} ({encoding})" if encoding else name or None,
        "messages": 0,
        **dict.fromkeys(("rate", "out of order", "same instant", "largest gap", "at")),
    }
    if spacing is not None:
        row |= {
            "messages": spacing.count,
            "rate": None if spacing.rate is None else f"{spacing.rate:.6g} Hz",
            "out of order": spacing.late,
            "same instant": spacing.repeated,
            "largest gap": f"{spacing.largest_ns / NANOSECONDS:g} s",
            "at": f"{_seconds(spacing.largest_at_ns)} s",
        }
    return row


def _seconds(time_ns: int) -> str:
    """Return a time in ns as seconds, with all its digits."""
    return f"{Decimal(time_ns).scaleb(-9).normalize():f}"


def describe_samples(source: str) -> Section:
    """Describe a table of samples: its times, what was measured of its signals, how it is read.

    Raises
    ------
    UsageError
        If it is no such table; see :func:`cosim.scenario.data_files.field_file.read_field_data`.
    """
    unread: dict[str, str] = {}
    data = field_data(source, unread=unread)
    distances = np.diff(data.t)
    about: Section = {
        "samples": len(data.t),
        "times": f"{data.t[0]} s to {data.t[-1]} s",
        "median distance": f"{np.median(distances):g} s" if len(distances) else None,
        "largest distance": f"{distances.max():g} s" if len(distances) else None,
    }
    if data.diagnostics:
        about["note"] = "; ".join(data.diagnostics)
    signals = [
        {
            "signal": signal.name,
            "size": signal.values.shape[1],
            "unit": _joined(signal.unit),
            "not measured": int(np.isnan(signal.values).any(axis=1).sum()),
        }
        for signal in data.signals
    ]
    reading = [
        {"read as": what, "found": found, "why": reason, "key": key or None}
        for what, found, reason, key in data.reading
    ]
    content = {"samples": about, "signals": signals, "reading": reading}
    return {**content, **_unread("signal", unread)}


def _joined(unit: Sequence[str] | None) -> str | None:
    return unit if unit is None or isinstance(unit, str) else ", ".join(unit)


# --- scenarios ---


def describe_scenario(name: str) -> Section:
    """Describe a scenario: its clock, components, connections and metadata.

    Of FMUs only the descriptions are read, of components in Python only their tables.
    """
    described = describe(find(name))
    loaded = described.scenario
    graph = None if described.unknown else described.graph()
    clock = described.clock
    settings = loaded.file.scenario
    stages = [] if graph is None else [stage.description for stage in graph.stages]
    about = {
        "name": settings.name,
        "description": settings.description or None,
        "clock": _clock(settings.start_time, settings.stop, clock.steps, settings.step),
        "until": settings.until,
        "schedule": ", ".join(stages) or "not known, as the ports of some components are not",
    }
    signals: list[Section] = []
    for component, spec in loaded.specs.items():
        known = described.components.get(component)
        signals += _signal_rows(component, spec.kind, None if known is None else known.interface)
    gains = () if graph is None else described_gains(graph, clock)
    content = {
        "scenario": about,
        "loops": [gain_values(gain) for gain in gains],
        "signals": signals,
        "connections": _connection_rows(described, graph),
        "metadata": dict(described.context.metadata),
    }
    actions = [_action_row(action) for action in loaded.actions.values()]
    return {**content, "actions": actions} if actions else content


def _action_row(action: ActionTable) -> Section:
    """Return an action as its table has it."""
    effect = action.effects[0]
    value = getattr(action, effect)
    signals = ", ".join(action.signals or action.set or action.swap or ())
    if effect in ("set", "swap"):
        value = ", ".join(map(str, value.values()))
    t = action.when if action.at is None else action.at
    return {"t": t, "signal": signals, "action": effect, "value": value}


def _connection_rows(described: Builder, graph: Graph | None) -> list[Section]:
    """Return the connections; of inputs that nothing drives their start values.

    Where the ports of some components are not known, the connections are as they are written.
    """
    rows = []
    written = described.scenario.connections if graph is None else graph.connections
    for to, connection in written.items():
        unit = _joined(connection.unit)
        made = []
        if graph is not None:
            sources = [graph.ports.output(port) for port in connection.sources]
            of_sources = element_units(connection, sources, graph.ports.input(to))
            units = list(chain.from_iterable(of_sources))
            if connection.unit != AS_IS:
                unit = _distinct(one.reached.name for one in units) or None
            made = [str(one) for one in graph.conversions.get(to, ()) if not one.copies]
            if made:
                unit = f"{unit} -> {_distinct(one.target.name for one in units)}"
        gain = connection.matrix
        expression = f"{gain.tolist()} v" if gain.ndim or gain != 1.0 else "v"
        if connection.offset:
            sign = "-" if connection.offset < 0.0 else "+"
            expression += f" {sign} {abs(connection.offset)}"
        row = {
            "to": str(to),
            "from": connection.label,
            "map": None if expression == "v" else expression,  # of the source's value v
            "unit": unit,
            "conversion": _distinct(made) or None,
        }
        rows.append(row)
    if graph is not None:
        for to, values in graph.unconnected.items():
            start = f"start value {_numbers(values, ', ')}"
            unit = units_text(graph.ports.input(to).measures) or None
            row = {"to": str(to), "from": start, "map": None, "unit": unit, "conversion": None}
            rows.append(row)
    return rows


def _distinct(names: Iterable[str | None]) -> str:
    return ", ".join(dict.fromkeys(name for name in names if name is not None))


def _signal_rows(component: str, kind: str, interface: Interface | None) -> Iterator[Section]:
    """Yield the inputs of a component, then its outputs; one row where they are not known."""
    if interface is None:
        row = dict.fromkeys(
            ("signal", "role", "size", "unit", "variability", "kind", "description")
        )
        yield {**row, "signal": component, "role": "ports not known", "kind": kind}
        return
    inputs = [(signal, "input") for signal in interface.inputs]
    for signal, role in (*inputs, *((signal, signal.role) for signal in interface.outputs)):
        yield {
            "signal": f"{component}.{signal.name}",
            "role": role,
            "size": signal.size,
            "unit": signal.unit_text or None,
            "variability": signal.variability,
            "kind": kind,
            "description": signal.description or None,
        }
