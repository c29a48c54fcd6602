"""What a log, an FMU or a scenario contains, and how a swapped component compares with the one it replaces: plain values."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.core.signals import Interface, Signal
from cosim.errors import CosimError
from cosim.scenario.build import Scenario, build, build_site, parse
from cosim.scenario.execution import load
from cosim.units import BASE

if TYPE_CHECKING:
    from cosim.fmi.compare import Port, PortRow
    from cosim.fmi.description import Variable

Section = dict[str, Any]


def log(path: str) -> Section:
    """Describe a log: the run, its components and their signals."""
    from cosim.log import open_log

    found = open_log(path)
    result = found.result
    about = {
        "scenario": found.metadata.get("cosim.run", {}).get("scenario", ""),
        "status": found.status,
        "reason": result.get("reason") or None,
        "end": f"{int(result['end_ns']) / 1e9} s in {result['steps']} steps of {found.step_ns / 1e9} s",
        "content hash": result["content_hash"],
        "schedule": ", ".join(json.loads(found.metadata["cosim.schedule"]["stages"])),
        "attachments": ", ".join(found.attachments),
    }
    rows = [
        _signal_row(name, found.kinds.get(name, ""), signal, role)
        for name, channel in found.channels.items()
        for signal, role in _signals(channel.interface)
    ]
    messages = [{"t": m.time_ns / 1e9, "level": m.level, "from": m.name, "text": m.text} for m in found.messages()]
    facts = {name: json.loads(found.metadata[f"cosim.component.{name}"].get("facts", "{}")) for name in found.channels}
    return {"run": about, "signals": rows, "facts": {k: v for k, v in facts.items() if v}} | (
        {"messages": messages} if messages else {}
    )


def scenario(name: str) -> Section:
    """Describe a scenario: its clock, components and connections."""
    loaded = load(name)
    with ExitStack() as resources:
        experiment = build(loaded.document, resources)
        settings = loaded.file.scenario
        about = {
            "name": settings.name,
            "description": settings.description or None,
            "clock": f"{settings.stop} s in {experiment.clock.steps} steps of {settings.step} s",
            "schedule": ", ".join(stage.description for stage in experiment.graph.stages),
        }
        rows = [
            _signal_row(channel.name, loaded.specs[channel.name].kind, signal, role)
            for channel in experiment.graph.layout.channels
            for signal, role in _signals(channel.interface)
        ]
        wires = {to: wire.source for to, wire in loaded.connections.items()}
        return {"scenario": about, "signals": rows, "connections": wires, "facts": dict(experiment.facts)}


def fmu(path: str) -> Section:
    """Describe an FMU: kind, capabilities, variables."""
    from cosim.fmi.reading import read

    archive = read(path)
    found = archive.description
    about = {
        "name": found.name,
        "fmi_version": found.version,
        "tool": found.tool or None,
        "platforms": list(found.platforms),
        "states": list(found.states),
        "n_states": found.n_states,
        "event_indicators": found.event_indicators,
        "clocks": list(found.clocks),
        "default_step": found.default_step,
        "default_tolerance": found.default_tolerance,
        "sha256": archive.sha256,
    }
    capabilities = {mode: asdict(able) for mode, able in found.capabilities.items()}
    rows = [_variable_row(variable) for variable in found.variables]
    units = {v.unit: asdict(v.base) for v in found.variables if v.unit is not None and v.base is not None}
    return {
        "fmu": about,
        "capabilities": capabilities,
        "units": units,
        "variables": rows,
        "dependencies": _lists(found.dependencies),
        "initial_dependencies": _lists(found.initial_dependencies),
    }


def _variable_row(variable: Variable) -> Section:
    """Give all of a variable; infinite limits are none."""
    row = asdict(variable)
    return row | {key: None if math.isinf(row[key]) else row[key] for key in ("minimum", "maximum")}


def _lists(dependencies: Mapping[str, tuple[str, ...] | None]) -> dict[str, list[str] | None]:
    return {name: None if names is None else list(names) for name, names in dependencies.items()}


def shown_fmu(found: Section) -> Section:
    """Make of what ``fmu`` gives what people read: one line for each variable, no line for what is not there."""
    from cosim.fmi.description import MODE_NAMES

    about = {key.replace("_", " "): _listed(value) for key, value in found["fmu"].items() if value not in (None, [], 0)}
    capabilities = {MODE_NAMES[mode]: _able(able) for mode, able in found["capabilities"].items()}
    units = {name: _si(base) for name, base in found["units"].items()}
    at_start = {row["name"]: names for row in found["variables"] if (names := _starts_with(found, row["name"]))}
    rows = [_shown_variable(row, found["dependencies"]) for row in found["variables"]]
    return {"fmu": about, "capabilities": capabilities, "units in SI": units, "variables": rows, "at the start": at_start}


def _listed(value: Any) -> Any:
    return ", ".join(value) if isinstance(value, list) else value


def _able(able: Section) -> str:
    """Name what it can do, and what is special."""
    named = [
        key.replace("_", " ") if value is True else f"{key.replace('_', ' ')} {value}" for key, value in able.items() if value
    ]
    return ", ".join(named)


def _si(base: Section) -> str:
    powers = [f"{name}{'' if power == 1 else power}" for name, power in zip(BASE, base["exponents"], strict=True) if power]
    offset = f" + {base['offset']:g}" if base["offset"] else ""
    return f"{base['factor']!r} {'.'.join(powers) or '1'}{offset}"


def _starts_with(found: Section, name: str) -> str | None:
    if name not in found["initial_dependencies"]:
        return None
    names = found["initial_dependencies"][name]
    return "depends on " + ("what is not said" if names is None else ", ".join(names) or "nothing")


def _shown_variable(row: Section, dependencies: Mapping[str, list[str] | None]) -> Section:
    dimensions = "".join(f"[{dimension}]" for dimension in row["dimensions"])
    start = row["text"] if row["start"] is None else [f"{value:.6g}" for value in row["start"]]
    low, high = row["minimum"], row["maximum"]
    span = "" if low is None and high is None else f"{'' if low is None else f'{low:g}'}..{'' if high is None else f'{high:g}'}"
    items = ", ".join(f"{value} {name}" for name, value in row["items"].items())
    names = dependencies.get(row["name"], [])
    of = row["alias_of"] or row["derivative_of"]
    return {
        "variable": row["name"],
        "causality": row["causality"],
        "variability": row["variability"],
        "type": f"{row['type']}{dimensions}",
        "unit": row["unit"],
        "start": None if start is None else " ".join(start),
        "range": items or span or None,
        "of": None if of is None else f"{'alias' if row['alias_of'] else 'der'} {of}",
        "depends on": "unknown" if names is None else ", ".join(names),
    }


def check(path: str) -> list[Section]:
    """Give everything that is wrong with an FMU."""
    from cosim.fmi.check import check as check_fmu

    return [finding._asdict() for finding in check_fmu(path)]


def compare(
    loaded: Scenario, *, swaps: Mapping[str, str], changes: Mapping[str, Any]
) -> tuple[dict[str, list[Section]], list[str]]:
    """Compare the ports of swapped components with those they replace; give the rows by component, and what prevents the run."""
    from cosim.fmi.compare import compare_ports

    changed = loaded.document.with_swaps(swaps).with_changes(changes)
    rows: dict[str, list[Section]] = {}
    problems: list[str] = []
    for name in swaps:
        if name not in loaded.specs:
            continue
        with ExitStack() as resources:
            try:
                before = loaded.specs[name].build(name, build_site(loaded, resources)).interface
                swapped = parse(changed)
                after = swapped.specs[name].build(name, build_site(swapped, resources)).interface
            except CosimError:  # the run's own problems are told below; those of what is replaced do not matter
                continue
            used = {wire.source.partition("[")[0] for wire in loaded.connections.values()} | set(loaded.file.truth)
            used |= {true for true in loaded.file.truth.values() if isinstance(true, str)}
            used |= set(loaded.connections)
            rows[name] = [_port_row(name, row, used) for row in compare_ports(before, after)]
    with ExitStack() as resources:
        try:
            experiment = build(changed, resources)
            experiment.graph.prepare(experiment.clock.step_ns)
            experiment.graph.initialize(0.0, np.zeros(experiment.graph.layout.width))
        except CosimError as error:
            problems += str(error).splitlines()
    return rows, problems


def _port_row(name: str, row: PortRow, used: set[str]) -> Section:
    sides = {"before": row.needed, "after": row.found}
    shown = {side: None if port is None else _port(port) for side, port in sides.items()}
    return {"port": f"{name}.{row.name}", **shown, "status": row.status, "connected": f"{name}.{row.name}" in used}


def _port(port: Port) -> str:
    through = "unknown" if port.feedthrough is None else ", ".join(port.feedthrough) or "nothing"
    fed = f", fed through from {through}" if port.causality == "output" else ""
    return f"{port.causality} of size {port.size}{'' if port.unit is None else f' [{port.unit}]'}{fed}"


def _signals(interface: Interface) -> Iterable[tuple[Signal, str]]:
    yield from ((signal, "input") for signal in interface.inputs)
    yield from ((signal, signal.role) for signal in interface.outputs)


def _signal_row(component: str, kind: str, signal: Signal, role: str) -> Section:
    return {
        "signal": f"{component}.{signal.name}",
        "role": role,
        "size": signal.size,
        "unit": signal.unit,
        "variability": signal.variability,
        "kind": kind,
    }
