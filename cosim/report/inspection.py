"""What a log, an FMU, a table of samples or a scenario contains, as plain values."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, fields
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.core.connections import AS_IS, Connection, element_units
from cosim.core.graph import Graph
from cosim.core.port import Port
from cosim.core.recorded.partial import declared_channels
from cosim.core.recorded.signals import RunMessage
from cosim.core.recording import SignalEvent
from cosim.core.signals import Channel, Signal
from cosim.errors import LogError
from cosim.instants import step_value
from cosim.log.contents.environment import WRITTEN
from cosim.report.certificate import certificate_of
from cosim.report.summary import summarize
from cosim.scenario.building.build import DescribedScenario, describe
from cosim.scenario.building.coupling_check import described_gains, gain_values
from cosim.scenario.data_files.field_file import field_data
from cosim.scenario.document.action_tables import effect_of, signals_of
from cosim.scenario.document.document import find
from cosim.scenario.document.schema import ActionTable
from cosim.scenario.record import (
    component_table,
    recorded_certificate,
    recorded_loop_gains,
    recorded_start,
    recorded_substep_counts,
    recorded_window,
    replay_origin,
    run_metadata,
)
from cosim.units import units_text

if TYPE_CHECKING:
    from cosim.fmi.description import Description
    from cosim.fmi.variable import Variable
    from cosim.log import Log

Section = dict[str, Any]

VERSIONS = ("cosim", "python", "numpy", "scipy", "mcap")
MOST_MESSAGES = 10_000  # that are shown of a log
MOST_OVERRIDES = 10  # and releases
MOST_TEXT = 2**22  # characters of them


def describe_log(path: str) -> Section:
    """Describe a log: the run, its components and their signals, metadata and messages.

    What cannot be understood of its documents is left out; ``problems`` says why.
    """
    from cosim.log import open_log

    log = open_log(path)
    end = log.end_ns / 1e9
    step = step_value(log.step_ns)
    run = run_metadata(log)
    problems: dict[str, None] = {}
    start = 0.0
    with _noted(problems):
        window = recorded_window(log)
        start = recorded_start(log) if window is None else window[0]
    since = f"{start} s to " if start else ""
    about: Section = {
        "scenario": run.get("scenario", ""),
        "status": log.status,
        "until": run.get("until"),
        "stop reason": log.reason or None,
        "end": f"{since}{end} s in {log.steps} steps of {step} s",
        "content hash": log.recorded_hash,
        "schedule": ", ".join(log.schedule),
        "attachments": ", ".join(log.attachments),
        "written": log.metadata.get(WRITTEN, {}).get("time"),
        **_environment(log.metadata.get("cosim.env", {})),
    }
    events = log.events()
    if events:
        about["events"] = _event_counts(events)
    if "replay" in run:
        with _noted(problems):
            about["replay of"] = asdict(replay_origin(log))
    signals: list[Section] = []
    for name, channel in log.channels.items():
        signals += _signal_rows(channel, log.kinds.get(name, ""))
    metadata = {}
    differences = {}
    for name in declared_channels(log.channels):
        entry: Section = {}
        with _noted(problems):
            entry = component_table(log, name)
        report = entry.pop("swap_report", {})
        if report:
            differences[name] = _differences(report)
        if entry:
            metadata[name] = entry
    content = {"run": about, **_partial(log), "loops": []}
    with _noted(problems):
        content["loops"] = [gain_values(gain) for gain in recorded_loop_gains(log)]
    with _noted(problems):
        content |= _substeps(log)
    content |= {"signals": signals, "metadata": metadata, "differences": differences}
    content |= _overrides(events)
    with _noted(problems):
        content |= _certificate(log)
    messages, more = _messages(log)
    if messages:
        content["messages"] = messages
    if more:
        content["more messages"] = {"not shown": more}
    if problems:
        content["problems"] = list(problems)
    return content


@contextmanager
def _noted(problems: dict[str, None]) -> Iterator[None]:
    """Note what cannot be understood of a log; the rest of it is described all the same."""
    try:
        yield
    except LogError as error:
        problems[str(error)] = None


def _environment(recorded: Mapping[str, str]) -> Section:
    """Return by what and on which machine a log was written, as far as it says so."""
    versions = [f"{name} {recorded[name]}" for name in VERSIONS if name in recorded]
    machine = [recorded[name] for name in ("processor", "platform") if name in recorded]
    return {"written by": ", ".join(versions) or None, "machine": ", ".join(machine) or None}


def _partial(log: Log) -> Section:
    """Return what is recorded of what, where that is not all."""
    partial = log.partial
    if partial is None:
        return {}
    overview = partial.overview(log.channels)
    overview["not recorded"] = partial.missing(log.channels)
    return {"partial": overview}


def _substeps(log: Log) -> Section:
    """Return how many substeps loops took, where they took any."""
    rows: list[Section] = []
    for counts in recorded_substep_counts(log):
        row = {
            "loop": ", ".join(counts.components),
            "taken": counts.accepted,
            "refused": counts.rejected,
            "up to an event": counts.events,
            "shortest": counts.shortest,
            "beyond the tolerance": counts.missed,
            "largest error": _digits(counts.worst_error),
            "t": counts.worst_time,
        }
        rows.append(row)
    return {"substeps": rows} if rows else {}


def _certificate(log: Log) -> Section:
    """Return the certificate of the run, where it has one."""
    if recorded_certificate(log) is None:  # a summary reads all signals
        return {}
    certificate = certificate_of(log, summarize(log))
    assert certificate is not None
    about: Section = {
        "step": f"{certificate.step:g} s",
        "others": ", ".join(f"{step:g} s" for step in certificate.finer_steps),
        "problem": certificate.problem or None,
    }
    about |= dict(certificate.search())
    for share in certificate.shares:
        about[share.estimate] = str(share)
    for number, note in enumerate(certificate.notes(), start=1):
        about[f"note {number}"] = note
    rows: list[Section] = []
    for signal in certificate.signals:
        row = {
            "signal": signal.signal,
            "largest": _digits(signal.largest),
            "t": signal.time,
            "at the end": _digits(signal.last),
            "order": _digits(signal.order),
            "at most": _digits(signal.bound) if signal.is_bounded else None,
            "no estimate": signal.reason or None,
        }
        rows.append(row)
    return {"certificate": about, "error of the step": rows}


def _digits(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.3g}")


def _event_counts(events: Sequence[SignalEvent]) -> str:
    """Return how many events there are of each cause."""
    counts = Counter(event.cause for event in events)
    jumps = counts.pop("jump", 0)
    texts = []
    if counts:
        causes = ", ".join(f"{cause} {count}" for cause, count in counts.items())
        texts.append(f"{counts.total()} by overrides: {causes}")
    if jumps:
        texts.append(f"{jumps} jumps of continuous outputs")
    return "; ".join(texts)


def _overrides(events: Sequence[SignalEvent]) -> Section:
    """Return the first overrides, faults and releases, and how many more there are."""
    overrides = [event for event in events if event.cause not in ("follow", "jump")]
    rows: list[Section] = []
    for event in overrides[:MOST_OVERRIDES]:
        t = event.time_ns / 1e9
        cause = f"{event.cause} {_numbers(event.parameters)}".rstrip()
        signal = event.signal
        values = _numbers(event.values)
        if event.cause == "swap":  # of a component, by what has a path
            signal, _, values = signal.partition(".")
        rows.append({"t": t, "signal": signal, "cause": cause, "values": values})
    content: Section = {}
    if rows:
        content["overrides"] = rows
    if len(overrides) > len(rows):
        content["more overrides"] = {"not shown": len(overrides) - len(rows)}
    return content


def _numbers(values: Iterable[float]) -> str:
    return " ".join(f"{value:.6g}" for value in values)


def _messages(log: Log) -> tuple[list[Section], int]:
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
    rows = []
    for message in sorted(kept, key=lambda message: message.time_ns):
        row = {
            "t": message.time_ns / 1e9,
            "level": message.level,
            "from": message.source,
            "text": message.text,
        }
        rows.append(row)
    return rows, more


def _differences(report: Section) -> list[Section]:
    """Return the rows of a swapped component's report that differ."""
    ports: list[Section] = report.get("ports", [])
    return [row for row in ports if row["verdict"] not in ("ok", "unknown")]


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
    signals: list[Section] = []
    for signal in data.signals:
        row = {
            "signal": signal.name,
            "size": signal.values.shape[1],
            "unit": ", ".join(signal.unit) if isinstance(signal.unit, tuple) else signal.unit,
            "not measured": int(np.isnan(signal.values).any(axis=1).sum()),
        }
        signals.append(row)
    reading = []
    for what, found, reason, key in data.reading:
        reading.append({"read as": what, "found": found, "why": reason, "key": key or None})
    content = {"samples": about, "signals": signals, "reading": reading}
    if unread:
        content["not read"] = [{"signal": name, "problem": unread[name]} for name in unread]
    return content


def describe_scenario(name: str) -> Section:
    """Describe a scenario: its clock, components, connections and metadata.

    Of FMUs only the descriptions are read, of components in Python only their tables.
    """
    described = describe(find(name))
    loaded = described.scenario
    graph = described.graph
    settings = loaded.file.scenario
    steps = described.clock.steps
    since = f"{settings.start_time} s to " if settings.start_time else ""
    stages = [] if graph is None else [stage.description for stage in graph.stages]
    about = {
        "name": settings.name,
        "description": settings.description or None,
        "clock": f"{since}{settings.stop} s in {steps} steps of {settings.step} s",
        "until": settings.until,
        "schedule": ", ".join(stages) or "not known, as the ports of some components are not",
    }
    signals: list[Section] = []
    for component, spec in loaded.specs.items():
        if component in described.components:
            channel = Channel(component, described.components[component].interface, 0)
            signals += _signal_rows(channel, spec.kind)
        else:
            signals.append(_unknown_row(component, spec.kind))
    gains = () if graph is None else described_gains(graph, described.clock)
    content = {
        "scenario": about,
        "loops": [gain_values(gain) for gain in gains],
        "signals": signals,
        "connections": _connection_rows(described),
        "metadata": dict(described.metadata),
    }
    actions = [_action_row(action) for action in loaded.actions.values()]
    if actions:
        content["actions"] = actions
    return content


def _action_row(action: ActionTable) -> Section:
    """Return an action as its table has it."""
    effect = effect_of(action)
    value = getattr(action, effect)
    signals = ", ".join(signals_of(action) or action.set or ())
    if action.swap is not None:
        signals = ", ".join(action.swap)
        value = ", ".join(action.swap.values())
    if action.set is not None:
        value = ", ".join(map(str, action.set.values()))
    t = action.when if action.at is None else action.at
    return {"t": t, "signal": signals, "action": effect, "value": value}


def _connection_rows(described: DescribedScenario) -> list[Section]:
    graph = described.graph
    rows = []
    if graph is None:
        for to, connection in described.scenario.connections.items():
            rows.append(_written_row(to, connection))
        return rows
    for to, connection in graph.connections.items():
        rows.append(_connection_row(graph, to, connection))
    for to, values in graph.unconnected.items():
        rows.append(_start_row(graph, to, values))
    return rows


def _written_row(to: Port, connection: Connection) -> Section:
    """Describe a connection as it is written, where the ports at its ends need not be known."""
    unit = connection.unit
    return {
        "to": str(to),
        "from": connection.label,
        "map": _map(connection),
        "unit": ", ".join(unit) if isinstance(unit, tuple) else unit,
        "conversion": None,
    }


def _connection_row(graph: Graph, to: Port, connection: Connection) -> Section:
    """Describe one connection: its map and its unit conversions, where it has them."""
    end = graph.ports.input(to)
    sources = [graph.ports.output(port) for port in connection.sources]
    units = list(chain.from_iterable(element_units(connection, sources, end)))
    names = [unit.reached.name for unit in units if unit.reached.name is not None]
    unit = AS_IS if connection.unit == AS_IS else ", ".join(dict.fromkeys(names)) or None
    conversions = dict.fromkeys(
        str(conversion) for conversion in graph.conversions.get(to, ()) if not conversion.copies
    )
    if conversions:
        targets = [unit.target.name for unit in units if unit.target.name is not None]
        unit = f"{unit} -> {', '.join(dict.fromkeys(targets))}"
    return {
        **_written_row(to, connection),
        "unit": unit,
        "conversion": ", ".join(conversions) or None,
    }


def _start_row(graph: Graph, to: Port, values: tuple[float, ...]) -> Section:
    """Describe an input that nothing drives."""
    units = graph.ports.input(to).measures
    value = ", ".join(f"{value:.6g}" for value in values)
    return {
        "to": str(to),
        "from": f"start value {value}",
        "map": None,
        "unit": units_text(units) or None,
        "conversion": None,
    }


def _map(connection: Connection) -> str | None:
    """Return gain and offset as an expression of the source's value v; None: there are none."""
    gain = connection.matrix
    expression = "v"
    if gain.ndim or gain != 1.0:
        expression = f"{gain.tolist()} v"
    if connection.offset:
        sign = "-" if connection.offset < 0.0 else "+"
        expression += f" {sign} {abs(connection.offset)}"
    return None if expression == "v" else expression


def describe_fmu(path: str) -> Section:
    """Describe an FMU: capabilities of its interface types, units, variables, dependencies."""
    from cosim.fmi.reading.model_description import read

    archive = read(path)
    description = archive.description
    about = {
        "name": description.name,
        "fmi_version": description.version,
        "tool": description.tool or None,
        "platforms": list(description.platforms),
        "states": list(description.states),
        "n_states": description.n_states,
        "event_indicators": description.event_indicators,
        "clocks": list(description.clocks),
        "default_step": description.default_step,
        "default_tolerance": description.default_tolerance,
        "sha256": archive.sha256,
    }
    capabilities = {}
    for interface_type, values in description.capabilities.items():
        capabilities[interface_type] = asdict(values)
    content: Section = {"fmu": about, "capabilities": capabilities, "units": _units(description)}
    content["vectors"] = _vectors(description)
    content["variables"] = [_variable_row(variable) for variable in description.variables]
    content["dependencies"] = _lists(description.dependencies)
    content["initial_dependencies"] = _lists(description.initial_dependencies)
    content["residual_form"] = description.dae and asdict(description.dae)
    return content


def _units(description: Description) -> Section:
    """Return what the units are in SI; of those with the same name, the one with an offset."""
    bases = set()
    for variable in description.variables:
        if variable.unit is not None and variable.base is not None:
            bases.add((variable.unit, variable.base))
    in_order = sorted(bases, key=lambda pair: (pair[0], abs(pair[1].offset)))
    return {unit: asdict(base) for unit, base in in_order}


def _vectors(description: Description) -> dict[str, list[str]]:
    """Return the ports that are several scalar variables, with the names of these."""
    vectors = {}
    for causality in ("input", "output"):
        for signal, group in description.ports(causality):
            if len(group) > 1:
                vectors[signal.name] = [variable.name for variable in group]
    return vectors


def _variable_row(variable: Variable) -> Section:
    """Return all of a variable; infinite limits are None."""
    # Not by asdict, which copies every value of very many variables deeply.
    row = {field.name: getattr(variable, field.name) for field in fields(variable)}
    row["base"] = None if variable.base is None else asdict(variable.base)
    for limit in ("minimum", "maximum"):
        if math.isinf(row[limit]):
            row[limit] = None
    return row


def _lists(dependencies: Mapping[str, Iterable[str] | None]) -> dict[str, list[str] | None]:
    return {name: None if names is None else list(names) for name, names in dependencies.items()}


def _signal_rows(channel: Channel, kind: str) -> Iterator[Section]:
    """Yield the inputs of a component, then its outputs."""
    for signal in channel.interface.inputs:
        yield _signal_row(channel.name, kind, signal, role="input")
    for signal in channel.interface.outputs:
        yield _signal_row(channel.name, kind, signal, role=signal.role)


def _unknown_row(component: str, kind: str) -> Section:
    """Return the row of a component whose ports are not known."""
    return {
        "signal": component,
        "role": "ports not known",
        "size": None,
        "unit": None,
        "variability": None,
        "kind": kind,
        "description": None,
    }


def _signal_row(component: str, kind: str, signal: Signal, *, role: str) -> Section:
    return {
        "signal": f"{component}.{signal.name}",
        "role": role,
        "size": signal.size,
        "unit": signal.unit_text or None,
        "variability": signal.variability,
        "kind": kind,
        "description": signal.description or None,
    }
