"""The table after a run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rich.table import Table

from cosim.core.recording import Recording
from cosim.core.stages.substep_control import SubstepCounts
from cosim.errors import flag, listing, quoted
from cosim.log import Log
from cosim.report.certificate import certificate_of
from cosim.report.guaranteed import interval_text, reach_text
from cosim.report.recorded_rows import signal_of
from cosim.report.summary import (
    DeltaReconstruction,
    GuaranteedSummary,
    Identification,
    ParameterSummary,
    Summary,
    numbers_text,
    span,
    summarize,
)
from cosim.report.tables.certificate import certificate_tables
from cosim.report.tables.console import new_table, print_json, print_line, print_table
from cosim.report.tables.lateness import lateness_text
from cosim.scenario.building.coupling_check import gain_text
from cosim.scenario.kinds.initial_states import change_text
from cosim.scenario.recorded_metadata import (
    recorded_start,
    recorded_state_changes,
    recorded_warnings,
    recorded_window,
)

if TYPE_CHECKING:
    from cosim.report.compensation import CompensationSummary

LONGEST_PRIMES = 4  # of a derivative

MOST_GAINS: Final = 5  # after actions, in a table


def print_summary(
    recording: Recording,
    *,
    wall: Mapping[str, float],
    profile: Mapping[str, float] | None,
    as_json: bool,
    quiet: bool,
    is_kept: bool = True,
) -> None:
    """Print the summary of a run.

    Parameters
    ----------
    recording : Recording
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
    for component, text in recorded_warnings(recording):
        print_line(f"warning: {component}: {text}", error=True)
    for component, changes in recorded_state_changes(recording).items():
        print_line(f"warning: {component}: {change_text(changes)}", error=True)
    table = _summary_table(summary, recording)
    table.add_section()
    _add_wall_time(table, wall, simulated=summary.end - summary.start)
    if path is not None:
        table.add_row("log", "", "", str(path))
    print_table(table)
    for certified in certificate_tables(certificate):
        print_table(certified)
    if profile is not None:
        print_table(_profile_table(profile))


def _path_of(recording: Recording) -> Path | None:
    """Return where the log of a run is; None where it is in memory, or no longer at its path."""
    if not isinstance(recording, Log):
        return None
    if recording.is_at_its_path:
        return recording.path
    state = "holds the log of another run by now" if recording.path.exists() else "was removed"
    text = f"warning: {recording.path} {state}; what is shown is of this run, whose log is lost"
    print_line(text, error=True)
    return None


def _summary_table(summary: Summary, recording: Recording) -> Table:
    simulated = span(summary.start, summary.end)
    title = f"{summary.scenario}: {simulated} in {summary.steps} steps"
    if summary.signals or summary.values:
        table = _error_table(title, summary)
    else:
        table = _last_value_table(title, summary, recording)
    if summary.reason:
        table.add_row("stop reason", "", "", summary.reason)
    _add_conditions(table, summary)
    for change in summary.changed_states:
        text = f"x0 has {change.before:.6g}; consistent with u and delta at the start"
        label = f"{change.component}.{change.entry}"
        table.add_row(label, f"{change.after:.6g}", "", text)
    for reconstruction in summary.reconstructions:
        single = len(summary.reconstructions) == 1
        _add_reconstruction(table, reconstruction, single=single)
    for identification in summary.identifications:
        single = len(summary.identifications) == 1
        _add_identification(table, identification, recorded_start(recording), single=single)
    for compensation in summary.compensations:
        _add_compensation(table, compensation)
    _add_loops(table, summary)
    if summary.lateness is not None:
        table.add_row("real time", "", "", lateness_text(summary.lateness))
    for component, class_name in summary.copied_code.items():
        text = f"taken from the log; {flag('allow_code')} computes it, which runs {class_name}"
        table.add_row(component, "", "", text)
    if recorded_window(recording) is not None:
        text = f"rows from {summary.start:.12g} s on; computed from {recorded_start(recording):g} s"
        table.add_row("window", "", "", text)
    return table


def _add_loops(table: Table, summary: Summary) -> None:
    for loop in summary.loops:
        text = "step by step, so with an error of first order in the step; --certify shows it"
        if summary.substeps:
            text = "step by step, first order, in substeps"
        table.add_row("loop", "", "", f"{loop}: {text}")
    for counts, interpolated in zip(summary.substeps, summary.interpolated, strict=True):
        table.add_row("substeps", "", "", _substeps_text(counts, interpolated))
    after_actions = [gain for gain in summary.gains if gain.action]
    for gain in [gain for gain in summary.gains if not gain.action] + after_actions[:MOST_GAINS]:
        where = ", ".join(gain.components)
        if gain.action:
            where += f" {gain.action}"
        table.add_row("loop gain", "", "", f"{where}: {gain_text(gain)}")
    if len(after_actions) > MOST_GAINS:
        text = f"{len(after_actions) - MOST_GAINS} more after actions; --json shows them"
        table.add_row("loop gain", "", "", text)


def _substeps_text(counts: SubstepCounts, interpolated: Sequence[str]) -> str:
    """Return how many substeps a loop took, and what their errors do not tell of."""
    text = (
        f"{', '.join(counts.components)}: {counts.accepted}, the shortest "
        f"{counts.shortest:g} s; {counts.rejected} parts of a step were refused"
    )
    if counts.events:
        text += f"; {counts.events} end where an event was found"
    if counts.missed:
        text += f"; {counts.missed} miss the tolerance, at worst by {counts.worst_error:.3g} times"
    if interpolated:
        names = listing(interpolated)
        text += f"; interpolated over a step, an error that is not estimated: {names}"
    return text


def _add_conditions(table: Table, summary: Summary) -> None:
    """Add the conditions of the run that never came true."""
    if summary.until_came_true is False:
        text = f"{quoted(summary.until)} never came true up to the end of the run"
        table.add_row("until", "", "", text)
    for text in summary.never_came_true:
        words = f"{quoted(text)} never came true, so that its actions were not performed"
        table.add_row("when", "", "", words)


def _error_table(title: str, summary: Summary) -> Table:
    table = new_table(title, ("", "estimate", "truth", "error"))
    for signal in summary.signals:
        window = f"largest for t >= {signal.since:g} s; at the end {signal.last:.3g}"
        if signal.lag:
            window += f"; compared with {signal.lag:g} s before, its lag"
        error = f"{signal.largest:.3g}  ({window})"
        if math.isnan(signal.largest):
            error = f"no value for t >= {signal.since:g} s"
            if signal.lag:
                error += f", as it lags by {signal.lag:g} s"
        table.add_row(signal.estimate, "", signal.truth, error)
    for outcome in summary.values:
        value = "no value" if outcome.value is None else f"{outcome.value:+.6f}"
        error = "" if outcome.error is None else f"{outcome.error:.3g}"
        table.add_row(outcome.estimate, value, f"{outcome.truth:+g}", error)
    return table


def _last_value_table(title: str, summary: Summary, recording: Recording) -> Table:
    """Return the last values of the outputs, for a run without a truth to compare with."""
    table = new_table(title, ("", "last value", "", ""))
    for name, last in summary.last.items():
        values = last if isinstance(last, list) else [last]
        text = " ".join(f"{value:.6g}" for value in values)
        table.add_row(name, text, "", signal_of(recording, name).unit or "")
    return table


def _add_reconstruction(table: Table, reconstruction: DeltaReconstruction, *, single: bool) -> None:
    """Add what delta costs: noise, bias and lag."""
    label = "reconstruction of delta"
    if not single:
        label += f" of {reconstruction.component}"
    parameters = [f"{name} {value:g}" for name, value in reconstruction.parameters.items()]
    if reconstruction.filter == "first-order":
        parameters = []  # the scenario has it
    kind = ", ".join([reconstruction.filter, *parameters])
    gains = ", ".join(f"{gain:.3g}" for gain in reconstruction.noise_gain)
    text = f"{kind}: white noise of y x {gains} 1/s; bias {_bias(reconstruction.bias)}"
    if not reconstruction.bias["coefficient"]:
        text = f"{kind}: white noise of y x {gains}; no derivative of y, and no bias by one"
    if reconstruction.lag:
        text += f"; lag {reconstruction.lag:g} s"
    table.add_row(label, "", "", text)
    choice = reconstruction.choice
    if choice is not None:
        noise = ", ".join(f"{deviation:.3g}" for deviation in choice["noise"])
        text = (
            f"chosen for noise of {noise} in y and delta of {choice['amplitude']:.3g} up to "
            f"{choice['bandwidth']:.3g} rad/s: expected error {choice['error_by_noise']:.2g} by "
            f"noise, {choice['error_by_bias']:.2g} by bias; {choice['assumption']}"
        )
        table.add_row("", "", "", text)


def _bias(bias: Mapping[str, Any]) -> str:
    """Return the leading error as text: ``-0.001 G w''``."""
    order = bias["derivative"]
    mark = "'" * order if order <= LONGEST_PRIMES else f"^({order})"
    return f"{bias['coefficient']:.3g} {bias['of']}{mark}"


def _add_identification(
    table: Table, identification: Identification, start: float, *, single: bool
) -> None:
    table.add_section()
    label = "identification start time T_id"
    if not single:
        label += f" of {identification.component}"
    times = identification.times
    origin = "given"
    if "T_id" in times:
        terms = f"T_obs {times['T_obs']:.4f} + T_f {times['T_f']:.4f} + D_max {times['D_max']:g}"
        since = f"start {start:g} + " if start else ""
        origin = f"{since}{terms} = {start + times['T_id']:.4f} s (36)"
    table.add_row(label, f"{identification.start_time:g} s", "", origin)
    if identification.eigenvalues:
        eigenvalues = ", ".join(f"{value:.3g}" for value in identification.eigenvalues)
        table.add_row("information matrix", "", "", f"eigenvalues {eigenvalues}")
    for text in (identification.verdict, *identification.notes):
        if text:
            table.add_row("", "", "", text)
    _add_estimates(table, identification)


def _add_estimates(table: Table, identification: Identification) -> None:
    """Add what is said of theta, of amplitudes and phases, and of the noise."""
    for parameter in identification.parameters:
        _add_parameter(table, parameter.estimate, parameter)
    for parameter in identification.reference:
        _add_parameter(table, f"{parameter.estimate} by output error", parameter)
    for amplitude in identification.amplitudes:
        _add_parameter(table, amplitude.estimate, amplitude)
    if identification.noise:
        deviation = numbers_text(identification.deviation)
        table.add_row("noise", deviation, "", identification.noise)
    if identification.guaranteed is not None:
        _add_guaranteed(table, identification.guaranteed)


def _add_guaranteed(table: Table, guaranteed: GuaranteedSummary) -> None:
    """Add the intervals that hold for an irregular part within a bound."""
    label = f"|delta_0| <= {guaranteed.bound:g}"
    if guaranteed.problem:
        table.add_row(label, "", "", guaranteed.problem)
        return
    chance = ""
    if guaranteed.confidence < 1.0:
        chance = f", noise within its bounds with {guaranteed.confidence:g}"
    table.add_row(label, "", "", f"guaranteed intervals by output error{chance}")
    for effect in guaranteed.effects:
        interval = interval_text(
            effect["lower"], effect["upper"], is_explained=effect["is_explained"]
        )
        reach = reach_text(effect["first_order"], holds=effect["holds"])
        table.add_row(effect["estimate"], interval, "", reach)


def _add_parameter(table: Table, label: str, parameter: ParameterSummary) -> None:
    """Add an estimate with its 95 % interval and its verdict."""
    text = "no value"
    if parameter.value is not None:
        text = f"{parameter.value:+.6g}"
        if parameter.half_width is not None:
            text = f"{text} ± {parameter.half_width:.2g}"
    table.add_row(label, text, "", f"{parameter.verdict}: {parameter.reason}")


def _add_compensation(table: Table, compensation: CompensationSummary) -> None:
    """Add when the internal model became active, and what is left of the regulated error."""
    table.add_section()
    label = f"internal model of {compensation.component}"
    before = numbers_text(compensation.before)
    if compensation.active_since is None:
        text = f"not active: {compensation.reason}; regulated error {before} rms"
        table.add_row(label, "", "", text)
        return
    text = "active from then on"
    if compensation.theta:
        first = ", ".join(f"{value:.6g}" for value in compensation.theta)
        last = ", ".join(f"{value:.6g}" for value in compensation.last_theta)
        text += f", with theta = {first}, at the end {last}; the loop is proven to be stable for "
        text += ", ".join(f"[{lower:g}, {upper:g}]" for lower, upper in compensation.interval)
    table.add_row(label, f"{compensation.active_since:g} s", "", text)
    after = numbers_text(compensation.after)
    text = f"{before} rms before, {after} for t >= {compensation.since:.4g} s, as measured"
    table.add_row("regulated error", "", "", text)


def _add_wall_time(table: Table, wall: Mapping[str, float], *, simulated: float) -> None:
    total = sum(wall.values())
    parts = ", ".join(f"{part} {seconds:.2f} s" for part, seconds in wall.items())
    speed = f"{simulated / total:.3g} x real time"
    table.add_row("wall time", f"{total:.2f} s", "", f"{parts}: {speed}")


def _profile_table(profile: Mapping[str, float]) -> Table:
    table = new_table("wall time by component", ("", "s", "%"))
    total = sum(profile.values())
    largest_first = sorted(profile.items(), key=lambda item: -item[1])
    for name, seconds in largest_first:
        percent = f"{100 * seconds / total:.1f}" if total else ""
        table.add_row(name, f"{seconds:.4f}", percent)
    return table
