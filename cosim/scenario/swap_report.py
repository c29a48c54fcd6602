"""What a swapped component has to keep: the report before a run, by component, and what stops the run.

Both sides are built, started with the scenario's initial inputs, linearized where they linearize, and let go of again. The
swapped scenario itself says what stops it; the rows say how the two sides differ.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field, replace
from itertools import groupby
from typing import Any

import numpy as np

from cosim.arrays import Vector
from cosim.core.contracts import prepare
from cosim.core.signals import Interface
from cosim.errors import CosimError, ScenarioError
from cosim.fmi.description import INTERFACE_TYPE_NAMES, Description, InterfaceType
from cosim.scenario.build import Draft, draft, finish
from cosim.scenario.document import Document
from cosim.scenario.kinds import BuildContext, Kind
from cosim.scenario.port_comparison import (
    Ability,
    ComparedAspect,
    NearStart,
    Proposal,
    Side,
    compare_sides,
    pairs_of,
    propose,
)


@dataclass(frozen=True)
class Report:
    """How a swapped component compares with the one it replaces."""

    component: str
    rows: tuple[ComparedAspect, ...]
    proposals: tuple[Proposal, ...]

    def to_dict(self) -> dict[str, Any]:
        """Give plain values; ports by their full names."""
        rows = [asdict(row) | {"port": self._port(row.port)} for row in self.rows]
        return {
            "ports": rows,
            "proposals": [asdict(one) | {"option": self._option(one)} for one in self.proposals],
        }

    @property
    def lines(self) -> list[dict[str, str]]:
        """Give the report for people: one line for a port in which both sides agree, else one for each aspect that is not ok."""
        lines = []
        for port, rows in groupby(self.rows, key=lambda row: row.port):
            aspects = list(rows)
            for row in [row for row in aspects if row.verdict != "ok"] or [_agreed(aspects)]:
                ends = {
                    "before": shown(row.before),
                    "after": "the same" if row.verdict == "ok" else shown(row.after),
                }
                place = {"": self._port(port), "aspect": row.aspect}
                lines.append(
                    {
                        **place,
                        **ends,
                        "verdict": row.verdict,
                        "connected": shown(row.connected) if port else "",
                    }
                )
        return lines

    @property
    def differences(self) -> str:
        """What differs on the ports that are connected, and in the whole, in one line; empty: nothing."""
        found = [row for row in self.rows if row.verdict == "differs" and row.connected]
        return "; ".join(
            f"{row.port} {row.aspect} {shown(row.after)} (was {shown(row.before)})".strip()
            for row in found
        )

    @property
    def hints(self) -> list[str]:
        """The proposals, in words."""
        return [
            f"{self._option(one)}: {self.component}.{one.name} may be {self.component}.{one.port} ({'; '.join(one.reasons)})"
            for one in self.proposals
        ]

    def _option(self, found: Proposal) -> str:
        return f"--map {self.component}.{found.port}={found.name}"

    def _port(self, port: str) -> str:
        return f"{self.component}.{port}" if port else self.component


@dataclass(frozen=True)
class Contract:
    """The reports of all swapped components, and why the scenario cannot run with them.

    Parameters
    ----------
    reports : mapping of component name to Report
        Of those of which both sides could be built.
    problems : tuple of str
        Found before the first step.
    failure : str
        Why the start failed; empty: it did not.
    """

    reports: Mapping[str, Report] = field(default_factory=dict)
    problems: tuple[str, ...] = ()
    failure: str = ""

    def check(self) -> None:
        """Stop what cannot run.

        Raises
        ------
        ScenarioError
            With every problem of the scenario, and the ports that may have been meant.
        """
        if self.problems:
            raise ScenarioError("\n".join([*self.problems, *self.hints]))

    @property
    def hints(self) -> list[str]:
        """The proposals of all reports, in words."""
        return [hint for report in self.reports.values() for hint in report.hints]

    @property
    def warnings(self) -> list[tuple[str, str]]:
        """The differences, by component."""
        found = {name: report.differences for name, report in self.reports.items()}
        return [
            (name, f"differs from what it replaces: {text}") for name, text in found.items() if text
        ]


def _agreed(rows: Sequence[ComparedAspect]) -> ComparedAspect:
    """Put into one row what both sides of a port agree in."""
    first, values = rows[0], {row.aspect: row.before for row in rows}
    if not first.port:
        return replace(
            first,
            aspect="as a whole",
            before=", ".join(f"{key} {shown(value)}" for key, value in values.items()),
        )
    text = f"size {values['size']}, {values['type']}" + (
        f" [{values['unit']}]" if values["unit"] else ""
    )
    if first.before == "output":
        text += f", fed through from {shown(values['feedthrough'])}, at first {shown(values['initial output'])}"
    return replace(first, aspect=first.before, before=text)


def shown(value: Any) -> str:
    """Write a value of a row for people."""
    match value:
        case None:
            return "-"
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.6g}"
        case [[_, _], *_]:
            return ", ".join(
                f"{real:.6g}{imaginary:+.6g}i" if imaginary else f"{real:.6g}"
                for real, imaginary in value
            )
        case [*values]:
            return " ".join(map(shown, values)) or "nothing"
        case _:
            return str(value)


def examine(document: Document) -> Contract:
    """Compare every swapped component of a document with what it replaces; nothing runs, and nothing stays open.

    Raises
    ------
    ScenarioError
        If the document cannot be read so far that anything can be built.
    """
    before = _before(document)
    with ExitStack() as resources:
        made = draft(document, resources)
        start, problems, failure = _try(made)
        pairs = {
            name: _renamed(made, name, half)
            for name, half in before.items()
            if name in made.components
        }
        sides = {
            name: _side(
                made, name, start.get(name) or _alone(made, name, before[name], pairs[name])
            )
            for name in pairs
        }
    reports = {
        name: _report(made, name, before[name].side, half.side, pairs[name])
        for name, half in sides.items()
    }
    return Contract(reports, tuple(problems), failure)


InitialSignals = tuple[Vector, Vector]  # inputs and outputs of a component at the start


@dataclass(frozen=True)
class _Half:
    """One side, and what it was started with."""

    side: Side
    inputs: Mapping[str, Vector]
    sources: Mapping[str, str]  # by input, in the whole scenario


def _before(document: Document) -> dict[str, _Half]:
    """Build the scenario as it was before its swaps, as far as it can be built: what is wrong with it does not matter."""
    with ExitStack() as resources, suppress(CosimError):
        names, original = document.unswapped()
        made = draft(original, resources)
        start, _, _ = _try(made)
        return {
            name: _side(made, name, start.get(name)) for name in names if name in made.components
        }
    return {}


def _try(made: Draft) -> tuple[dict[str, InitialSignals], list[str], str]:
    """Start a scenario; give what its components had then, what is wrong with it, and why it could not start."""
    try:
        experiment = finish(made)
    except ScenarioError as error:
        return {}, str(error).splitlines(), ""
    graph, row = experiment.graph, np.zeros(experiment.graph.layout.width)
    try:
        graph.prepare(experiment.clock.step_ns)
        graph.initialize(0.0, row)
    except CosimError as error:
        return {}, [], str(error)
    return (
        {
            channel.name: (row[channel.inputs], row[channel.outputs])
            for channel in graph.layout.channels
        },
        [],
        "",
    )


def _alone(
    made: Draft, name: str, before: _Half, renamed: list[tuple[str, str]]
) -> InitialSignals | None:
    """Start a component whose scenario cannot start, with the inputs that the one before had; others are zero."""
    component, names = made.components[name], dict(renamed)
    columns, u = component.interface.input_columns(), np.zeros(component.interface.n_u)
    for port, values in before.inputs.items():
        at = columns.get(names.get(port, port))
        if at is not None and at.stop - at.start == len(values):
            u[at] = values
    with suppress(CosimError):
        prepare(component, made.clock.step_ns / 1e9, np.zeros(len(u), np.bool_), {})
        return u, component.initialize(0.0, u)
    return None


def _side(made: Draft, name: str, start: InitialSignals | None) -> _Half:
    component, spec = made.components[name], made.scenario.specs[name]
    face, described = component.interface, spec.description(name, made.context)
    inputs, outputs = start or (None, None)
    initial = (
        {} if outputs is None else {port: outputs[at] for port, at in face.output_columns().items()}
    )
    near = _near_start(spec, name, made.context, face)
    side = Side(
        face, _ability(spec, described), start=_starts(described), initial=initial, near_start=near
    )
    driven = (
        {} if inputs is None else {port: inputs[at] for port, at in face.input_columns().items()}
    )
    return _Half(side, driven, {to: wire.label for to, wire in made.scenario.connections.items()})


def _renamed(made: Draft, name: str, before: _Half) -> list[tuple[str, str]]:
    """Give the ports that the map of a swap renames: its own by their names, the inputs it drives by the output behind them."""
    ports = {port: new for port, new in made.scenario.file.swap[name].map.items()}
    found = {
        (port if port.startswith(f"{name}.") else before.sources.get(port, port)).removeprefix(
            f"{name}."
        ): new
        for port, new in ports.items()
    }
    return list(found.items())


def _ability(spec: Kind, described: tuple[InterfaceType, Description] | None) -> Ability:
    if described is None:
        return Ability(spec.kind)
    interface_type, description = described
    able = description.capabilities[interface_type]
    exchange = interface_type == "me"  # there our solver steps, on straight lines
    return Ability(
        INTERFACE_TYPE_NAMES[interface_type],
        rollback=able.saves_state,
        variable_step=exchange or able.variable_step,
        interpolation=exchange or able.interpolates_inputs,
        directional_derivatives=able.directional_derivatives,
    )


def _starts(described: tuple[InterfaceType, Description] | None) -> dict[str, Vector]:
    """Give the start values of the inputs that have them."""
    if described is None:
        return {}
    ports = {signal.name: [v.start for v in group] for signal, group in described[1].ports("input")}
    return {
        name: np.concatenate([np.array(start, np.float64) for start in starts if start is not None])
        for name, starts in ports.items()
        if None not in starts
    }


def _near_start(spec: Kind, name: str, context: BuildContext, face: Interface) -> NearStart | None:
    """Give poles and static gain of a component; None: it is not linear, and does not linearize."""
    try:
        system = spec.linear_system(name, context)
    except (CosimError, ValueError):
        return None
    if system is None:
        return None
    found = NearStart.of(system)
    whole = found.gain is not None and found.gain.shape == (
        face.n_y,
        face.n_u,
    )  # else some ports are not continuous
    return found if whole else replace(found, gain=None)


def _report(
    made: Draft, name: str, before: Side, after: Side, renamed: list[tuple[str, str]]
) -> Report:
    pairs = pairs_of(before, after, renamed)
    connected = _connected(made, name)
    rows = compare_sides(before, after, pairs, connected=connected, refused=_refused(made, name))
    missing = [old for old, new in pairs if old is not None and new is None and old in connected]
    return Report(name, rows, propose(before, after, pairs, missing))


def _connected(made: Draft, name: str) -> set[str]:
    """Give the ports of a component that the scenario names."""
    truth = made.scenario.file.truth
    named = [
        *made.scenario.connections,
        *(str(port) for wire in made.scenario.connections.values() for port in wire.sources),
    ]
    named += [*truth, *(true for true in truth.values() if isinstance(true, str))]
    return _own(named, name)


def _refused(made: Draft, name: str) -> set[str]:
    """Give the ports of a component at connections, or in truths, that stop the run."""
    wires, truth = made.scenario.connections, made.scenario.file.truth
    named: list[str] = []
    for key, _ in made.problems:
        port = str(key[-1])
        if key[:1] == ("connections",):
            named += [port, *(map(str, wires[port].sources) if port in wires else [])]
        elif key[:1] == ("truth",):
            named += [port, str(truth.get(port))]
    return _own(named, name)


def _own(ports: Iterable[str], name: str) -> set[str]:
    """Keep the ports of a component, without its name; of an element the whole signal too."""
    own = [port.partition(".")[2] for port in ports if port.partition(".")[0] == name]
    return {form for port in own for form in (port, re.sub(r"\[\d+\]$", "", port))}
