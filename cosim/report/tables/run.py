"""The table after a run."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

from rich.table import Table

from cosim.core.recorded.run import RecordedRun
from cosim.core.recorded.signals import html_table, warning_texts
from cosim.core.recording import Recording
from cosim.errors import CosimError, flag, listing, option, quoted
from cosim.log import Log
from cosim.report.certificate import StepCertificate, certificate_of
from cosim.report.estimators import bad_verdicts, value_text
from cosim.report.printable import print_notice
from cosim.report.recorded_rows import recorded_port
from cosim.report.summary import Summary, span, summarize
from cosim.report.tables.console import new_table, print_json, print_tables
from cosim.scenario.building.coupling import gain_text
from cosim.scenario.record import recorded_start, recorded_window
from cosim.theory.documents import ParameterVerdict

# what times or values are taken for: a wrong one is a wrong result, so that it is always said
_TAKEN: Final = re.compile(r"\bunits?\b|\btimes are\b|\bsame time\b|\bstamps?\b")
_SHOWN_RTOL: Final = 1e-6  # of values with six digits
_COLUMNS: Final = ("parameter", "estimate", "95 % interval", "truth", "error", "verdict")
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
        content = summary.to_dict()
        if certificate is not None:
            content["certificate"] = certificate.to_dict()
        content |= {"wall": dict(wall), "log": None if path is None else str(path)}
        if profile is not None:
            content["profile"] = dict(profile)
        print_json(content)
        return
    for text in warning_texts(summary.warnings):
        print_notice(f"warning: {text}")
    more = [("wall time", _wall_time(wall, summary.end - summary.start))]
    if path is not None:
        more.append(("log", str(path)))
    tables = _run_tables(recording, summary, certificate, more)
    if profile is not None:
        tables.append(_profile_table(profile))
    print_tables(tables)


def html_summary(recording: RecordedRun) -> str:
    """Return the tables after a run as HTML; where it has no summary, why."""
    try:
        summary = summarize(recording)
        tables = _run_tables(recording, summary, certificate_of(recording, summary))
    except CosimError as error:  # a notebook shows the signals all the same
        return html_table("", (), [(str(error),)])
    texts = []
    for table in tables:
        header, *rows = zip(*([str(c.header), *c.cells] for c in table.columns), strict=True)
        texts.append(html_table(str(table.title), header, rows))
    return "".join(texts)


def _run_tables(
    recording: RecordedRun,
    summary: Summary,
    certificate: StepCertificate | None,
    more: Iterable[tuple[str, str]] = (),
) -> list[Table]:
    """Return signals, constants, and what else is said, with ``more`` lines; then certificates."""
    lines = _lines(summary, recording, "--certify" if certificate is None else "below")
    values = [_signal_table(summary, recording), _estimate_table(summary)]
    tables = [table for table in values if table.rows]
    tables.append(new_table("", ("", ""), [*lines, *more]))
    if certificate is not None:
        tables += _certificate_tables(certificate)
    simulated = span(summary.start, summary.end)
    tables[0].title = f"{summary.scenario}: {simulated} in {summary.steps} steps"
    return tables


def _print_quietly(recording: RecordedRun) -> None:
    """Print what nobody who trusts the result may miss."""
    for what, text in bad_verdicts(recording):
        if what:
            print_notice(f"warning: {text}")
    taken = [warning for warning in recording.warnings if _TAKEN.search(warning.text)]
    for text in warning_texts(taken):
        print_notice(f"warning: {text}")


def failure_lines(run: RecordedRun, fail_on: Collection[str], *, quiet: bool) -> list[str]:
    """Return why a run is failed by "inconsistent", "no-estimate" or "warning", a line a reason.

    ``quiet``: its warnings have not been printed.
    """
    lines = []
    asked = [name for name in ("no-estimate", "inconsistent") if name in fail_on]
    if asked:
        for what, text in bad_verdicts(run):
            name = what or asked[0]
            if name in asked:
                lines.append(f"{option('fail-on', name)}: {text}")
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
    print_notice(text)
    return None


def _signal_table(summary: Summary, recording: Recording) -> Table:
    """Return the table of estimated signals beside the true ones; without a truth the last rows."""
    rows = []
    for signal in summary.signals:
        largest = "no value" if math.isnan(signal.largest) else f"{signal.largest:.3g}"
        last = "" if math.isnan(signal.last) else f"{signal.last:.3g}"
        rows.append((signal.estimate, signal.truth, largest, last))
    if rows:
        title = f"largest error for t >= {summary.signals[0].since:g} s"
        return new_table("", ("signal", "truth", title, "error at the end"), rows)
    last_rows = []
    for name, value in summary.last.items():
        values = value if isinstance(value, list) else [value]
        text = " ".join(f"{element:.6g}" for element in values)
        last_rows.append((name, text, recorded_port(recording, name).signal.unit_text))
    unit = "unit" if any(row[-1] for row in last_rows) else ""
    return new_table("", ("signal", "final value", unit), last_rows)


def _estimate_table(summary: Summary) -> Table:
    """Return the constants that a run estimates, those with a truth first.

    Such a one has two rows where its signal ends with another value than that of its verdict.
    Columns that no row has are left out.
    """
    verdicts = [pair for own in summary.identifications for pair in own.labelled_verdicts]
    by_label = dict(verdicts)
    truths = {own.estimate: own for own in summary.values}
    rows = []
    for label, own in truths.items():
        verdict = by_label.get(label)
        if verdict is None:
            rows.append(_estimate_row(label, own.value, own.truth))
            continue
        value = verdict.value
        if own.value is not None:
            shown = math.nan if value is None else value
            if math.isclose(own.value, shown, rel_tol=_SHOWN_RTOL):
                value = own.value
            else:
                rows.append(_estimate_row(f"{label} (signal)", own.value, own.truth))
        rows.append(_estimate_row(label, value, own.truth, verdict))
    for label, verdict in verdicts:
        if label not in truths:
            rows.append(_estimate_row(label, verdict.value, None, verdict))
    columns = zip(_COLUMNS, *rows, strict=True)
    shown_columns = [column for column in columns if any(column[1:])]
    header, *cells = zip(*shown_columns, strict=True) if rows else [()]
    return new_table("", header, cells)


def _estimate_row(
    label: str, value: float | None, truth: float | None, verdict: ParameterVerdict | None = None
) -> tuple[str, ...]:
    width = None if verdict is None else verdict.half_width
    return (
        label,
        value_text(value),
        "" if width is None else f"± {width:.2g}",
        "" if truth is None else f"{truth:+g}",
        "" if truth is None or value is None else f"{abs(value - truth):.3g}",
        "" if verdict is None else verdict.verdict,
    )


def _lines(summary: Summary, recording: Recording, see: str) -> Iterator[tuple[str, str]]:
    """Yield what is said of a run in words, each with its subject.

    Parameters
    ----------
    summary : Summary
    recording : Recording
    see : str
        What shows how large a coupling error is.
    """
    yield from _of_times(summary)
    start = recorded_start(recording)
    for own in summary.identifications:
        label = _label("identification", own.component, summary.identifications)
        yield from own.lines(label, start, summary.end)
    for design in summary.reconstructions:
        label = _label("reconstruction", design.component, summary.reconstructions)
        yield from design.lines(label)
    for model in summary.compensations:
        label = _label("internal model", model.component, summary.compensations)
        yield from model.lines(label)
    yield from _of_loops(summary, see)
    if summary.lateness is not None:
        yield "real time", str(summary.lateness)
    for component, class_name in summary.copied_code.items():
        text = f"replayed from the log; {flag('allow_code')} runs {class_name} instead"
        yield component, text
    if recorded_window(recording) is not None:
        yield "window", f"rows from {summary.start:.12g} s on; computed from {start:g} s"


def _label(what: str, component: str, parts: Sequence[object]) -> str:
    return what if len(parts) == 1 else f"{what} ({component})"


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


def _wall_time(wall: Mapping[str, float], simulated: float) -> str:
    total = sum(wall.values())
    parts = ", ".join(f"{part} {seconds:.2f} s" for part, seconds in wall.items())
    speed = simulated / (total - wall.get("imports", 0.0))
    return f"{total:.2f} s ({parts}), {speed:.3g} x real time"


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
    for own in certificate.signals:
        size, prefix = (own.bound, "at most ") if own.is_bounded else (own.largest, "")
        remark = own.reason
        if size is None:
            remark = f"no estimate: {own.reason}"
        elif own.order is None and not own.is_bounded:
            remark = "identical in all three runs"
        row = (
            own.signal,
            "" if size is None else f"{prefix}{size:.3g} {own.unit or ''}".rstrip(),
            "" if own.time is None else f"{own.time:g} s",
            "" if own.last is None else f"{own.last:+.3g}",
            "" if own.order is None else f"{own.order:.2f}",
            remark,
        )
        rows.append(row)
    columns = ("signal", "largest", "at t", "at the end", "order", "remark")
    below = [("no estimate", certificate.problem)]
    if not certificate.problem:
        below = [(share.estimate, str(share)) for share in certificate.shares]
        below += [("note", note) for note in certificate.notes()]
    tables = [
        new_table("search for the communication step", ("", ""), certificate.search()),
        new_table(title, columns, rows),
        new_table("" if rows else title, ("", ""), below),
    ]
    return [table for table in tables if table.rows]
