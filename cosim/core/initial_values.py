"""The start: initial values of all inputs and outputs of a graph, found together (FMI 2.0.4 section 2.2.8, InitialUnknowns).

At the start an output may depend on more inputs than later, because the state may follow them
(:meth:`cosim.core.signals.Interface.feeds_at_start`). The ports are taken in the order of these dependencies: an input when the
output that drives it is defined, an output when the inputs it depends on are. A component is initialized again whenever inputs of
it have come to be known; until then they have their start values.

Ports that depend on each other form a *circle*. It is torn at some of its inputs, v; one sweep along the rest of it gives them
back as w(v), and w(v) = v is solved (:mod:`cosim.core.fixed_point`):

1. by sweeps, as many as the circle has ports. They settle where in truth there is no circle: dependencies that are unknown count
   as there. Where a signal is discrete, sweeps are all that is tried;
2. else by Newton's method from the start values, until the residual no longer falls;
3. the residual is held against the values, and 1 - w' must be regular: else the start is not determined.

At the end every input is what its connection gives, and every component was initialized with its inputs. Only the outputs of a
component at whose inputs a circle was torn belong to v, which is as far from the recorded input as the residual.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from graphlib import TopologicalSorter
from itertools import pairwise
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Vector
from cosim.core.coupling import Member, Wire
from cosim.core.fixed_point import Found, SingularError, judge, newton, newton_step, settle
from cosim.core.order import Behind, Port, cycles, find_cycle
from cosim.core.signals import Channel, Interface, Layout
from cosim.errors import GraphError

SWEEPS: Final = 100  # of a circle with discrete signals, beyond one a port

Columns: TypeAlias = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class Circle:
    """Ports that depend on each other at the start.

    Parameters
    ----------
    order : tuple of Port
        In the order of a sweep; the torn inputs come last.
    torn : tuple of str
        The torn inputs, named once for each of their elements.
    columns : integer array
        Of these elements, in the row.
    optional : bool array
        Which of them may have no value (NaN).
    discrete : bool
        A signal in it is not a continuous real number.
    path : str
        Every port of it, for messages.
    """

    order: tuple[Port, ...]
    torn: tuple[str, ...]
    columns: Columns
    optional: Mask
    discrete: bool
    path: str


class InitialValues:
    """The order in which a graph starts, fixed by its structure.

    Parameters
    ----------
    layout : Layout
    members : mapping of component name to Member
    sources : mapping of component name to mapping of input to Port
        What drives each input.
    """

    def __init__(
        self,
        layout: Layout,
        members: Mapping[str, Member],
        sources: Mapping[str, Mapping[str, Port]],
    ) -> None:
        self.layout, self.members = layout, members
        self.columns = {
            (c.name, signal.name): columns
            for c in layout.channels
            for signal, columns in c.signal_columns()
        }
        self.wires = {port: wire for port, wire in _wires(layout, members)}
        behind = _behind(layout.channels, sources)
        cycle_of, groups = cycles(behind), dict[Port, list[Port]]()
        for port, circle in cycle_of.items():
            groups.setdefault(circle, []).append(port)
        between = {
            circle: {cycle_of[b] for p in ports for b in behind[p]} - {circle}
            for circle, ports in groups.items()
        }
        self.order = [
            port if len(groups[port]) == 1 else self._circle(sorted(groups[port]), behind)
            for port in _inputs_first(between, self.wires.keys())
        ]
        in_circles = {
            port for step in self.order if isinstance(step, Circle) for port in step.order
        }
        self.last = [
            port for port in self.columns if port not in self.wires and port not in in_circles
        ]

    def _circle(self, ports: list[Port], behind: Behind) -> Circle:
        interfaces = {channel.name: channel.interface for channel in self.layout.channels}
        inside: dict[Port, list[Port]] = {
            port: sorted(set(behind[port]) & set(ports)) for port in ports
        }
        path, torn = find_cycle(inside), []
        while circle := find_cycle(inside):
            torn.append(_weakest(circle, interfaces))
            inside[torn[-1]] = []
        torn.sort()
        signals = {
            (c.name, s.name): s
            for c in self.layout.channels
            for s in c.signals
            if (c.name, s.name) in inside
        }
        return Circle(
            order=(
                *(port for port in TopologicalSorter(inside).static_order() if port not in torn),
                *torn,
            ),
            torn=tuple(_name(port) for port in torn for _ in range(signals[port].size)),
            columns=np.concatenate(
                [np.arange(self.layout.width)[self.columns[port]] for port in torn]
            ),
            optional=np.repeat(
                [signals[port].optional for port in torn], [signals[port].size for port in torn]
            ),
            discrete=any(
                signal.kind != "real" or signal.variability == "discrete"
                for signal in signals.values()
            ),
            path=" -> ".join(map(_name, path))
            if set(path) == set(ports)
            else ", ".join(map(_name, ports)),
        )

    def find(self, t: float, row: Vector) -> None:
        """Fill the first row, shape (width,).

        Raises
        ------
        GraphError
            If a circle has no solution, more than one, or none that was found; if outputs depend on more than their components
            say, and do not settle all the same.
        """
        for channel in self.layout.channels:
            for signal in channel.interface.inputs:
                row[self.columns[channel.name, signal.name]] = signal.start or 0.0
        values, rounds = _Values(self, t, row), len(self.members) + 2
        for _ in range(rounds):
            before = row.copy()
            with np.errstate(
                over="ignore", invalid="ignore", divide="ignore"
            ):  # what is not finite is named later
                values.fill()
            if before.tobytes() == row.tobytes():
                return
        moving = [
            _name(port)
            for port, at in self.columns.items()
            if before[at].tobytes() != row[at].tobytes()
        ]
        raise GraphError(
            f"initial values do not settle: {', '.join(moving)} still change after {rounds} rounds; an output there depends at "
            "the start on an input that its component does not declare (FMI: InitialUnknowns); declare it, or none at all"
        )


class _Values:
    """The first row while it is found, and what each component was last initialized with."""

    def __init__(self, start: InitialValues, t: float, row: Vector) -> None:
        self._start, self._t, self._row = start, t, row
        self._last: dict[str, tuple[bytes, Vector]] = {}
        self._solved: set[str] = set()

    def fill(self) -> None:
        """Go once along the order; in the end no component has inputs that it was not initialized with."""
        for step in self._start.order:
            if isinstance(step, Circle):
                self._solve(step)
            else:
                self._take(step)
        for port in self._start.last:
            self._take(port)
        for name in self._start.members:
            self._initialized(name)

    def _take(self, port: Port) -> None:
        """Bring an input up to date, or an output."""
        if port in self._start.wires:
            self._start.wires[port].copy(self._row[np.newaxis], slice(0, 1))
            return
        columns, first = self._start.columns[port], self._start.members[port[0]].outputs.start
        self._row[columns] = self._initialized(port[0])[
            columns.start - first : columns.stop - first
        ]

    def _initialized(self, name: str) -> Vector:
        """Give the outputs of a component that is initialized with its inputs as they are now."""
        member = self._start.members[name]
        u = self._row[member.inputs].copy()
        bits = u.tobytes()
        if name not in self._last or self._last[name][0] != bits:
            self._last[name] = bits, np.array(member.component.initialize(self._t, u))
        return self._last[name][1]

    # --- circles ---

    def _solve(self, circle: Circle) -> None:
        def sweep(v: Vector) -> Vector:
            self._row[circle.columns] = v
            for port in circle.order:
                self._take(port)
            return self._row[circle.columns].copy()

        kept, v = self._row.copy(), self._row[circle.columns].copy()
        if circle.path in self._solved:
            sweep(v)
            if self._unmoved(circle, kept):
                self._row[:] = kept
                return
        self._solved.add(circle.path)
        found = settle(sweep, v, len(circle.order) + (SWEEPS if circle.discrete else 0))
        try:
            if circle.discrete:
                found = _need_settled(circle, found)
            elif found is None or (np.isnan(found) & ~circle.optional).any():
                found = _need_small(circle, newton(sweep, v, lambda: self._largest(circle)))
            elif np.isfinite(found).all():
                newton_step(sweep, found, found)
        except SingularError as error:
            text = f"1 - w' is singular, with a {_residual(circle, judge(v, sweep(v), self._largest(circle)))}"
            raise GraphError(_unsolved(circle, text)) from error
        sweep(found)

    def _largest(self, circle: Circle) -> float:
        """Give the largest value among the components of a circle."""
        values = np.concatenate(
            [self._row[self._start.layout[name].columns] for name, _ in circle.order]
        )
        return float(np.abs(values[np.isfinite(values)]).max(initial=0.0))

    def _unmoved(self, circle: Circle, kept: Vector) -> bool:
        """Say whether a sweep gave again what is there: nothing that the circle depends on has changed."""
        columns = np.concatenate(
            [
                np.arange(self._start.layout.width)[self._start.columns[port]]
                for port in circle.order
            ]
        )
        return judge(kept[columns], self._row[columns], self._largest(circle)).excess <= 1.0


def _need_settled(circle: Circle, found: Vector | None) -> Vector:
    if found is None:
        sweeps = len(circle.order) + SWEEPS
        raise GraphError(
            _unsolved(
                circle,
                f"with a discrete signal among them, and still changing after {sweeps} sweeps",
            )
        )
    return found


def _need_small(circle: Circle, found: Found) -> Vector:
    if not found.excess <= 1.0:
        raise GraphError(
            _unsolved(circle, f"Newton's method ended with a {_residual(circle, found)}")
        )
    return found.v


def _wires(layout: Layout, members: Mapping[str, Member]) -> Iterable[tuple[Port, Wire]]:
    for channel in layout.channels:
        for signal, wire in zip(channel.interface.inputs, members[channel.name].wires, strict=True):
            yield (channel.name, signal.name), wire


def _behind(
    channels: Iterable[Channel], sources: Mapping[str, Mapping[str, Port]]
) -> dict[Port, tuple[Port, ...]]:
    """Give the ports that each port depends on directly at the start."""
    behind: dict[Port, tuple[Port, ...]] = {}
    for c in channels:
        behind |= {(c.name, signal): (source,) for signal, source in sources[c.name].items()}
        behind |= {
            (c.name, o.name): tuple((c.name, i) for i in c.interface.feeds_at_start(o.name))
            for o in c.interface.outputs
        }
    return behind


def _inputs_first(behind: Behind, inputs: Collection[Port]) -> Iterable[Port]:
    """Order ports by what they depend on, inputs as early as can be, so that components are initialized as seldom as can be."""
    sorter, later = TopologicalSorter(behind), list[Port]()
    sorter.prepare()
    while sorter.is_active():
        ready = sorter.get_ready()
        now = [port for port in ready if port in inputs]
        later += [port for port in ready if port not in inputs]
        if not now:
            now, later = later, []
        yield from now
        sorter.done(*now)


def _weakest(circle: list[Port], interfaces: Mapping[str, Interface]) -> Port:
    """Choose the input where a circle is torn: feedthrough that is unknown, else at the start only, else the first by name."""
    ranked = []
    for (name, signal), (other, output) in pairwise(circle):
        face = interfaces[name]
        if (
            other == name
            and signal in (i.name for i in face.inputs)
            and output in (o.name for o in face.outputs)
        ):
            unknown = face.initial.get(output, face.feedthrough.get(output, ())) is None
            ranked.append(
                (0 if unknown else 1 if signal not in face.feeds(output) else 2, (name, signal))
            )
    return min(ranked)[1]


def _name(port: Port) -> str:
    return ".".join(port)


def _residual(circle: Circle, found: Found) -> str:
    return f"residual of {found.residual:.3g} at {circle.torn[found.element]!r}, needed at most {found.needed:.3g}"


def _unsolved(circle: Circle, why: str) -> str:
    return (
        f"no initial values for {circle.path}, which depend on each other at the start: {why}; give a component among them a "
        "start of its own, such as a lag with start or a delay with initial, or other start values"
    )
