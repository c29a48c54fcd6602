"""What a log, an FMU or a scenario contains, and how a swapped component compares with the one it replaces: plain values."""

from __future__ import annotations

import json
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import asdict
from typing import Any

from cosim.core.connections import Connection
from cosim.core.graph import Graph
from cosim.core.signals import Interface, Signal
from cosim.scenario.build import build
from cosim.scenario.execution import load

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
    swapped = {f"{name}: unlike what it replaced": _unlike(found.pop("contract", {})) for name, found in facts.items()}
    return (
        {"run": about, "signals": rows, "facts": {k: v for k, v in facts.items() if v}}
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
        return {"scenario": about, "signals": rows, "connections": wires, "facts": dict(experiment.facts)}


def _wire_row(graph: Graph, to: str, wire: Connection) -> Section:
    """Show one connection: its map where it has one, and its conversion of units where they differ."""
    shown = "" if not np.ndim(wire.gain) and wire.gain == 1.0 else f"{np.asarray(wire.gain).tolist()} v"
    shown += f" + {wire.offset}" if wire.offset else ""
    conversion = graph.conversions.get(to)
    return {"to": to, "from": wire.source, "map": shown or None, "unit": wire.unit, "converted": conversion and str(conversion)}


def fmu(path: str) -> Section:
    """Describe an FMU: kind, capabilities, variables."""
    from cosim.fmi.description import MODE_NAMES
    from cosim.fmi.reading import read

    archive = read(path)
    found = archive.description
    about = {
        "name": found.name,
        "FMI": found.version,
        "platforms": ", ".join(found.platforms) or None,
        "states": ", ".join(found.states) or None,
        "event indicators": found.event_indicators,
        "sha256": archive.sha256,
    }
    capabilities = {
        MODE_NAMES[mode]: ", ".join(
            f"{key.replace('_', ' ')}: {value}" for key, value in asdict(able).items() if value is not None
        )
        for mode, able in found.capabilities.items()
    }
    rows = [
        {
            "variable": variable.name,
            "causality": variable.causality,
            "type": variable.type,
            "size": variable.size,
            "unit": variable.unit,
            "start": None if variable.start is None else list(variable.start),
            "depends on": _depends(found.dependencies.get(variable.name, ())),
        }
        for variable in found.variables
    ]
    return {"fmu": about, "capabilities": capabilities, "variables": rows}


def _unlike(contract: Section) -> list[Section]:
    """Give the rows of a swapped component's report that differ."""
    return [row for row in contract.get("ports", []) if row["verdict"] not in ("ok", "unknown")]


def _depends(names: Iterable[str] | None) -> str:
    return "unknown" if names is None else ", ".join(names)


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
