"""What-if replays of one log in a row: what the result says for every combination of values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias

from cosim.arguments import callable_argument, path_argument, truth_argument
from cosim.errors import Interrupted, RunError, UsageError, option, quoted
from cosim.files import file_type
from cosim.log import Log
from cosim.report.summary import Summary, summarize
from cosim.scenario.building.parsing import Scenario
from cosim.scenario.document.swaps import PortNames
from cosim.scenario.recordings.recording import Progress, Target
from cosim.scenario.running.combinations import check_varied, combination_text, combinations
from cosim.scenario.running.replay import Replays, replays_of

ERROR: Final = " error"  # after the name of what it is of
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
      with ``error`` after its name the distance from the truth, with ``half-width`` half of the
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
        name = identification.component
        verdicts = dict.fromkeys(one.verdict for one in identification.parameters)
        for parameter in identification.parameters:
            results.setdefault(parameter.estimate, parameter.value)
            results[f"{parameter.estimate}{HALF_WIDTH}"] = parameter.half_width
        if verdicts:
            results[f"{name} verdict"] = ", ".join(verdicts)
        results |= _elements(f"{name} noise", identification.deviation)
    for signal in summary.signals:
        results[f"{signal.estimate} rms error"] = signal.rms
        results[f"{signal.estimate}{LARGEST_ERROR}"] = signal.largest
    for name, last in summary.last.items():
        results |= _elements(name, last if isinstance(last, list) else [last])
    return results


def _elements(name: str, values: Sequence[float]) -> dict[str, SweepValue]:
    """Return values by name; of several each has its number."""
    if len(values) == 1:
        return {name: values[0]}
    return {f"{name}[{number}]": value for number, value in enumerate(values)}


def replay_sweep(
    log: str | Path | Log,
    *,
    vary: Mapping[str, Sequence[Any]],
    set: Mapping[str, Any] | None = None,
    swap: Mapping[str, str | Path] | None = None,
    map: Mapping[str, PortNames] | None = None,
    allow_code: bool = False,
    rerun: bool = False,
    window: tuple[float | None, float | None] | None = None,
    components: Sequence[str] | None = None,
    scenario: str | Path | Scenario | None = None,
    out: str | Path | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> ReplaySweep:
    """Replay a log with every combination of some values: one log, many answers.

    All combinations are checked before the first is run. What is taken from a log of cosim is read
    once.

    Parameters
    ----------
    log : str, Path or Log
        As of :func:`cosim.replay`: of a log that was rotated with the files before it.
    vary : mapping of dotted key to sequence of values
        Such as ``{"identifier.P0": [1e3, 1e6], "observer.filter_rate": [100.0, 300.0]}``; there
        are at most 1000 combinations.
    set : mapping of dotted key to value, optional
        What all of them have; not what is varied.
    swap, map, allow_code, rerun, window, components, scenario
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
    replays = replays_of(
        log,
        set=set,
        swap=swap,
        map=map,
        allow_code=allow_code,
        rerun=rerun,
        window=window,
        components=components,
        scenario=scenario,
    )
    return sweep_of(replays, vary, out=out, force=force, progress=progress)


def sweep_of(
    replays: Replays,
    vary: Mapping[str, Sequence[Any]],
    *,
    out: str | Path | None,
    force: bool,
    progress: Progress | None,
) -> ReplaySweep:
    """Replay with every combination of some values; parameters as of :func:`replay_sweep`."""
    rows = combinations(vary)
    check_varied(replays.changes, rows[0])
    folder = None if out is None else path_argument("out", out)
    paths = [None if folder is None else folder / f"{k + 1}.mcap" for k in range(len(rows))]
    if folder is not None and (
        file_type(folder) is not None or (folder.exists() and not folder.is_dir())
    ):
        found = quoted(str(out))
        raise UsageError(f"{option('out')}: expected a folder for {len(rows)} logs, got {found}")
    if folder is None or folder.exists():
        for path in paths:
            replays.check_target(path, force=force)
    for values in rows:
        _check(replays, values)
    if folder is not None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"{option('out')}: {folder}: {error.strerror}") from error
    done = []
    for number, (values, path) in enumerate(zip(rows, paths, strict=True)):
        part = _part(progress, number, len(rows))
        try:
            again = replays.record(values, Target(path, force), progress=part)
            done.append(SweepRow(values, summarize(again), path=path))
        except Interrupted:
            raise
        except RunError as error:  # what fails in the run is a row, too
            done.append(SweepRow(values, None, str(error), path))
    return ReplaySweep(replays.label, tuple(rows[0]), tuple(done))


def _check(replays: Replays, values: Mapping[str, Any]) -> None:
    """Build and prepare a replay, to find what is wrong with it before any is run.

    Raises
    ------
    UsageError
        If it cannot be run; names the combination.
    """
    try:
        replays.check(values)
    except UsageError as error:
        text = str(error)
        if len(values) == 1:
            text = text.removeprefix(f"{option('set', next(iter(values)))}: ")
        raise UsageError(f"{combination_text(values)}: {text}") from error


def _part(progress: Progress | None, number: int, count: int) -> Progress | None:
    """Return what reports the progress of one replay as a part of that of all."""
    if progress is None:
        return None
    return lambda time, end: progress(number * end + time, count * end)
