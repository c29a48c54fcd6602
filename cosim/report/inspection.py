"""What a log, an FMU or a scenario contains, and how a swapped component compares with the one it replaces: plain values."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from cosim.core.connections import Connection, Ports, unit_reached
from cosim.core.graph import Graph
from cosim.core.port import Port
from cosim.core.signals import Interface, Signal
from cosim.scenario.build import build
from cosim.scenario.execution import load
from cosim.units import BASE

if TYPE_CHECKING:
    from cosim.fmi.variable import Variable

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
    messages = [
        {"t": m.time_ns / 1e9, "level": m.level, "from": m.source, "text": m.text}
        for m in found.messages()
    ]
    metadata = {
        name: json.loads(found.metadata[f"cosim.component.{name}"].get("metadata", "{}"))
        for name in found.channels
    }
    swapped = {
        f"{name}: unlike what it replaced": _unlike(found.pop("contract", {}))
        for name, found in metadata.items()
    }
    return (
        {"run": about, "signals": rows, "metadata": {k: v for k, v in metadata.items() if v}}
        | swapped
        | ({"messages": messages} if messages else {})
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
        wires = [_wire_row(experiment.graph, to, wire) for to, wire in loaded.connections.items()]
        return {
            "scenario": about,
            "signals": rows,
            "connections": wires,
            "metadata": dict(experiment.metadata),
        }


def _wire_row(graph: Graph, to: str, wire: Connection) -> Section:
    """Show one connection: its map where it has one, and its conversion of units where they differ."""
    shown = (
        "v"
        if not np.ndim(wire.gain) and wire.gain == 1.0
        else f"{np.asarray(wire.gain).tolist()} v"
    )
    if wire.offset:
        shown += f" {'-' if wire.offset < 0.0 else '+'} {abs(wire.offset)}"
    ports = Ports(graph.layout)
    conversion = next(iter(graph.conversions.get(Port.parse(to), ())), None)
    _, target = ports.input(Port.parse(to))
    source = ports.source(wire.sources[0]).signal
    unit = unit_reached(wire, source, target).name
    return {
        "to": to,
        "from": wire.label,
        "map": None if shown == "v" else shown,
        "unit": unit if conversion is None else f"{unit} -> {target.unit}",
        "conversion": conversion and str(conversion),
    }


def fmu(path: str) -> Section:
    """Describe an FMU: kind, capabilities, variables."""
    from cosim.fmi.reading.model_description import read

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
    capabilities = {
        interface_type: asdict(able) for interface_type, able in found.capabilities.items()
    }
    rows = [_variable_row(variable) for variable in found.variables]
    defined = {
        (v.unit, v.base) for v in found.variables if v.unit is not None and v.base is not None
    }
    units = {
        unit: asdict(base)
        for unit, base in sorted(defined, key=lambda pair: (pair[0], abs(pair[1].offset)))
    }
    return {
        "fmu": about,
        "capabilities": capabilities,
        "units": units,
        "variables": rows,
        "dependencies": _lists(found.dependencies),
        "initial_dependencies": _lists(found.initial_dependencies),
        "residual_form": found.dae and asdict(found.dae),
    }


def _variable_row(variable: Variable) -> Section:
    """Give all of a variable; infinite limits are none."""
    row = asdict(variable)
    return row | {key: None if math.isinf(row[key]) else row[key] for key in ("minimum", "maximum")}


def _lists(dependencies: Mapping[str, tuple[str, ...] | None]) -> dict[str, list[str] | None]:
    return {name: None if names is None else list(names) for name, names in dependencies.items()}


def shown_fmu(found: Section) -> Section:
    """Make of what ``fmu`` gives what people read: one line for each variable, no line for what is not there."""
    from cosim.fmi.description import INTERFACE_TYPE_NAMES

    about = {
        key.replace("_", " "): _listed(value)
        for key, value in found["fmu"].items()
        if value not in (None, [], 0)
    }
    capabilities = {
        INTERFACE_TYPE_NAMES[interface_type]: _able(able)
        for interface_type, able in found["capabilities"].items()
    }
    units = {name: _si(base) for name, base in found["units"].items()}
    at_start = {
        row["name"]: names
        for row in found["variables"]
        if (names := _starts_with(found, row["name"]))
    }
    rows = [_shown_variable(row, found) for row in found["variables"]]
    shown = {
        "fmu": about,
        "capabilities": capabilities,
        "units in SI": units,
        "variables": rows,
        "at the start": at_start,
    }
    return shown | (
        {"residual form": _shown_form(found["residual_form"])} if found["residual_form"] else {}
    )


def _shown_form(dae: Section) -> Section:
    """Show a residual form: its unknowns, its equations and what they depend on, what is wrong with it."""
    about = {
        "fmi-ls-dae": dae["version"],
        "algebraic variables": ", ".join(dae["algebraic"]),
        "problems": "; ".join(dae["problems"]),
    }
    equations = {
        f"0 = {one['name']}": one["dependencies"]
        for equation in dae["residuals"]
        for one in equation
    }
    needs = {
        name: f"depends on {_names(names)}"
        for name, names in (equations | dae["dependencies"]).items()
    }
    return {key: value for key, value in about.items() if value} | needs


def _names(names: Sequence[str] | None) -> str:
    return "what is not said" if names is None else ", ".join(names) or "nothing"


def _listed(value: Any) -> Any:
    return ", ".join(value) if isinstance(value, list) else value


def _able(able: Section) -> str:
    """Name what it can do, and what is special."""
    named = [
        key.replace("_", " ") if value is True else f"{key.replace('_', ' ')} {value}"
        for key, value in able.items()
        if value
    ]
    return ", ".join(named)


def _unlike(contract: Section) -> list[Section]:
    """Give the rows of a swapped component's report that differ."""
    return [row for row in contract.get("ports", []) if row["verdict"] not in ("ok", "unknown")]


def _si(base: Section) -> str:
    powers = [
        f"{name}{'' if power == 1 else power}"
        for name, power in zip(BASE, base["exponents"], strict=True)
        if power
    ]
    offset = f" + {base['offset']:g}" if base["offset"] else ""
    return f"{base['factor']!r} {'.'.join(powers) or '1'}{offset}"


def _starts_with(found: Section, name: str) -> str | None:
    if name not in found["initial_dependencies"]:
        return None
    names = found["initial_dependencies"][name]
    return f"depends on {_names(names)}"


def _shown_variable(row: Section, found: Section) -> Section:
    dimensions = "".join(f"[{dimension}]" for dimension in row["dimensions"])
    low, high = row["minimum"], row["maximum"]
    span = (
        ""
        if low is None and high is None
        else f"{'' if low is None else f'{low:g}'}..{'' if high is None else f'{high:g}'}"
    )
    items = ", ".join(f"{value} {name}" for name, value in row["items"].items())
    is_state, of = row["name"] in found["fmu"]["states"], None
    if row["alias_of"] or row["derivative_of"]:
        of = f"alias {row['alias_of']}" if row["alias_of"] else f"der {row['derivative_of']}"
    return {
        "variable": row["name"],
        "causality": row["causality"],
        "variability": row["variability"],
        "type": f"{row['type']}{dimensions}",
        "unit": row["unit"],
        "start": _shown_start(row),
        "range": items or span or None,
        "of": "state" if is_state else of,
        "depends on": None if is_state or row["alias_of"] else _depends(row, found["dependencies"]),
    }


def _shown_start(row: Section) -> str | None:
    """Give start values shortly: one for all where they are equal, the first of many."""
    values = row["text"] if row["start"] is None else [f"{value:.6g}" for value in row["start"]]
    if values is None:
        return None
    few = (
        f"{len(values)} x {values[0]}"
        if len(values) > 1 and len(set(values)) == 1
        else " ".join(values[:4])
    )
    guess = "about " if row["initial"] == "approx" else ""
    return f"{guess}{few}{' ...' if len(set(values)) > 1 and len(values) > 4 else ''}"


def _depends(row: Section, dependencies: Mapping[str, list[str] | None]) -> str | None:
    if row["causality"] != "output" and row["derivative_of"] is None:
        return None
    names = dependencies.get(row["name"])
    return "unknown" if names is None else ", ".join(names) or "nothing"


def check(path: str) -> list[Section]:
    """Give everything that is wrong with an FMU."""
    from cosim.fmi.checking.check import check as check_fmu

    return [finding._asdict() for finding in check_fmu(path)]


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
