"""The table after a run."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rich.table import Table

from cosim.core.recorded.run import RecordedRun
from cosim.core.recorded.signals import warning_texts
from cosim.core.recording import Recording
from cosim.core.stages.substep_control import SubstepCounts
from cosim.errors import flag, listing, option, quoted
from cosim.log import Log
from cosim.report.certificate import certificate_of
from cosim.report.guaranteed import interval_text, reach_text
from cosim.report.recorded_rows import signal_of
from cosim.report.summary import (
    DeltaReconstruction,
    Identification,
    SignalError,
    Summary,
    bad_verdicts,
    numbers_text,
    span,
    summarize,
)
from cosim.report.tables.certificate import certificate_tables
from cosim.report.tables.console import new_table, print_json, print_line, print_tables
from cosim.report.tables.estimates import estimate_notes, estimate_rows, estimate_table
from cosim.report.tables.lateness import lateness_text
from cosim.scenario.building.coupling_check import gain_text
from cosim.scenario.record import IrregularPart, recorded_start, recorded_window
from cosim.theory.assessment.documents import Verdict
from cosim.theory.reconstruction.filters import Bias

if TYPE_CHECKING:
    from cosim.report.compensation import CompensationSummary

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
    facts = _facts_table(summary, recording, see="--certify" if certificate is None else "below")
    _add_wall_time(facts, wall, simulated=summary.end - summary.start)
    if path is not None:
        facts.add_row("log", str(path))
    tables = [*_value_tables(summary, recording), facts, *certificate_tables(certificate)]
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


def _value_tables(summary: Summary, recording: Recording) -> list[Table]:
    """Return the tables of numbers: signals, then constants and parameters; none that is empty."""
    tables = []
    if summary.signals:
        tables.append(_signal_table(summary.signals))
    elif summary.last:
        tables.append(_final_value_table(summary, recording))
    rows = estimate_rows(summary)
    if rows:
        tables.append(estimate_table(rows))
    return tables


def _signal_table(signals: Sequence[SignalError]) -> Table:
    """Return the table of estimated signals beside the true ones."""
    begins = {signal.since for signal in signals}
    since = f" for t >= {begins.pop():g} s" if len(begins) == 1 else ""
    table = new_table("", ("signal", "truth", f"largest error{since}", "error at the end"))
    for signal in signals:
        largest = "no value" if math.isnan(signal.largest) else f"{signal.largest:.3g}"
        if not since:
            largest += f" for t >= {signal.since:g} s"
        last = "" if math.isnan(signal.last) else f"{signal.last:.3g}"
        table.add_row(signal.estimate, signal.truth, largest, last)
    return table


def _final_value_table(summary: Summary, recording: Recording) -> Table:
    """Return the final values of the outputs, for a run without a truth to compare with."""
    units = {name: signal_of(recording, name).unit_text for name in summary.last}
    has_units = any(units.values())
    table = new_table("", ("signal", "final value", "unit" if has_units else ""))
    for name, last in summary.last.items():
        values = last if isinstance(last, list) else [last]
        text = " ".join(f"{value:.6g}" for value in values)
        table.add_row(name, text, units[name])
    return table


def _facts_table(summary: Summary, recording: Recording, *, see: str) -> Table:
    """Return the table of all that is said of a run in words, each with its subject.

    Parameters
    ----------
    summary : Summary
    recording : Recording
    see : str
        What shows how large a coupling error is.
    """
    table = new_table("", ("", ""))
    if summary.reason:
        table.add_row("stop reason", summary.reason)
    _add_conditions(table, summary)
    for change in summary.changed_states:
        label = f"{change.component}.{change.entry}"
        text = (
            f"initial value {change.after:.6g} instead of {change.before:.6g} (x0): consistent "
            "with u and delta at the start"
        )
        table.add_row(label, text)
    for signal in summary.signals:
        if signal.lag:
            compared = f"compared with {signal.truth} {signal.lag:g} s earlier"
            if math.isnan(signal.largest):
                compared = "no value in the run"
            table.add_row(signal.estimate, f"lags by {signal.lag:g} s; {compared}")
    _add_estimation(table, summary, recorded_start(recording))
    _add_loops(table, summary, see)
    if summary.lateness is not None:
        table.add_row("real time", lateness_text(summary.lateness))
    for component, class_name in summary.copied_code.items():
        text = f"replayed from the log; {flag('allow_code')} runs {class_name} instead"
        table.add_row(component, text)
    if recorded_window(recording) is not None:
        text = f"rows from {summary.start:.12g} s on; computed from {recorded_start(recording):g} s"
        table.add_row("window", text)
    return table


def _add_estimation(table: Table, summary: Summary, start: float) -> None:
    """Add what identifications, reconstructions and compensations rest on."""
    for label, text in estimate_notes(summary):
        table.add_row(label, text)
    for identification in summary.identifications:
        single = len(summary.identifications) == 1
        _add_identification(table, identification, start, summary.end, single=single)
    for reconstruction in summary.reconstructions:
        single = len(summary.reconstructions) == 1
        _add_reconstruction(table, reconstruction, single=single)
    for compensation in summary.compensations:
        single = len(summary.compensations) == 1
        _add_compensation(table, compensation, single=single)


def _add_loops(table: Table, summary: Summary, see: str) -> None:
    for loop in summary.loops:
        text = f"coupling error: first order (see {see})"
        if summary.substeps:
            text = "coupling error: first order, in substeps"
        table.add_row("loop", f"{loop}: {text}")
    for counts, interpolated in zip(summary.substeps, summary.interpolated, strict=True):
        table.add_row("substeps", _substeps_text(counts, interpolated))
    after_actions = [gain for gain in summary.gains if gain.action]
    for gain in [gain for gain in summary.gains if not gain.action] + after_actions[:MOST_GAINS]:
        where = ", ".join(gain.components)
        if gain.action:
            where += f" {gain.action}"
        table.add_row("error growth", f"{where}: {gain_text(gain)}")
    if len(after_actions) > MOST_GAINS:
        text = f"{len(after_actions) - MOST_GAINS} more after actions; see --json"
        table.add_row("error growth", text)


def _substeps_text(counts: SubstepCounts, interpolated: Sequence[str]) -> str:
    """Return how many substeps a loop took, and which errors their control does not see."""
    text = (
        f"{', '.join(counts.components)}: {counts.accepted} substeps, shortest "
        f"{counts.shortest:g} s; {counts.rejected} rejected"
    )
    if counts.events:
        text += f"; {counts.events} end at an event"
    if counts.missed:
        text += f"; {counts.missed} exceed the tolerance, at worst {counts.worst_error:.3g} times"
    if interpolated:
        text += f"; interpolated over a step, error not estimated: {listing(interpolated)}"
    return text


def _add_conditions(table: Table, summary: Summary) -> None:
    """Add the conditions of the run that were never met."""
    if summary.until_came_true is False:
        table.add_row("until", f"{quoted(summary.until)} was never met")
    for text in summary.never_came_true:
        table.add_row("when", f"{quoted(text)} was never met; its actions were not performed")


def _add_identification(
    table: Table, identification: Identification, start: float, end: float, *, single: bool
) -> None:
    """Add when an identification starts and why, what its data determine, and their noise."""
    of_component = "" if single else f" of {identification.component}"
    times = identification.times
    origin = "given"
    if "T_id" in times:
        since = f"start {start:g} s + " if start else ""
        origin = (
            f"{since}observer {times['T_obs']:.4f} s + filter {times['T_f']:.4f} s + longest delay "
            f"{times['D_max']:g} s"
        )
    late = ", after the end of the run" if identification.start_time > end else ""
    text = f"from {identification.start_time:g} s{late} ({origin})"
    table.add_row(f"identification{of_component}", text)
    if identification.eigenvalues:
        eigenvalues = ", ".join(f"{value:.3g}" for value in identification.eigenvalues)
        table.add_row("information matrix", f"eigenvalues {eigenvalues}")
    for text in (identification.verdict, *identification.notes):
        if text:
            table.add_row("", text)
    if identification.noise:
        deviation = numbers_text(identification.deviation)
        text = f"{deviation}: {identification.noise}" if deviation else identification.noise
        table.add_row("noise of y", text.replace(": of y,", ",", 1))
    if identification.guaranteed is not None:
        _add_guaranteed(table, identification.guaranteed)


def _add_guaranteed(table: Table, guaranteed: IrregularPart) -> None:
    """Add the intervals that hold for an irregular part within a bound."""
    label = f"|delta_0| <= {guaranteed.bound:g}"
    if guaranteed.problem:
        table.add_row(label, guaranteed.problem)
        return
    chance = ""
    if guaranteed.confidence < 1.0:
        chance = f", noise within its bounds with probability {guaranteed.confidence:g}"
    table.add_row(label, f"guaranteed intervals by output error{chance}:")
    for effect in guaranteed.effects:
        interval = interval_text(effect.lower, effect.upper, is_explained=effect.is_explained)
        reach = reach_text(effect.first_order, holds=effect.holds)
        table.add_row(effect.name, f"{interval}; {reach}")


def _add_reconstruction(table: Table, reconstruction: DeltaReconstruction, *, single: bool) -> None:
    """Add what delta costs: noise, bias and lag."""
    label = "reconstruction" if single else f"reconstruction by {reconstruction.component}"
    parameters = [f"{name} {value:g}" for name, value in reconstruction.parameters.items()]
    if reconstruction.filter == "first-order":
        parameters = []  # the scenario has it
    kind = ", ".join([f"{reconstruction.filter} filter", *parameters])
    gains = ", ".join(f"{gain:.3g}" for gain in reconstruction.noise_gain)
    text = f"{kind}: noise gain {gains} 1/s; bias {_bias(reconstruction.bias)}"
    if not reconstruction.bias.coefficient:
        text = f"{kind}: noise gain {gains}; y is not differentiated, no bias"
    if reconstruction.lag:
        text += f"; lag {reconstruction.lag:g} s"
    table.add_row(label, text)
    choice = reconstruction.choice
    if choice is not None:
        noise = ", ".join(f"{deviation:.3g}" for deviation in choice.noise)
        text = (
            f"chosen for noise of {noise} in y and delta of {choice.amplitude:.3g} up to "
            f"{choice.bandwidth:.3g} rad/s; expected error {choice.error_by_noise:.2g} from "
            f"noise, {choice.error_by_bias:.2g} from bias; {choice.assumption}"
        )
        table.add_row("", text)


def _bias(bias: Bias) -> str:
    """Return the leading error as text."""
    order = bias.derivative
    ordinal = ORDINALS.get(order, f"{order}th")
    signal = "the measurement" if bias.of == "G w" else bias.of
    return f"{bias.coefficient:.3g} x {ordinal} derivative of {signal}"


def _add_compensation(table: Table, compensation: CompensationSummary, *, single: bool) -> None:
    """Add when the internal model became active, and what is left of the regulated error."""
    label = "internal model" if single else f"internal model of {compensation.component}"
    before = numbers_text(compensation.before)
    if compensation.active_since is None:
        text = f"not active: {compensation.reason}"
        table.add_row(label, text)
        table.add_row("regulated error", f"{before} rms, as measured")
        return
    text = f"active from {compensation.active_since:g} s"
    if compensation.theta:
        first = ", ".join(f"{value:.6g}" for value in compensation.theta)
        last = ", ".join(f"{value:.6g}" for value in compensation.last_theta)
        text += f" with theta = {first}, at the end {last}; loop proven stable for theta in "
        text += ", ".join(f"[{lower:g}, {upper:g}]" for lower, upper in compensation.interval)
    table.add_row(label, text)
    after = numbers_text(compensation.after)
    text = f"{before} rms before, {after} rms for t >= {compensation.since:.4g} s, as measured"
    table.add_row("regulated error", text)


def _add_wall_time(table: Table, wall: Mapping[str, float], *, simulated: float) -> None:
    total = sum(wall.values())
    parts = ", ".join(f"{part} {seconds:.2f} s" for part, seconds in wall.items())
    speed = f"{simulated / (total - wall.get('imports', 0.0)):.3g} x real time"
    table.add_row("wall time", f"{total:.2f} s ({parts}), {speed}")


def _profile_table(profile: Mapping[str, float]) -> Table:
    table = new_table("wall time by component", ("", "s", "%"))
    total = sum(profile.values())
    largest_first = sorted(profile.items(), key=lambda item: -item[1])
    for name, seconds in largest_first:
        percent = f"{100 * seconds / total:.1f}" if total else ""
        table.add_row(name, f"{seconds:.4f}", percent)
    return table
