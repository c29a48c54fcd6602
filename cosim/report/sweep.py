"""What-if replays of one log in a row: what the result says for every combination of values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, TypeAlias

from cosim.arguments import callable_argument, path_argument, truth_argument
from cosim.errors import Interrupted, RunError, UsageError, option, quoted
from cosim.files import file_type
from cosim.log import Log, open_log
from cosim.report.summary import Identification, Summary, summarize
from cosim.scenario.document.edits import short
from cosim.scenario.document.swap import PortNames
from cosim.scenario.recordings.recording import Progress, Target, check_target
from cosim.scenario.recordings.replay_request import (
    ReplayRequest,
    check_replay_target,
    prepared_replay,
    record_replay,
    replay_request,
)
from cosim.scenario.running.combinations import combination_text, combinations

ERROR: Final = " error"  # behind the name of what it is of
HALF_WIDTH: Final = " half-width"
LARGEST_ERROR: Final = " largest error"
SweepValue: TypeAlias = float | str | None


@dataclass(frozen=True)
class SweepRow:
    """One replay of a sweep.

    Parameters
    ----------
    values : mapping of dotted key to value
        What was varied.
    summary : Summary or None
        None: the replay failed.
    problem : str
        Why it failed; empty: it did not.
    path : Path or None
        Of its log; None: none was written.
    """

    values: Mapping[str, Any]
    summary: Summary | None
    problem: str = ""
    path: Path | None = None

    @property
    def results(self) -> dict[str, SweepValue]:
        """What the result says, by column: see :func:`results_of`; empty where it failed."""
        return {} if self.summary is None else results_of(self.summary)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "values": dict(self.values),
            "results": self.results,
            "problem": self.problem or None,
            "log": None if self.path is None else str(self.path),
            "summary": None if self.summary is None else self.summary.to_dict(),
        }


@dataclass(frozen=True)
class ReplaySweep:
    """Replays of one log with varied values.

    Parameters
    ----------
    log : str
        Its path.
    varied : tuple of str
        The keys whose values differ.
    rows : tuple of SweepRow
        One a combination, in their order.
    """

    log: str
    varied: tuple[str, ...]
    rows: tuple[SweepRow, ...]

    @property
    def columns(self) -> tuple[str, ...]:
        """The names of all results that a row has."""
        names: dict[str, None] = {}
        for row in self.rows:
            names |= dict.fromkeys(row.results)
        return tuple(names)

    def __getitem__(self, column: str) -> list[SweepValue]:
        """Return a result in every row; None where there is none."""
        return [row.results.get(column) for row in self.rows]

    @property
    def passed(self) -> bool:
        """Whether no replay failed."""
        return not any(row.problem for row in self.rows)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "log": self.log,
            "varied": list(self.varied),
            "columns": list(self.columns),
            "rows": [row.to_dict() for row in self.rows],
        }


def results_of(summary: Summary) -> dict[str, SweepValue]:
    """Return what the result of a run says, by name.

    * of every estimate with a truth, and every parameter of an identifier: its value at the end;
      with ``error`` behind its name the distance from the truth, with ``half-width`` half of the
      95 % interval;
    * of every identifier: ``verdict``, those of its parameters, the same ones once; ``noise``, the
      deviation of the noise of y by the residual (of several outputs ``noise[0]``, ...);
    * of every estimated signal: ``rms error`` and ``largest error``, from the start of the
      identification on;
    * without a truth: the last values of the outputs.
    """
    results: dict[str, SweepValue] = {}
    for outcome in summary.values:
        results[outcome.estimate] = outcome.value
        results[f"{outcome.estimate}{ERROR}"] = outcome.error
    for identification in summary.identifications:
        results |= _identified(identification, results)
    for signal in summary.signals:
        results[f"{signal.estimate} rms error"] = signal.rms
        results[f"{signal.estimate}{LARGEST_ERROR}"] = signal.largest
    for name, last in summary.last.items():
        if isinstance(last, list):
            results |= {f"{name}[{number}]": value for number, value in enumerate(last)}
        else:
            results[name] = last
    return results


def _identified(
    identification: Identification, known: Mapping[str, SweepValue]
) -> dict[str, SweepValue]:
    """Return what is said of an identifier beside what is known already."""
    results: dict[str, SweepValue] = {}
    verdicts: dict[str, None] = {}
    for parameter in identification.parameters:
        if parameter.estimate not in known:
            results[parameter.estimate] = parameter.value
        results[f"{parameter.estimate}{HALF_WIDTH}"] = parameter.half_width
        verdicts[parameter.verdict] = None
    name = identification.component
    if verdicts:
        results[f"{name} verdict"] = ", ".join(verdicts)
    single = len(identification.deviation) == 1
    for number, deviation in enumerate(identification.deviation):
        results[f"{name} noise" if single else f"{name} noise[{number}]"] = deviation
    return results


def replay_sweep(
    log: str | Path | Log,
    *,
    vary: Mapping[str, Sequence[Any]],
    set: Mapping[str, Any] | None = None,
    swap: Mapping[str, str | Path] | None = None,
    map: Mapping[str, PortNames] | None = None,
    allow_code: bool = False,
    window: tuple[float | None, float | None] | None = None,
    components: Sequence[str] | None = None,
    out: str | Path | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> ReplaySweep:
    """Replay a log with every combination of some values: one log, many answers.

    All combinations are checked before the first is run. What is taken from the log is read once.

    Parameters
    ----------
    log : str, Path or Log
    vary : mapping of dotted key to sequence of values
        Such as ``{"identifier.P0": [1e3, 1e6], "observer.filter_rate": [100.0, 300.0]}``; there
        are at most 1000 combinations.
    set : mapping of dotted key to value, optional
        What all of them have; not what is varied.
    swap, map, allow_code, window, components
        As of :func:`cosim.replay`.
    out : str or Path, optional
        Folder for their logs, ``1.mcap``, ``2.mcap``, ... in the order of the rows; without it
        nothing is written.
    force : bool
        Replace logs there.
    progress : callable, optional
        Called with simulated time and end [s], of all replays together.

    Raises
    ------
    UsageError
        As from :func:`cosim.replay`, before the first replay; it names the combination.
    Interrupted
        If the user interrupts one.
    """
    callable_argument("progress", progress)
    force = truth_argument("force", force)
    source = log if isinstance(log, Log) else open_log(log)
    request = replay_request(
        source,
        set=set,
        swap=swap,
        map=map,
        allow_code=allow_code,
        window=window,
        components=components,
    )
    rows = combinations(vary)
    requests = [_with_values(request, values) for values in rows]
    paths = _log_paths(source, out, len(rows), force=force)
    for values, varied in zip(rows, requests, strict=True):
        _check(source, values, varied)
    done = []
    for number, (values, varied) in enumerate(zip(rows, requests, strict=True)):
        target = Target(paths[number], force)
        part = _part(progress, number, len(rows))
        done.append(_replayed(source, values, varied, target, part))
    return ReplaySweep(source.label, tuple(rows[0]), tuple(done))


def _with_values(request: ReplayRequest, values: Mapping[str, Any]) -> ReplayRequest:
    """Return a request with a combination of values.

    Raises
    ------
    UsageError
        If a key is varied that is set, too.
    """
    known = {short(key) for key in request.changes}
    for key in values:
        if short(key) in known:
            raise UsageError(
                f"found both {option('set', short(key))} and {option('vary', short(key))}; needed "
                "one of them"
            )
    return replace(request, changes={**request.changes, **values})


def _log_paths(
    source: Log, out: str | Path | None, count: int, *, force: bool
) -> list[Path | None]:
    """Return where the logs are written, in a folder that is made where there is none.

    Raises
    ------
    UsageError
        If it is no path of a folder, or one of the logs is there and not to be replaced.
    """
    if out is None:
        check_target(None, force=force)
        return [None] * count
    folder = path_argument("out", out)
    if file_type(folder) is not None or (folder.exists() and not folder.is_dir()):
        raise UsageError(
            f"{option('out')}: found {quoted(str(out))}; needed a folder for {count} logs"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{option('out')}: {folder}: {error.strerror}") from error
    paths: list[Path | None] = []
    for number in range(count):
        path = folder / f"{number + 1}.mcap"
        check_replay_target(source, path, force=force)
        paths.append(path)
    return paths


def _check(source: Log, values: Mapping[str, Any], request: ReplayRequest) -> None:
    """Build and prepare a replay, to find what is wrong with it before any is run.

    Raises
    ------
    UsageError
        If it cannot be run; names the combination.
    """
    try:
        with ExitStack() as resources:
            experiment = prepared_replay(source, request, resources)
            experiment.graph.prepare(experiment.clock.step_ns, experiment.designs)
    except UsageError as error:
        raise UsageError(f"{combination_text(values)}: {error}") from error


def _replayed(
    source: Log,
    values: Mapping[str, Any],
    request: ReplayRequest,
    target: Target,
    progress: Progress | None,
) -> SweepRow:
    """Replay a combination; what fails in the run is a row, too."""
    path = None if target.out is None else Path(target.out)
    try:
        again = record_replay(source, request, target, progress=progress)
    except Interrupted:
        raise
    except RunError as error:
        return SweepRow(values, None, str(error), path)
    return SweepRow(values, summarize(again), path=path)


def _part(progress: Progress | None, number: int, count: int) -> Progress | None:
    """Return what reports the progress of one replay as a part of that of all."""
    if progress is None:
        return None

    def part(time: float, end: float) -> None:
        progress(number * end + time, count * end)

    return part
