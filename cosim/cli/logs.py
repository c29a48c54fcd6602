"""The commands on logs: what they contain, how they differ, and what is made of them."""

from __future__ import annotations

import re
import sys
from itertools import compress
from pathlib import Path
from typing import Final

import cosim
from cosim.cli.command import Given, command
from cosim.cli.options import check_plot, live_server, shared
from cosim.errors import CosimError, UsageError
from cosim.options import Rule
from cosim.report.printable import print_notice, print_text, printable
from cosim.terminal import ended_by_interrupt

# NAME=EXPRESSION; an expression may have == and >= in it
_NAMED: Final = re.compile(r"\s*([^()<>=!'\",]*[^()<>=!'\",\s])\s*=(?!=)(.*)", re.DOTALL)

# --- what they contain ---


@command(
    {
        **shared("log"),
        "--signals": "Also print a hash of times and values for each signal.",
        **shared("json"),
    }
)
def hash_(given: Given) -> bool:
    """Print the content hash of a log.

    It covers the declaration of every signal (name, unit, role, ...), its times and values;
    compression and chunking do not change it. Exit 1 if the log records another hash.
    """
    from cosim.report.tables.console import print_json

    opened = cosim.open_log(given.log)
    hashes = opened.signal_hashes() if given.signals else {}
    found = opened.content_hash()
    recorded = opened.metadata.get("cosim.result", {}).get("content_hash")
    if given.json:
        content = {"content_hash": found, "recorded": recorded, "equal": found == recorded}
        print_json({**content, "signals": hashes} if given.signals else content)
    else:
        for name, digest in {str(opened.path): found, **hashes}.items():
            print_text(f"{digest}  {name}")
    if recorded is None:
        print_notice(f"{opened.path}: no content hash was recorded")
        return False
    if found != recorded:
        print_notice(
            f"{opened.path}: the content hash differs from the recorded {recorded}: its signals "
            "were changed after recording"
        )
    return bool(found != recorded)


@command(
    {
        **shared("recording"),
        "expressions [NAME=]EXPRESSION : list[str] = None": "Expressions as in [metrics] of a "
        "study, such as 'rms(observer.delta - delta.y, t > 5)'.",
        "--of DIR : str": "Compute the metrics of the study with this dataset.",
        **shared("json"),
    }
)
def metrics(given: Given) -> None:
    """Compute metrics of a log, with all digits.

    The values are bit for bit those of a study with this run.
    """
    from cosim.report.tables.console import section_tables
    from cosim.report.tables.logs import opened_recording
    from cosim.studies.metrics import missing_rows, open_whole, parse_metrics

    texts = {} if given.of is None else _metrics_of(given.of, str(given.log))
    for text in given.expressions or ():
        named = _NAMED.fullmatch(text)
        name, expression = (text, text) if named is None else named.groups()
        if name in texts:
            raise UsageError(f"metric '{name}': given twice")
        texts[name] = expression.strip()
    if not texts:
        raise UsageError(
            "expected an expression, such as 'rms(plant.y)', or --of, the dataset of a study "
            "with metrics"
        )
    parsed = parse_metrics(texts)
    opened = open_whole(opened_recording(given.log))
    values = parsed.of(opened)
    lacking = missing_rows(parsed, opened)
    if lacking:
        print_notice(f"{lacking}; metrics of the whole run, as in a study, may differ")
    shown = {name: "no value" if value is None else repr(value) for name, value in values.items()}
    given.print_shown(iter([values, section_tables([("", shown)])]))


def _metrics_of(place: str, log: str) -> dict[str, str]:
    """Return the metrics of a study by its dataset; notice a log that is none of its scenario."""
    from cosim.studies.checking import check_is_of_scenario
    from cosim.studies.plan import RecordedStudy
    from cosim.studies.study_file import load_scenario

    study = RecordedStudy.read(cosim.open_study(place).text).study
    try:
        check_is_of_scenario(log, load_scenario(study.scenario))
    except CosimError as error:
        print_notice(f"these may not be metrics of a member of {place}: {error}")
    if not study.metrics:
        raise UsageError(
            f"--of {place}: this study has no metrics, only results of runs; see 'cosim info LOG'"
        )
    return dict(study.metrics)


@command(
    {
        "sources LOG... [SIGNAL]... : list[str]": "Logs, tables or MCAPs of other tools, then "
        "signals or elements, one panel each: plant.y plant.x_a[0]. Joined by commas they share a "
        "panel: plant.y,observer.y. Without signals: the standard picture of a log.",
        **shared("picture size"),
        "--from T : float": "First time shown [s].",
        "--to T : float": "Last time shown [s].",
        **shared("title"),
    }
)
def plot(given: Given) -> None:
    """Plot signals of one or several logs over time."""
    from cosim.report.plots.picture import PictureOptions
    from cosim.report.plots.runs import plot_run, plot_signals
    from cosim.report.tables.logs import opened_recording
    from cosim.scenario.data_files.recording_file import is_recording

    options = PictureOptions(given.size, given.from_, given.to, given.title)
    is_file = list(map(is_recording, given.sources))
    logs = [opened_recording(source) for source in compress(given.sources, is_file)]
    signals = [source for source, is_log in zip(given.sources, is_file, strict=True) if not is_log]
    if not logs:
        raise UsageError(f"expected a log (.mcap) or a table (.csv, ...), got {', '.join(signals)}")
    if signals:
        plot_signals(logs, signals, given.out, options)
    elif len(logs) == 1:
        plot_run(logs[0], given.out, options)
    else:
        raise UsageError("several logs have no standard picture; name the signals to plot")
    print_text(given.out)


@command(
    {
        **shared("log"),
        "signals [SIGNAL]... : list[str] = None": "Components, signals or patterns, such as "
        "'*.delta'; their whole channels are played. Default: all.",
        "--speed FACTOR : float = 1.0": "Simulated time per wall time.",
        "--loop": "Repeat until Ctrl-C.",
        "--wait": "Wait for a viewer before playing.",
        **shared("viewers"),
        "--layout FILE : Path": "Write the plot layout of the log for import by viewers (.json).",
    }
)
def play(given: Given) -> None:
    """Play a log in Foxglove or Lichtblick in real time.

    Connect the viewer to the printed address (Foxglove WebSocket). Prints at the end how late the
    playback was.
    """
    from cosim.live.playback import Playback
    from cosim.log.viewer_layout import LAYOUT_FILE
    from cosim.scenario.recordings.recording import interruptible

    log = cosim.open_log(given.log)
    if given.layout is not None:
        content = log.attachment(LAYOUT_FILE)
        try:
            with given.layout.open("xb") as file:
                file.write(content)
        except FileExistsError as error:  # it may be somebody's own layout
            raise UsageError(f"--layout {given.layout}: exists; choose another path") from error
    with interruptible() as check, live_server(given, given.signals) as server:
        playback = Playback(log, server, speed=given.speed, check=check)
        print_text(f"{server.url}: {given.log}, {given.speed:g} x the wall clock")
        try:
            if given.wait:
                server.wait_for_viewer(check)
            playback.run(loop=given.loop)
        finally:
            print_text(playback.lateness)


# --- how they differ ---


@command(
    {
        "a A : Path": "A log, a table or an MCAP of another tool.",
        "b B : Path": "Another one.",
        "signals [SIGNAL]... : list[str] = None": "Signals to compare, elements or patterns: "
        "plant.y plant.x_a[0:2] '*.delta'. All by default.",
        "--atol : float = 0.0": "Absolute tolerance.",
        "--rtol : float": "Tolerance relative to the largest value of each signal. [default: 0.0]",
        "--tol SIGNAL=VALUE : numbers": "Absolute tolerance of the signals that match a pattern, "
        "instead of --atol and --rtol: '*.delta=1e-3'. If several patterns match, the last one "
        "counts. Repeatable.",
        "--map SIGNAL=NAME : pairs": "Compare a signal of A with one of another name in B: "
        "table.level=tank.y. Repeatable.",
        "--interpolate": "Compare at all instants of A that lie within B: between its rows a "
        "continuous signal of B is a straight line, any other keeps its value. Events are not "
        "compared.",
        "--tube WIDTH[,PERCENT] : tube": "A value of A is right if B has it at some instant no "
        "farther away, within a part of the largest value, and one of B if A has it: 0.02s,0.5%. "
        "Implies --interpolate.",
        "--plot FILE : Path": "Plot the signal that differs most.",
        **shared("json"),
    },
    Rule("tube", "brings its own relative tolerance", excludes="rtol"),
)
def diff(given: Given) -> bool:
    """Compare two logs signal by signal.

    Exit 1 if a signal is outside the tolerance.
    """
    from cosim.report.tables.logs import opened_recording, show_difference

    check_plot(given.plot)
    logs = opened_recording(given.a), opened_recording(given.b)
    signals = given.signals or ()
    width, part = given.tube or (0.0, 0.0)
    difference = cosim.diff(
        *logs,
        signals=signals,
        rtol=part if given.rtol is None else given.rtol,
        interpolate=given.interpolate or given.tube is not None,
        tube=width,
        **given.only("atol tol map"),
    )
    given.print_shown(show_difference(difference))
    if given.plot is not None and difference.worst is None:
        print_notice(f"{given.plot}: not drawn, as the largest difference of two values is 0")
    elif given.plot is not None:
        from cosim.report.plots.runs import plot_difference

        plot_difference(difference, logs, given.plot)
        if not given.json:
            print_text(given.plot)
    return not difference.within


# --- for other tools ---


@command(
    {
        **shared("recording signals span"),
        "--format csv|jsonl : str = 'csv'": "CSV or JSON Lines.",
        "--follow": "Keep printing rows as a run flushes them to the log (polled every 0.2 s), "
        "until the run ends. The log must exist.",
    }
)
def cat(given: Given) -> None:
    """Print the rows of a log as CSV or JSON Lines.

    Components with several rates share one table: a row for every sampling instant, with empty
    cells (JSON Lines: omitted keys) for components without a sample there.
    """
    from cosim.log.text import LogChoice, TextSource, choose, rows_text, table_text

    table: TextSource
    chosen = (given.signals, given.from_, given.to)
    if given.follow:
        from cosim.log.following import FollowedLog

        table = FollowedLog(given.log, *chosen)
    else:
        from cosim.report.tables.logs import opened_recording

        recording = opened_recording(given.log)
        table = choose(recording, *chosen)
    lines = table_text(table, given.format)
    is_terminal = sys.stdout.isatty()
    printed = 0
    with ended_by_interrupt(quietly=given.follow):
        for text in lines:
            shown = printable(text) if is_terminal else text
            sys.stdout.buffer.write(shown.encode())
            if given.follow:
                sys.stdout.buffer.flush()
            printed += 1
    has_rows = printed > (given.format == "csv")  # more than the header
    if isinstance(table, LogChoice) and table.run is not recording and not has_rows:
        known = f"{given.log} has {rows_text(recording)}"
        print_notice(f"{table.run.label}: no rows in this span; {known}")


@command(
    {
        **shared("recording"),
        "out OUT : Path": "File to write: .csv, .parquet, .mat or .npz.",
        **shared("signals span force-file"),
    }
)
def convert(given: Given) -> None:
    """Convert a log to CSV, Parquet, MAT or NumPy's npz.

    CSV and Parquet contain the rows of 'cosim cat'; .mat and .npz contain one array per signal and
    one array of times per component.
    """
    from cosim.log.conversion import convert as convert_log
    from cosim.log.files import check_not_read
    from cosim.log.text import choose
    from cosim.report.tables.logs import opened_recording

    check_not_read(given.out, [given.log])
    chosen = choose(opened_recording(given.log), given.signals, given.from_, given.to)
    for note in convert_log(chosen, given.out, force=given.force):
        print_notice(note)
    print_text(given.out)


# --- logs from logs ---


def _check_is_log(out: Path) -> None:
    """Refuse the path of a file that ``cosim convert`` writes."""
    from cosim.log.conversion import ENDINGS

    if out.suffix.lower() in ENDINGS:
        raise UsageError(
            f"--out {out}: expected a path of a log (.mcap), got {out.suffix!r}; 'cosim convert' "
            f"writes {', '.join(ENDINGS)}"
        )


@command(shared("log new-log span force"))
def cut(given: Given) -> None:
    """Copy a time span of a log to a new log.

    The new log is marked as partial; 'cosim merge' joins such parts.
    """
    from cosim.log.spans import cut as cut_log
    from cosim.report.tables.logs import ended

    _check_is_log(given.out)
    span = (given.from_, given.to)
    if span == (None, None):
        raise UsageError("expected --from, --to or both")
    names = ("--from", "--to")
    print_text(ended(cut_log(given.log, *span, given.out, names=names, force=given.force)))


@command(
    {
        "logs LOG... : list[Path]": "Logs of consecutive parts of one run, in any order",
        **shared("new-log force"),
    }
)
def merge(given: Given) -> None:
    """Join logs of consecutive parts of one run.

    Logs of other runs, overlaps and gaps are refused.
    """
    from cosim.log.spans import merge as merge_logs
    from cosim.report.tables.logs import ended

    _check_is_log(given.out)
    print_text(ended(merge_logs(given.logs, given.out, force=given.force)))


@command({"log BROKEN : Path": "A damaged or truncated log.", **shared("new-log force json")})
def recover(given: Given) -> None:
    """Copy the intact parts of a damaged log to a new log.

    Keeps every chunk whose CRC matches, also after the damage, and shows which rows are lost.
    """
    from cosim.log.recovering import recover as recover_log
    from cosim.report.tables.logs import show_recovery

    _check_is_log(given.out)
    recovery = recover_log(given.log, given.out, force=given.force)
    given.print_shown(show_recovery(recovery))
