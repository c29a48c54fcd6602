"""Which components of a scenario a replay of a partial log can compute, copy, or neither.

A component is computed where every one of its inputs comes from a component that is computed, or
from an output that the log has at each step. That is an output which was recorded, or one that
drives an input as it is, without gain, offset or conversion, which was recorded, and in which no
fault stood. A component that cannot be computed is copied with those outputs that the log has; one
of which it has none is left out, with what it drives.

Components of a loop advance together: where one of them is copied, the others can only be computed
if all of them were recorded whole, as in a log that is not partial.

What is computed so has the bits of the run. Beginning with all that could be computed, components
are taken out until these conditions hold for each of the others.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Final, final

from cosim.core.connections import Connection
from cosim.core.port import Port, named_ports
from cosim.core.recorded.partial import PartialRecord, RecordSelection, partial_of
from cosim.core.recording import CompleteRecording
from cosim.core.signals import Channel
from cosim.core.structure.cycles import strongly_connected
from cosim.errors import LogError
from cosim.log.contents.metadata import json_table
from cosim.scenario.building.parsing import Scenario
from cosim.scenario.recordings.outputs_of_log import OutputsOfLog, RecordedColumns

_NOT_RECORDED: Final = "which is neither computed nor recorded at each step"
_OF_OUTPUTS: Final = ("jump", "follow")  # causes of events that change no input


@dataclass(frozen=True, slots=True)
class ReplayedPart:
    """What a replay has of a partial log.

    Parameters
    ----------
    scenario : Scenario
        Without the components that are left out, and connections from and to these.
    recording : OutputsOfLog
        What is copied.
    copied : tuple of str
    absent : mapping of component name to str
        Why it is left out.
    uncomputed : mapping of component name to str
        Why components cannot be computed that could from a whole log; copied or left out.
    selection : RecordSelection
        With which the log was recorded.
    """

    scenario: Scenario
    recording: OutputsOfLog
    copied: tuple[str, ...]
    absent: Mapping[str, str]
    uncomputed: Mapping[str, str]
    selection: RecordSelection


def replayed_part(
    run: CompleteRecording, scenario: Scenario, *, left_out: Collection[str]
) -> ReplayedPart:
    """Return what a replay has of a partial log.

    Parameters
    ----------
    run : CompleteRecording
        The log; it is partial.
    scenario : Scenario
    left_out : collection of str
        Components that are not to be computed.

    Raises
    ------
    LogError
        If nothing can be computed; says why.
    """
    partial = partial_of(run.channels)
    assert partial is not None, "of a whole log all can be replayed"
    search = _PartSearch(run, partial, scenario, left_out)
    search.settle()
    return search.part()


@final
class _PartSearch:
    """Takes out components until all others can be computed."""

    def __init__(
        self,
        run: CompleteRecording,
        partial: PartialRecord,
        scenario: Scenario,
        left_out: Collection[str],
    ) -> None:
        self._run = run
        self._partial = partial
        self._scenario = scenario
        self._left_out = left_out
        self._inputs: dict[Port, list[Connection]] = {}  # by whole input
        for to, connection in scenario.connections.items():
            self._inputs.setdefault(to.whole, []).append(connection)
        self._loops = self._loop_members()
        self._columns = self._recorded_columns()
        specs = scenario.specs
        names = [name for name, spec in specs.items() if spec.computable and name not in left_out]
        self._computed = set(names)
        self._kept: set[Port] = set(self._inputs)  # inputs whose sources are all there
        self._reasons: dict[str, str] = {}

    def _loop_members(self) -> dict[str, frozenset[str]]:
        """Return the components of the loop that each component is in; its own name: of none."""
        drivers: dict[str, set[str]] = {name: set() for name in self._scenario.specs}
        for to, connections in self._inputs.items():
            for connection in connections:
                drivers[to.component].update(port.component for port in connection.sources)
        representatives = strongly_connected(drivers)
        loops: dict[str, set[str]] = {}
        for name, representative in representatives.items():
            loops.setdefault(representative, set()).add(name)
        return {name: frozenset(loops[own]) for name, own in representatives.items()}

    # --- what the log has ---

    def _recorded_columns(self) -> dict[str, dict[str, RecordedColumns]]:
        """Return the signals that the log has at each of their steps, by component."""
        columns: dict[str, dict[str, RecordedColumns]] = {}
        for name, declared in self._partial.declared.items():
            channel = self._run.channels.get(name)
            if channel is not None and channel.period == declared.period:
                own = {s.name: RecordedColumns(name, s.name, 1) for s in channel.signals}
                columns[name] = own
        for source, inputs in self._driven_as_they_are().items():
            own = columns.setdefault(source.component, {})
            for to in inputs:
                found = self._of_input(source, to)
                if found is not None:
                    own.setdefault(source.signal, found)
        return columns

    def _driven_as_they_are(self) -> dict[Port, list[Port]]:
        """Return the inputs that had in the run what whole outputs gave, by output."""
        faulty = {
            Port.parse(event.signal).whole
            for event in self._run.events()
            if event.cause not in _OF_OUTPUTS
        }
        driven: dict[Port, list[Port]] = {}
        for text, connection in self._run.metadata.get("cosim.connections", {}).items():
            to = Port.parse(text)
            table = json_table(connection)
            is_plain = table.get("gain") == 1.0 and table.get("offset") == 0.0
            if not is_plain or "conversions" in table or to.whole != to or to in faulty:
                continue
            names = str(table.get("from"))
            if "," not in names:
                source = Port.parse(names)
                if source.whole == source:
                    driven.setdefault(source, []).append(to)
        return driven

    def _of_input(self, source: Port, to: Port) -> RecordedColumns | None:
        """Return where the log has an output as an input that it drives; None: it has not."""
        declared = self._partial.declared
        channel = self._run.channels.get(to.component)
        if channel is None or to.signal not in channel.by_name or source.component not in declared:
            return None
        period = declared[source.component].period
        is_inside = to.component in self._loops.get(source.component, ())
        if is_inside or period % channel.period:
            return None
        return RecordedColumns(to.component, to.signal, period // channel.period)

    # --- what follows from it ---

    def settle(self) -> None:
        """Take out inputs and components until nothing changes."""
        size = -1
        while size != len(self._kept) + len(self._computed):
            size = len(self._kept) + len(self._computed)
            self._settle_inputs()
            for name in sorted(self._computed):
                reason = self._obstacle(name)
                if reason:
                    self._computed.discard(name)
                    self._reasons[name] = reason

    def _settle_inputs(self) -> None:
        for to in sorted(self._kept, key=str):
            if self._missing_source(to) is not None or self._closes_copied_loop(to):
                self._kept.discard(to)

    def _closes_copied_loop(self, to: Port) -> bool:
        """Return whether an input closes a loop of which nothing is computed."""
        loop = self._loops[to.component]
        if len(loop) == 1 or not loop.isdisjoint(self._computed):
            return False
        for connection in self._inputs[to]:
            if any(source.component in loop for source in connection.sources):
                return True
        return False

    def _missing_source(self, to: Port) -> Port | None:
        """Return a source of an input that is not there."""
        for connection in self._inputs[to]:
            for source in connection.sources:
                if not self._is_there(source):
                    return source
        return None

    def _is_there(self, source: Port) -> bool:
        """Return whether an output is computed, or can be copied."""
        name = source.component
        if name in self._computed:
            return True
        declared = self._partial.declared.get(name)
        match = None if declared is None else source.find(declared.by_name)
        if declared is None or match is None:
            return False
        signal, _ = match
        if signal.name not in self._columns.get(name, {}):
            return False
        # how it changes between steps follows from all inputs
        return signal.variability != "inherited" or self._has_all_inputs(declared)

    def _has_all_inputs(self, channel: Channel) -> bool:
        """Return whether all connected inputs of a component are there."""
        ports = [Port(channel.name, signal.name) for signal in channel.interface.inputs]
        return all(port in self._kept for port in ports if port in self._inputs)

    def _obstacle(self, name: str) -> str:
        """Return why a component cannot be computed; empty: it can."""
        for to in self._inputs:
            if to.component == name and to not in self._kept:
                return f"its input '{to}' comes from '{self._missing_source(to)}', {_NOT_RECORDED}"
        loop = self._loops[name]
        for other in sorted(loop - self._computed):
            declared = self._partial.declared.get(other)
            is_whole = self._partial.is_whole(other, self._run.channels)
            if declared is None or not is_whole or not self._has_all_inputs(declared):
                return f"it is in a loop with {other!r}, which is not recorded completely"
            if not self._partial.is_whole(name, self._run.channels):
                return (
                    f"it is in a loop with {other!r}, which is copied, and is not recorded "
                    "completely"
                )
        return ""

    # --- the result ---

    def part(self) -> ReplayedPart:
        """Return what the replay has.

        Raises
        ------
        LogError
            If nothing is computed.
        """
        specs = self._scenario.specs
        columns: dict[str, dict[str, RecordedColumns]] = {}
        inputs: dict[str, frozenset[str]] = {}
        absent: dict[str, str] = {}
        for name in specs:
            if name in self._computed:
                continue
            outputs = self._copied_outputs(name)
            if not outputs:
                reason = self._reasons.get(name, "a replay takes it from the log")
                absent[name] = f"{reason}; the log has no output of it at every step"
                continue
            inputs[name] = self._inputs_of(name)
            shown = {*inputs[name], *outputs}
            own = self._columns[name].items()
            columns[name] = {signal: place for signal, place in own if signal in shown}
        if not self._computed:
            reasons = "".join(f"; {name}: {reason}" for name, reason in self._reasons.items())
            raise LogError(
                f"{self._run.label}: no component can be computed: the log is partial, it was "
                f"recorded with {self._partial.selection}{reasons}"
            )
        return ReplayedPart(
            self._reduced(absent, columns),
            OutputsOfLog(self._run, self._partial, columns, inputs),
            tuple(columns),
            absent,
            dict(self._reasons),
            self._partial.selection,
        )

    def _copied_outputs(self, name: str) -> list[str]:
        """Return the outputs of a component that can be copied."""
        declared = self._partial.declared.get(name)
        if declared is None:
            return []
        outputs = [signal.name for signal in declared.interface.outputs]
        return [output for output in outputs if self._is_there(Port(name, output))]

    def _inputs_of(self, name: str) -> frozenset[str]:
        """Return the inputs of a copied component that are driven, or recorded and undriven."""
        recorded = self._columns[name]
        names = set()
        for signal in self._partial.declared[name].interface.inputs:
            port = Port(name, signal.name)
            is_driven = port in self._kept
            if is_driven or (port not in self._inputs and signal.name in recorded):
                names.add(signal.name)
        return frozenset(names)

    def _reduced(
        self, absent: Collection[str], columns: Mapping[str, Mapping[str, RecordedColumns]]
    ) -> Scenario:
        """Return the scenario of what is here."""
        scenario = self._scenario
        specs = {name: spec for name, spec in scenario.specs.items() if name not in absent}
        connections = {}
        for to, connection in scenario.connections.items():
            if to.component in specs and to.whole in self._kept:
                connections[to] = connection
        truth = {}
        for estimate, true in scenario.file.truth.items():
            ports = [Port.parse(text) for text in (estimate, *named_ports(true))]
            if all(_has(columns, port) for port in ports):
                truth[estimate] = true
        file = scenario.file.model_copy(update={"truth": truth})
        return replace(scenario, specs=specs, connections=connections, file=file)


def _has(columns: Mapping[str, Mapping[str, RecordedColumns]], port: Port) -> bool:
    """Return whether a signal is computed, or copied."""
    return port.component not in columns or port.signal in columns[port.component]
