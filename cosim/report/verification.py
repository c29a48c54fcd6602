"""What a replay proves of its log.

Four things, and no more:

* The rows are those that the run recorded: their content hash is the recorded one. That finds every
  change but one by somebody who computes the hash anew.
* The components that were computed again follow, bit for bit, from those that were copied, by the
  scenario and the designs in the log.
* What the log says of its run beside its rows follows from its scenario, as far as a replay
  computes it: see :mod:`cosim.report.statements`.
* Of what was copied (plants, FMUs, files) a replay proves nothing more. Only the run itself, done
  again, does.

Nothing is signed: the log of another run, put in the place of this one as a whole, passes.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from typing import Any

from cosim.core.clock import nanoseconds
from cosim.core.contracts import Design
from cosim.core.port import Port
from cosim.core.recorded.partial import RecordSelection, declared_channels
from cosim.core.recorders import Memory
from cosim.errors import CosimError, LogError, UsageError, flag, listing
from cosim.log import Log, open_log
from cosim.log.comparison.diff import diff
from cosim.log.comparison.difference import LogDifference, SignalDifference
from cosim.log.contents.environment import environment_changes
from cosim.report.statements import compared_statements, contradictions, design_pairs
from cosim.report.verification_result import (
    ComponentVerification,
    CopiedSubsteps,
    Verification,
    VerificationStatus,
)
from cosim.scenario.record import (
    ReplayOrigin,
    component_record,
    recorded_substep_counts,
    replay_origin,
)
from cosim.scenario.recordings.recorded_scenario import recorded_document


def _components(
    source: Log, again: Log | Memory, difference: LogDifference, origin: ReplayOrigin
) -> tuple[ComponentVerification, ...]:
    """Return what is proven of every component."""
    rows: dict[str, list[SignalDifference]] = {}
    if source.partial is not None:
        rows = {name: [] for name in source.partial.declared}
    for row in difference.rows:
        rows.setdefault(Port.parse(row.signal).component, []).append(row)
    found = []
    for name, own_rows in rows.items():
        elements = [row.first for row in own_rows if row.first is not None]
        first = min(elements, key=lambda element: element.time_ns, default=None)
        status, reason = _status(source, again, name, origin)
        if any(row.status != "equal" for row in own_rows):
            status = "differs"
        found.append(ComponentVerification(name, status, first, reason))
    return tuple(found)


def _status(
    source: Log, again: Log | Memory, name: str, origin: ReplayOrigin
) -> tuple[VerificationStatus, str]:
    """Return what is proven of a component that does not differ, and why it is not all."""
    if name in origin.absent:
        return "absent", origin.absent[name]
    if name in origin.copied:
        return "copied", _why_copied(again, name, origin)
    recorded = source.partial
    if recorded is None or recorded.is_whole(name, source.channels):
        return "equal", ""
    if name not in source.channels:
        return "unrecorded", "no signal in the log"
    missing = recorded.missing(source.channels).get(name)
    if missing:
        return "partial", f"without {listing(missing)}"
    return "partial", f"one row in {source.channels[name].period} steps"


def _why_copied(again: Log | Memory, name: str, origin: ReplayOrigin) -> str:
    if name in origin.left_out:
        return "not chosen"
    if name in origin.uncomputed:
        return origin.uncomputed[name]
    code = component_record(again, name).code
    if code is not None:
        return f"{flag('allow_code')} runs {code.class_name}"
    return "a replay takes plants, FMUs and files from the log"


def _copied_substeps(again: Log | Memory, copied: Collection[str]) -> tuple[CopiedSubsteps, ...]:
    """Return the substeps of loops with components that a replay copied."""
    found = []
    for counts in recorded_substep_counts(again):
        inside = tuple(name for name in counts.components if name in copied)
        if inside:
            found.append(CopiedSubsteps(counts.components, inside))
    return tuple(found)


def _compared(source: Log, again: Log | Memory) -> Sequence[str]:
    """Return the signals that a partial log and its replay both have; none: the log has all.

    Raises
    ------
    LogError
        If there are none.
    """
    if source.partial is None:
        return ()
    shared = [signal for signal in source if signal in again.signals]
    if not shared:
        raise LogError(
            f"{source.label}: nothing to verify: the partial log was recorded with "
            f"{source.partial.selection}, and a replay has none of these signals"
        )
    return shared


def verify(
    source: Log, again: Log | Memory, designs: Mapping[str, Design] | None = None
) -> Verification:
    """Compare a log with its replay and with the hash that its run recorded.

    Parameters
    ----------
    source : Log
    again : Log or Memory
        What :func:`cosim.replay` made of it: all of it, or a window, which is then compared alone.
    designs : mapping of name to Design, optional
        Those that the replay took from the log, computed anew; without them none is compared.

    Raises
    ------
    LogError
        If the log is damaged, has no content hash, or says what cannot be understood.
    UsageError
        If the replay was asked to record less than the log has.
    """
    _check_selection(source, again)
    recorded_hash = _recorded_hash(source)
    found_hash = source.content_hash()
    origin = replay_origin(again)
    copied = []
    code = []
    left_out = []
    known = declared_channels(again.channels)
    for name in origin.copied:
        signals = [f"{name}.{signal.name}" for signal in known[name].interface.outputs]
        if source.partial is not None:
            signals = [signal for signal in signals if signal in source.signals]
        copied += signals
        if name in origin.left_out:
            left_out += signals
        elif component_record(again, name).code is not None:
            code += signals
    computed = known.keys() - set(origin.copied)
    window = origin.window
    span_ns = None if window is None else (nanoseconds(window[0]), nanoseconds(window[1]))
    difference = diff(source, again, signals=_compared(source, again), span_ns=span_ns)
    pairs = None if designs is None else design_pairs(source, designs)
    contradicting = (
        () if window is not None else contradictions(source, again, computed, pairs or {})
    )
    return Verification(
        recorded_hash,
        found_hash,
        difference,
        contradicting,
        tuple(copied),
        tuple(code),
        tuple(left_out),
        _copied_substeps(again, origin.copied),
        recorded_document(source).source,
        _components(source, again, difference, origin),
        environment_changes(source),
        window,
        compared_statements(source, again, pairs),
        _is_changed(source, again),
    )


def _recorded_hash(source: Log) -> str | None:
    """Return the content hash that a log has of its rows; None: it is unfinished.

    Of a file that was joined with those before it, their hashes were checked then, and that of the
    joined rows was recorded by no run: where the last file has none, there is none.
    """
    with suppress(CosimError):
        if open_log(source.path).status == "unfinished":
            return None
    return source.recorded_hash


def _check_selection(source: Log, again: Log | Memory) -> None:
    """Check that a replay has not been asked to record less than its log has.

    Raises
    ------
    UsageError
        If it has: what it left out would pass unseen.
    """
    if again.partial is None:
        return
    selection = again.partial.selection
    of_log = RecordSelection() if source.partial is None else source.partial.selection
    has_signals = selection.signals in (None, ("*",), of_log.signals)
    if not has_signals or of_log.every % selection.every:
        raise UsageError(
            f"a verification compares all signals of {source.label}, but the replay records only "
            f"{selection}; omit that"
        )


def _is_changed(source: Log, again: Log | Memory) -> bool:
    """Return whether the scenario of a replay has other edits than that of its log."""
    return _edits(again) != _edits(source)


def _edits(run: Log | Memory) -> tuple[Any, ...]:
    """Return what makes the scenario of a run; its end is that of the log in every replay."""
    document = recorded_document(run)
    changes = dict(document.changes)
    changes.pop("scenario.stop", None)
    return document.text, dict(document.swaps), dict(document.maps), changes
