"""The events of a log for the jumps at a communication point."""

from __future__ import annotations

from collections.abc import Mapping

from cosim.core.port import Port
from cosim.core.recording import EventCause, SignalEvent
from cosim.core.signals import Layout
from cosim.core.stages.overrides import ActiveFault
from cosim.core.stepping.jumps import Jumps, OverridableInput, overridden_columns


def events_of(jumps: Jumps, layout: Layout, t_ns: int) -> list[SignalEvent]:
    """Return what was set, overridden or released at ``t_ns`` [ns], then what followed."""
    events = _own_events(jumps, t_ns)
    own = {jumps.input(event.signal).whole for event in events}
    settings = [SignalEvent(t_ns, *setting) for setting in jumps.settings]
    events = settings + events
    for channel in layout.channels:
        if jumps.row[channel.columns].tobytes() == jumps.left_row[channel.columns].tobytes():
            continue
        for name, columns in channel.signal_columns.items():
            before = jumps.left_row[columns]
            values_now = jumps.row[columns]
            is_own = Port(channel.name, name) in own
            if not is_own and before.tobytes() != values_now.tobytes():
                values = tuple(values_now.tolist())
                events.append(SignalEvent(t_ns, "follow", f"{channel.name}.{name}", values))
    return events


def _own_events(jumps: Jumps, t_ns: int) -> list[SignalEvent]:
    """Return overrides and releases that lead from those before to those now.

    They are not always those that were asked for: who releases at the same point what he has
    overridden there has changed nothing.
    """
    by_input: dict[Port, list[tuple[OverridableInput, EventCause]]] = {}
    for changed, cause in jumps.changes.items():
        by_input.setdefault(changed.whole, []).append((changed, cause))
    events: list[SignalEvent] = []
    for whole, changes in by_input.items():
        changed, cause = changes[0]
        before = jumps.overridden_before[whole]
        is_partly = cause == "release" and not before.keys() >= set(changed.numbers)
        if len(changes) > 1 or is_partly:
            events += _net_events(jumps, t_ns, changed, before)
        else:
            events.append(_event(jumps, t_ns, cause, changed))
    return events


def _net_events(
    jumps: Jumps,
    t_ns: int,
    changed: OverridableInput,
    before: Mapping[int, ActiveFault | None],
) -> list[SignalEvent]:
    """Return the events of an input by its elements, or as a whole where they are alike."""
    now = overridden_columns(changed)
    causes: dict[int, EventCause] = dict.fromkeys(sorted(before.keys() - now.keys()), "release")
    for column, active in now.items():
        is_same = column in before and before[column] is active
        if not is_same or (active is None and not _keeps(jumps, column)):
            causes[column] = "override" if active is None else active.fault.kind
    whole = jumps.input(str(changed.whole))
    if len(causes) == len(whole.numbers) and len(set(causes.values())) == 1:
        return [_event(jumps, t_ns, causes[whole.numbers[0]], whole)]
    first = changed.member.columns.start
    events = []
    for column, cause in causes.items():
        element = jumps.input(changed.member.label(column - first))
        events.append(_event(jumps, t_ns, cause, element))
    return events


def _keeps(jumps: Jumps, column: int) -> bool:
    """Return whether a value has the bits that it had before."""
    return bool(jumps.row[column].tobytes() == jumps.left_row[column].tobytes())


def _event(jumps: Jumps, t_ns: int, cause: EventCause, changed: OverridableInput) -> SignalEvent:
    values = tuple(jumps.row[changed.columns].tolist())
    parameters: list[float] = []
    for column in changed.numbers:
        active = changed.member.overrides.faults.get(column)
        if active is not None:
            parameters += active.fault.parameters
    return SignalEvent(t_ns, cause, changed.name, values, tuple(parameters))
