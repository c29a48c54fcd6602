"""The table after a run."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from rich.table import Table

from cosim.core.recorded.run import RecordedRun
from cosim.core.recorded.signals import warning_texts
from cosim.core.recording import Recording
from cosim.errors import flag, listing, option, quoted
from cosim.log import Log
from cosim.report.certificate import StepCertificate, certificate_of
from cosim.report.estimators import (
    CompensationSummary,
    DeltaReconstruction,
    Identification,
    bad_verdicts,
    numbers_text,
)
from cosim.report.recorded_rows import recorded_port
from cosim.report.summary import SignalError, Summary, span, summarize
from cosim.report.tables.console import new_table, print_json, print_line, print_tables
from cosim.report.tables.estimates import (
    chance_text,
    estimate_notes,
    estimate_rows,
    estimate_table,
    guaranteed_texts,
    noise_of_y,
)
from cosim.scenario.building.coupling_check import gain_text
from cosim.scenario.record import recorded_start, recorded_window
from cosim.theory.documents import Verdict

ORDINALS: Final = {1: "first", 2: "second", 3: "third"}

# what times or values are taken for: a wrong one is a wrong result, so that it is always said
_TAKEN: Final = re.compile(r"\bunits?\b|\btimes are\b|\bsame time\b|\bstamps?\b")
MOST_GAINS: Final = 5  # after actions, in a table


def print_summary(
    recording: RecordedRun,
    *,
    wall: Mapping[str, float],
    profile: Mapping[str, float] | None = None,
    as_json: bool,
    quiet: bool,
    is_kept: bool = True,
) -> None:
    """Print the summary of a run.

    Parameters
    ----------
    recording : RecordedRun
    wall : mapping of name to float
        Wall times [s].
    profile : mapping of component name to float, or None
        Wall time of each component [s].
    as_json, quiet : bool
    is_kept : bool
        Whether its log, if it has one, is there afterwards.
    """
    path = _path_of(recording) if is_kept else None
    if quiet and not as_json:
        _print_quietly(recording)
        return
    summary = summarize(recording)
    certificate = certificate_of(recording, summary)
    if as_json:
        content: dict[str, Any] = summary.to_dict()
        if certificate is not None:
            content["certificate"] = certificate.to_dict()
        content["wall"] = dict(wall)
        content["log"] = None if path is None else str(path)
        if profile is not None:
            content["profile"] = dict(profile)
        print_json(content)
        return
    for text in warning_texts(summary.warnings):
        print_line(f"warning: {text}", error=True)
    see = "--certify" if certificate is None else "below"
    facts = [*_facts(summary, recording, see), _wall_time(wall, summary)]
    if path is not None:
        facts.append(("log", str(path)))
    tables = [*_value_tables(summary, recording), new_table("", ("", ""), facts)]
    if certificate is not None:
        tables += _certificate_tables(certificate)
    if profile is not None:
        tables.append(_profile_table(profile))
    simulated = span(summary.start, summary.end)
    tables[0].title = f"{summary.scenario}: {simulated} in {summary.steps} steps"
    print_tables(tables)


def _print_quietly(recording: RecordedRun) -> None:
    """Print what nobody who trusts the result may miss."""
    for names, verdict, reason in bad_verdicts(recording):
        if verdict:
            print_line(f"warning: {names}: {verdict}: {reason}", error=True)
    taken = [warning for warning in recording.warnings if _TAKEN.search(warning.text)]
    for text in warning_texts(taken):
        print_line(f"warning: {text}", error=True)


def failure_lines(run: RecordedRun, fail_on: Collection[str], *, quiet: bool) -> list[str]:
    """Return why a run is failed by "inconsistent", "no-estimate" or "warning", a line a reason.

    ``quiet``: its warnings have not been printed.
    """
    lines = []
    asked = [name for name in ("no-estimate", "inconsistent") if name in fail_on]
    if asked:
        for names, verdict, reason in bad_verdicts(run):
            name = "inconsistent" if verdict == Verdict.INCONSISTENT else "no-estimate"
            if not verdict:
                name = asked[0]
            if name in asked:
                lines.append(f"{option('fail-on', name)}: {names}: {verdict or reason}")
    if "warning" in fail_on and run.warnings:
        texts = warning_texts(run.warnings) if quiet else [f"{len(run.warnings)} in all"]
        lines += [f"{option('fail-on', 'warning')}: {text}" for text in texts]
    return lines


def _path_of(recording: Recording) -> Path | None:
    """Return where the log of a run is; None where it is in memory, or no longer at its path."""
    if not isinstance(recording, Log):
        return None
    if recording.is_at_its_path:
        return recording.path
    state = "holds the log of another run by now" if recording.path.exists() else "was removed"
    text = f"warning: {recording.path} {state}; shown is this run, whose log is lost"
    print_line(text, error=True)
    return None


def _value_tables(summary: Summary, recording: Recording) -> Iterator[Table]:
    """Yield the tables of numbers: signals, then constants and parameters; none that is empty."""
    if summary.signals:
        yield _signal_table(summary.signals)
    elif summary.last:  # there is no truth to compare with
        rows = []
        for name, last in summary.last.items():
            values = last if isinstance(last, list) else [last]
            text = " ".join(f"{value:.6g}" for value in values)
            rows.append((name, text, recorded_port(recording, name).signal.unit_text))
        unit = "unit" if any(row[-1] for row in rows) else ""
        yield new_table("", ("signal", "final value", unit), rows)
    estimates = estimate_rows(summary)
    if estimates:
        yield estimate_table(estimates)


def _signal_table(signals: Sequence[SignalError]) -> Table:
    """Return the table of estimated signals beside the true ones."""
    begins = [f" for t >= {signal.since:g} s" for signal in signals]
    is_same = len(set(begins)) == 1
    rows = []
    for signal, begin in zip(signals, begins, strict=True):
        largest = "no value" if math.isnan(signal.largest) else f"{signal.largest:.3g}"
        last = "" if math.isnan(signal.last) else f"{signal.last:.3g}"
        rows.append((signal.estimate, signal.truth, largest + ("" if is_same else begin), last))
    title = f"largest error{begins[0] if is_same else ''}"
    return new_table("", ("signal", "truth", title, "error at the end"), rows)


def _facts(summary: Summary, recording: Recording, see: str) -> Iterator[tuple[str, str]]:
    """Yield what is said of a run in words, each with its subject.

    Parameters
    ----------
    summary : Summary
    recording : Recording
    see : str
        What shows how large a coupling error is.
    """
    start = recorded_start(recording)
    yield from _of_times(summary)
    yield from estimate_notes(summary)
    for own in summary.identifications:
        yield from _of_identification(own, summary, start)
    for design in summary.reconstructions:
        yield from _of_reconstruction(design, single=len(summary.reconstructions) == 1)
    for compensation in summary.compensations:
        yield from _of_compensation(compensation, single=len(summary.compensations) == 1)
    yield from _of_loops(summary, see)
    if summary.lateness is not None:
        yield "real time", str(summary.lateness)
    for component, class_name in summary.copied_code.items():
        text = f"replayed from the log; {flag('allow_code')} runs {class_name} instead"
        yield component, text
    if recorded_window(recording) is not None:
        yield "window", f"rows from {summary.start:.12g} s on; computed from {start:g} s"


def _of_times(summary: Summary) -> Iterator[tuple[str, str]]:
    """Yield what ended the run, what it waited for in vain, how it began, and what lags."""
    if summary.reason:
        yield "stop reason", summary.reason
    if summary.until_came_true is False:
        yield "until", f"{quoted(summary.until)} was never met"
    for text in summary.never_came_true:
        yield "when", f"{quoted(text)} was never met; its actions were not performed"
    for change in summary.changed_states:
        yield (
            f"{change.component}.{change.entry}",
            f"initial value {change.after:.6g} instead of {change.before:.6g} (x0): consistent "
            "with u and delta at the start",
        )
    for signal in summary.signals:
        if signal.lag:
            compared = f"compared with {signal.truth} {signal.lag:g} s earlier"
            if math.isnan(signal.largest):
                compared = "no value in the run"
            yield signal.estimate, f"lags by {signal.lag:g} s; {compared}"


def _of_loops(summary: Summary, see: str) -> Iterator[tuple[str, str]]:
    """Yield the coupling errors of loops, their substeps, and what becomes of an error."""
    how = "in substeps" if summary.substeps else f"(see {see})"
    separator = ", " if summary.substeps else " "
    for loop in summary.loops:
        yield "loop", f"{loop}: coupling error: first order{separator}{how}"
    for counts, interpolated in zip(summary.substeps, summary.interpolated, strict=True):
        text = (
            f"{', '.join(counts.components)}: {counts.accepted} substeps, shortest "
            f"{counts.shortest:g} s; {counts.rejected} rejected"
        )
        if counts.events:
            text += f"; {counts.events} end at an event"
        if counts.missed:
            worst = f"{counts.worst_error:.3g} times"
            text += f"; {counts.missed} exceed the tolerance, at worst {worst}"
        if interpolated:
            text += f"; interpolated over a step, error not estimated: {listing(interpolated)}"
        yield "substeps", text
    after_actions = [gain for gain in summary.gains if gain.action]
    for gain in [gain for gain in summary.gains if not gain.action] + after_actions[:MOST_GAINS]:
        where = f"{', '.join(gain.components)} {gain.action}".rstrip()
        yield "error growth", f"{where}: {gain_text(gain)}"
    if len(after_actions) > MOST_GAINS:
        text = f"{len(after_actions) - MOST_GAINS} more after actions; see --json"
        yield "error growth", text


def _of_identification(
    own: Identification, summary: Summary, start: float
) -> Iterator[tuple[str, str]]:
    """Yield when an identification starts and why, what its data determine, and their noise."""
    of_component = f" of {own.component}" if len(summary.identifications) > 1 else ""
    origin = "given"
    if "T_id" in own.times:
        origin = f"start {start:g} s + " if start else ""
        origin += (
            f"observer {own.times['T_obs']:.4f} s + filter {own.times['T_f']:.4f} s + longest "
            f"delay {own.times['D_max']:g} s"
        )
    late = ", after the end of the run" if own.start_time > summary.end else ""
    yield f"identification{of_component}", f"from {own.start_time:g} s{late} ({origin})"
    if own.eigenvalues:
        yield "information matrix", f"eigenvalues {numbers_text(own.eigenvalues)}"
    for text in filter(None, (own.verdict, *own.notes)):
        yield "", text
    if own.noise:
        yield "noise of y", noise_of_y(own.deviation, own.noise)
    part = own.guaranteed
    if part is None:
        return
    label = f"|delta_0| <= {part.bound:g}"
    if part.problem:
        yield label, part.problem
        return
    yield label, f"guaranteed intervals by output error{chance_text(part)}:"
    for effect in part.effects:
        yield effect.name, "; ".join(guaranteed_texts(effect))


def _of_reconstruction(
    reconstruction: DeltaReconstruction, *, single: bool
) -> Iterator[tuple[str, str]]:
    """Yield what delta costs: noise, bias and lag, and what its window was chosen for."""
    kind = f"{reconstruction.filter} filter"
    if reconstruction.filter != "first-order":  # the scenario has it
        parameters = reconstruction.parameters.items()
        kind = ", ".join([kind, *(f"{name} {value:g}" for name, value in parameters)])
    bias = reconstruction.bias
    error = "y is not differentiated, no bias"
    if bias.coefficient:
        ordinal = ORDINALS.get(bias.derivative, f"{bias.derivative}th")
        signal = "the measurement" if bias.of == "G w" else bias.of
        error = f"bias {bias.coefficient:.3g} x {ordinal} derivative of {signal}"
    text = f"{kind}: noise gain {numbers_text(reconstruction.noise_gain)} 1/s; {error}"
    if reconstruction.lag:
        text += f"; lag {reconstruction.lag:g} s"
    yield "reconstruction" if single else f"reconstruction by {reconstruction.component}", text
    choice = reconstruction.choice
    if choice is not None:
        yield (
            "",
            f"chosen for noise of {numbers_text(choice.noise)} in y and delta of "
            f"{choice.amplitude:.3g} up to {choice.bandwidth:.3g} rad/s; expected error "
            f"{choice.error_by_noise:.2g} from noise, {choice.error_by_bias:.2g} from bias; "
            f"{choice.assumption}",
        )


def _of_compensation(
    compensation: CompensationSummary, *, single: bool
) -> Iterator[tuple[str, str]]:
    """Yield when the internal model became active, and what is left of the regulated error."""
    label = "internal model" if single else f"internal model of {compensation.component}"
    before = numbers_text(compensation.before)
    if compensation.active_since is None:
        yield label, f"not active: {compensation.reason}"
        yield "regulated error", f"{before} rms, as measured"
        return
    text = f"active from {compensation.active_since:g} s"
    if compensation.theta:
        first = ", ".join(f"{value:.6g}" for value in compensation.theta)
        last = ", ".join(f"{value:.6g}" for value in compensation.last_theta)
        text += f" with theta = {first}, at the end {last}; loop proven stable for theta in "
        text += ", ".join(f"[{lower:g}, {upper:g}]" for lower, upper in compensation.interval)
    yield label, text
    after = numbers_text(compensation.after)
    text = f"{before} rms before, {after} rms for t >= {compensation.since:.4g} s, as measured"
    yield "regulated error", text


def _wall_time(wall: Mapping[str, float], summary: Summary) -> tuple[str, str]:
    total = sum(wall.values())
    parts = ", ".join(f"{part} {seconds:.2f} s" for part, seconds in wall.items())
    simulated = summary.end - summary.start
    speed = f"{simulated / (total - wall.get('imports', 0.0)):.3g} x real time"
    return "wall time", f"{total:.2f} s ({parts}), {speed}"


def _profile_table(profile: Mapping[str, float]) -> Table:
    total = sum(profile.values())
    rows = []
    for name, seconds in sorted(profile.items(), key=lambda item: -item[1]):
        percent = f"{100 * seconds / total:.1f}" if total else ""
        rows.append((name, f"{seconds:.4f}", percent))
    return new_table("wall time by component", ("", "s", "%"), rows)


def _certificate_tables(certificate: StepCertificate) -> list[Table]:
    """Return the tables: the search for the step where there was one, the errors, and notes."""
    finer = " and ".join(f"{step:g} s" for step in certificate.finer_steps)
    title = f"error of the communication step {certificate.step:g} s, from runs with {finer}"
    rows = []
    for signal in certificate.signals:
        if signal.is_bounded or (signal.largest is not None and signal.order is not None):
            is_bounded = signal.is_bounded
            largest = f"at most {signal.bound:.3g}" if is_bounded else f"{signal.largest:.3g}"
            row = (
                signal.signal,
                largest if signal.unit is None else f"{largest} {signal.unit}",
                "" if signal.time is None else f"{signal.time:g} s",
                "" if signal.last is None else f"{signal.last:+.3g}",
                "" if signal.order is None else f"{signal.order:.2f}",
            )
            rows.append(row)
    columns = ("signal", "largest", "at t", "at the end", "order")
    tables = [
        new_table("search for the communication step", ("", ""), certificate.search()),
        new_table(title, columns, rows),
        new_table("" if rows else title, ("", ""), _below(certificate)),
    ]
    return [table for table in tables if table.rows]


def _below(certificate: StepCertificate) -> Iterator[tuple[str, str]]:
    """Yield signals without an estimate by the reason, shares of errors, then notes."""
    if certificate.problem:
        yield "no estimate", certificate.problem
        return
    equal: list[str] = []
    reasons: dict[tuple[str, str], list[str]] = {}
    for signal in certificate.signals:
        if signal.largest is None:
            label = "upper bound" if signal.is_bounded else "no estimate"
            reasons.setdefault((label, signal.reason), []).append(signal.signal)
        elif signal.order is None:
            equal.append(signal.signal)
    if equal:
        yield "no error", f"{', '.join(equal)}: identical in all three runs"
    for (label, reason), signals in reasons.items():
        yield label, f"{', '.join(signals)}: {reason}"
    for share in certificate.shares:
        yield share.estimate, str(share)
    for note in certificate.notes():
        yield "note", note
