"""Where a replay has each component of a scenario from: computed, copied from the log, or absent.

Of a whole log everything is computed that rests on nothing but the log, or what of it was chosen;
the rest is copied.

Of a partial log a component is computed where every one of its inputs comes from a component that
is computed, or from an output that the log has at each step. That is an output which was recorded,
or one that drives an input as it is, without gain, offset or conversion, which was recorded, and in
which no fault stood. A component that cannot be computed is copied with those outputs that the log
has; one of which it has none is left out, with what it drives.

Components of a loop advance together: where one of them is copied, the others can only be computed
if all of them were recorded whole, as in a log that is not partial.

What is computed so has the bits of the run. Beginning with all that could be computed, components
are taken out until these conditions hold for each of the others.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from typing import Final, TypeAlias, final

import numpy as np

from cosim.arrays import as_columns
from cosim.core.contracts import Block
from cosim.core.port import Port, named_ports
from cosim.core.recorded.partial import PartialRecord, partial_layout, partial_of
from cosim.core.recorded.run import RecordedRun
from cosim.core.recorders import Memory
from cosim.core.recording import Plan
from cosim.core.signals import Layout
from cosim.core.structure.cycles import strongly_connected
from cosim.errors import LogError, UsageError, command, flag, listing, nearest, quoted
from cosim.instants import step_seconds
from cosim.log.metadata import json_table
from cosim.scenario.kinds import Kind
from cosim.scenario.kinds.base import Scenario

_NOT_RECORDED: Final = "which is neither computed nor recorded at each step"
_OF_OUTPUTS: Final = ("jump", "follow")  # causes of events that change no input

# where a log has the signals of a component: the name of each there, itself or an input that it
# drives as it is; and of whose rows every so many are its own
_Columns: TypeAlias = dict[str, tuple[str, int]]


@dataclass(frozen=True, slots=True)
class ReplayedPart:
    """Where a replay has each component from; all that are neither copied nor absent are computed.

    Parameters
    ----------
    scenario : Scenario
        Without the components that are absent, and connections from and to these.
    recording : RecordedRun
        What is copied; of a partial log with those signals of them that it has.
    copied : tuple of str
    absent : mapping of component name to str
        Why it is neither copied nor computed.
    uncomputed : mapping of component name to str
        Why components cannot be computed that could from a whole log; copied or absent.
    """

    scenario: Scenario
    recording: RecordedRun
    copied: tuple[str, ...]
    absent: Mapping[str, str] = field(default_factory=dict)
    uncomputed: Mapping[str, str] = field(default_factory=dict)

    @property
    def left_out(self) -> tuple[str, ...]:
        """The copied components that can be computed from a whole log."""
        specs = self.scenario.specs
        return tuple(name for name in self.copied if specs[name].computable)


def replayed_part(
    source: RecordedRun, scenario: Scenario, chosen: Sequence[str] | None
) -> ReplayedPart:
    """Decide where a replay has each component from.

    Parameters
    ----------
    source : RecordedRun
    scenario : Scenario
        Of the replay; a table says whether its component can be computed.
    chosen : sequence of str or None
        The only components to compute; None: all that can be.

    Raises
    ------
    UsageError
        If one of the components that were chosen does not exist or cannot be computed.
    LogError
        If nothing can be computed from a partial log.
    """
    specs = scenario.specs
    computable = [name for name, spec in specs.items() if spec.computable]
    for name in chosen or ():
        if name not in specs:
            raise UsageError(f"the log has no component {quoted(name)}; {nearest(name, specs)}")
        if name not in computable:
            reason = way_out(specs[name]) or "its file is not part of the log"
            raise UsageError(
                f"{name!r} cannot be computed, as a replay takes it from the log: {reason}; "
                f"available: {listing(computable, 100)}"
            )
    wanted = set(computable if chosen is None else chosen)
    partial = partial_of(source.channels)
    if partial is None:
        return ReplayedPart(scenario, source, tuple(name for name in specs if name not in wanted))
    part = _PartSearch(source, partial, scenario, wanted).part()
    for name in chosen or ():
        if name in part.uncomputed:
            raise UsageError(
                f"{name!r} cannot be computed: {part.uncomputed[name]}; the log is partial, it was "
                f"recorded with {partial.selection}"
            )
    return part


def way_out(spec: Kind) -> str:
    """Return how a component is computed that a replay takes from the log; empty: not at all."""
    if spec.computable:
        return "compute this component, too"
    if spec.code is not None:
        return f"allow its code to run with {flag('allow_code')}"
    return f"compute it, too: {command('replay')} with {flag('rerun')}" if spec.is_rerun else ""


@final
class _PartSearch:
    """Takes out components until all others can be computed from a partial log."""

    def __init__(
        self,
        run: RecordedRun,
        partial: PartialRecord,
        scenario: Scenario,
        wanted: Collection[str],
    ) -> None:
        self._run = run
        self._partial = partial
        self._scenario = scenario
        self._sources: dict[Port, list[Port]] = {}  # by whole input
        for to, connection in scenario.connections.items():
            self._sources.setdefault(to.whole, []).extend(connection.sources)
        self._inputs: dict[str, list[Port]] = {}  # that are connected, by component
        for to in self._sources:
            self._inputs.setdefault(to.component, []).append(to)
        members = strongly_connected(scenario.drivers)
        loops: dict[str, set[str]] = {}
        for name, loop in members.items():
            loops.setdefault(loop, set()).add(name)
        self._loops = {name: loops[loop] for name, loop in members.items()}
        self._columns = self._recorded_columns()
        self._computed = set(wanted)
        self._kept = set(self._sources)  # inputs whose sources are all there
        self._reasons: dict[str, str] = {}

    # --- what the log has ---

    def _recorded_columns(self) -> dict[str, _Columns]:
        """Return the signals that the log has at each of their steps, by component."""
        declared = self._partial.declared
        recorded = self._run.channels
        columns: dict[str, _Columns] = {name: {} for name in declared}
        for name, channel in recorded.items():
            if channel.period == declared[name].period:
                columns[name] = {s.name: (f"{name}.{s.name}", 1) for s in channel.signals}
        for source, to in self._driven_as_they_are():
            driven = recorded.get(to.component)
            if driven is None or to.signal not in driven.by_name:
                continue
            is_inside = to.component in self._loops.get(source.component, ())
            stride, rest = divmod(declared[source.component].period, driven.period)
            if not is_inside and not rest:
                columns[source.component].setdefault(source.signal, (str(to), stride))
        return columns

    def _driven_as_they_are(self) -> Iterator[tuple[Port, Port]]:
        """Yield whole outputs, and the inputs that had in the run what these gave."""
        events = self._run.events()
        faulty = {Port.parse(e.signal).whole for e in events if e.cause not in _OF_OUTPUTS}
        for text, connection in self._run.metadata.get("cosim.connections", {}).items():
            to = Port.parse(text)
            table = json_table(connection)
            is_plain = table.get("gain") == 1.0 and table.get("offset") == 0.0
            names = str(table.get("from"))
            if is_plain and "conversions" not in table and "," not in names:
                source = Port.parse(names)
                is_whole = source.whole == source and to.whole == to
                if is_whole and to not in faulty and source.component in self._partial.declared:
                    yield source, to

    # --- what follows from it ---

    def _settle(self) -> None:
        """Take out inputs and components until nothing changes."""
        size = -1
        while size != len(self._kept) + len(self._computed):
            size = len(self._kept) + len(self._computed)
            for to in sorted(self._kept, key=str):
                if self._missing_source(to) is not None or self._closes_copied_loop(to):
                    self._kept.discard(to)
            for name in sorted(self._computed):
                reason = self._obstacle(name)
                if reason:
                    self._computed.discard(name)
                    self._reasons[name] = reason

    def _closes_copied_loop(self, to: Port) -> bool:
        """Return whether an input closes a loop of which nothing is computed."""
        loop = self._loops[to.component]
        is_copied = loop.isdisjoint(self._computed)
        return is_copied and any(source.component in loop for source in self._sources[to])

    def _missing_source(self, to: Port) -> Port | None:
        """Return a source of an input that is neither computed nor copied."""
        return next((source for source in self._sources[to] if not self._is_there(source)), None)

    def _is_there(self, source: Port) -> bool:
        """Return whether an output is computed, or can be copied."""
        name = source.component
        if name in self._computed:
            return True
        if name not in self._columns:
            return False
        match = source.find(self._partial.declared[name].by_name)
        if match is None or match[0].name not in self._columns[name]:
            return False
        # how it changes between steps follows from all inputs
        return match[0].variability != "inherited" or self._has_all_inputs(name)

    def _has_all_inputs(self, name: str) -> bool:
        """Return whether all connected inputs of a component are there."""
        return self._kept.issuperset(self._inputs.get(name, ()))

    def _obstacle(self, name: str) -> str:
        """Return why a component cannot be computed; empty: it can."""
        for to in self._inputs.get(name, ()):
            if to not in self._kept:
                return f"its input '{to}' comes from '{self._missing_source(to)}', {_NOT_RECORDED}"
        loop = self._loops[name]
        copied = loop - self._computed
        for other in sorted(loop) if copied else ():
            is_whole = self._partial.is_whole(other, self._run.channels)
            if not is_whole or (other in copied and not self._has_all_inputs(other)):
                if other in copied:
                    return f"it is in a loop with {other!r}, which is not recorded completely"
                return (
                    f"it is in a loop with {min(copied)!r}, which is copied, and {other!r} is not "
                    "recorded completely"
                )
        return ""

    # --- the result ---

    def part(self) -> ReplayedPart:
        """Return what the replay has."""
        self._settle()
        if not self._computed:
            reasons = "".join(f"; {name}: {reason}" for name, reason in self._reasons.items())
            raise LogError(
                f"{self._run.label}: no component can be computed: the log is partial, it was "
                f"recorded with {self._partial.selection}{reasons}"
            )
        absent = {}
        shown: dict[str, set[str]] = {}  # the signals of copied components that are in the replay
        for name in self._scenario.specs:
            own = set() if name in self._computed else self._shown(name)
            if own:
                shown[name] = own
            elif name not in self._computed:
                reason = self._reasons.get(name, "a replay takes it from the log")
                absent[name] = f"{reason}; the log has no output of it at every step"
        return ReplayedPart(
            self._reduced(absent, shown), self._copied(shown), tuple(shown), absent, self._reasons
        )

    def _shown(self, name: str) -> set[str]:
        """Return the signals of a copied component that are in the replay; empty: it is absent.

        Outputs that can be copied, inputs that are driven, or recorded and undriven.
        """
        declared = self._partial.declared.get(name)
        if declared is None:
            return set()
        outputs = [signal.name for signal in declared.interface.outputs]
        shown = {signal for signal in outputs if self._is_there(Port(name, signal))}
        for signal in declared.interface.input_names if shown else ():
            port = Port(name, signal)
            is_undriven = port not in self._sources
            if port in self._kept or (is_undriven and signal in self._columns[name]):
                shown.add(signal)
        return shown

    def _reduced(self, absent: Collection[str], shown: Mapping[str, Set[str]]) -> Scenario:
        """Return the scenario of what is here."""
        scenario = self._scenario
        specs = {name: spec for name, spec in scenario.specs.items() if name not in absent}
        connections = {}
        for to, connection in scenario.connections.items():
            if to.component in specs and to.whole in self._kept:
                connections[to] = connection

        def is_known(port: Port) -> bool:
            name = port.component
            own = shown.get(name)
            return own is None or (port.signal in own and port.signal in self._columns[name])

        truth = {}
        for estimate, true in scenario.file.truth.items():
            if all(map(is_known, map(Port.parse, (estimate, *named_ports(true))))):
                truth[estimate] = true
        file = scenario.file.model_copy(update={"truth": truth})
        return replace(scenario, specs=specs, connections=connections, file=file)

    def _copied(self, shown: Mapping[str, Set[str]]) -> Memory:
        """Return the rows of copied components; NaN where an input is not recorded.

        Raises
        ------
        LogError
            If the log does not have all rows of one.
        """
        run = self._run
        partial = self._partial
        layout, _ = partial_layout(Layout(tuple(partial.declared.values())), shown, every=1)
        memory = _CopiedRows(run)
        memory.begin(Plan(layout, run.step_ns, {}, run.held, (), partial))
        numbers = np.arange(run.steps + 1)
        rows = np.full((len(numbers), layout.width), np.nan)
        for channel in layout.channels:
            needed = len(numbers[:: channel.period])
            for signal, columns in channel.signal_columns.items():
                if signal not in self._columns[channel.name]:
                    continue
                name, stride = self._columns[channel.name][signal]
                own = as_columns(run[name])[::stride]
                if len(own) != needed:
                    raise LogError(
                        f"{run.label}: expected {needed} rows of {name!r}, got {len(own)}"
                    )
                rows[:: channel.period, columns] = own
        grid = run.grid
        memory.write(
            Block(0, grid.stamp(numbers), grid.time(numbers), step_seconds(run.step_ns)), rows
        )
        for event in run.events():
            port = Port.parse(event.signal)
            if port.signal in shown.get(port.component, ()):
                memory.event(event)
        return memory


class _CopiedRows(Memory):
    """What a partial log has of the components that are taken from it."""

    def __init__(self, run: RecordedRun) -> None:
        super().__init__(run.metadata)
        self._run = run

    @property
    def label(self) -> str:
        """That of the log."""
        return self._run.label
