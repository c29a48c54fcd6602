"""Several runs side by side: a scenario on several plants, its data by several estimators, replays.

A run that fails is an outcome like the others, with its reason.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from itertools import chain, count
from pathlib import Path
from typing import Any, Final, TypeAlias, TypeVar

import numpy as np

from cosim.arguments import (
    callable_argument,
    mapping_argument,
    path_argument,
    setting_arguments,
    swap_argument,
    truth_argument,
)
from cosim.arrays import Vector, as_columns
from cosim.core.port import named_ports, split_element
from cosim.core.recorded.run import RecordedRun
from cosim.core.recorders import Memory
from cosim.errors import CosimError, Interrupted, UsageError, flag, nearest, option, quoted
from cosim.files import file_type
from cosim.log import Log, open_log
from cosim.report.recorded_rows import difference, stacked_rows_of
from cosim.report.summary import Summary, summarize
from cosim.scenario.document.document import component_in, short
from cosim.scenario.document.swaps import (
    PortNames,
    component_table,
    marked_path,
    port_names,
)
from cosim.scenario.kinds.base import Scenario
from cosim.scenario.kinds.identification import IdentifierKind
from cosim.scenario.kinds.variants import METHODS, IdentificationMethod, foreign_keys
from cosim.scenario.record import recorded_identification, truth_of
from cosim.scenario.recordings.recording import Progress, Target, check_target
from cosim.scenario.running.combinations import check_varied, combination_text, combinations
from cosim.scenario.running.execution import load, run
from cosim.scenario.running.replay import Replays, replay, replays_of
from cosim.temporary import TemporaryFolder
from cosim.theory.documents import ParameterVerdict
from cosim.theory.quantiles import CONFIDENCE, normal_two_sided

ALL: Final = "all"  # estimators
ERROR: Final = " error"  # after the name of what it is of
HALF_WIDTH: Final = " half-width"
LARGEST_ERROR: Final = " largest error"
SweepValue: TypeAlias = float | str | None
_Made = TypeVar("_Made")


def _attempt(make: Callable[[], _Made]) -> tuple[_Made | None, str]:
    """Return what is made, or why it failed, whatever it is: the others go on."""
    try:
        return make(), ""
    except Interrupted:
        raise
    except CosimError as error:
        return None, str(error)


def _targets(
    out: str | Path | None, names: Sequence[str], check: Callable[[Path | None], None]
) -> list[Path | None]:
    """Return where the log of each run goes, all of them checked; None: nowhere."""
    logs: list[Path | None] = [None] * len(names)
    if out is not None:
        folder = path_argument("out", out)
        if file_type(folder) is not None or (folder.exists() and not folder.is_dir()):
            found = quoted(str(out))
            raise UsageError(f"{option('out')}: expected a folder for the logs, got {found}")
        logs = [folder / f"{name}.mcap" for name in names]
    for log in logs:
        check(log)
    return logs


def _path_of(recording: Log | Memory | None) -> str | None:
    """Return where a run was recorded; None: nowhere that is there still."""
    if isinstance(recording, Log) and recording.is_at_its_path:
        return str(recording.path)
    return None


# --- plants ---


@dataclass(frozen=True)
class PlantRun:
    """The run of one plant.

    Parameters
    ----------
    label : str
        Its name in tables and pictures, and of its log.
    recording : Log, Memory or None
        None: the run failed.
    error : str
        Why it failed; empty: it did not.
    """

    label: str
    recording: Log | Memory | None
    error: str = ""


@dataclass(frozen=True)
class EstimateDifference:
    """An estimate of one plant against that of the first.

    Parameters
    ----------
    estimate, label : str
    largest : tuple of float or None
        Largest |difference| of each element where both have a value; None: one never has.
    """

    estimate: str
    label: str
    largest: tuple[float | None, ...]


@dataclass(frozen=True)
class Comparison:
    """Several plants in one scenario, the failed ones included."""

    scenario: str
    component: str
    outcomes: tuple[PlantRun, ...]

    @cached_property
    def recordings(self) -> dict[str, RecordedRun]:
        """The runs that did not fail, by label."""
        return {one.label: one.recording for one in self.outcomes if one.recording is not None}

    @cached_property
    def estimates(self) -> dict[str, Any]:
        """The estimates with their truth, in the order of the scenario."""
        estimates: dict[str, Any] = {}
        for recording in self.recordings.values():
            for estimate, truth in truth_of(recording).items():
                estimates.setdefault(estimate, truth)  # the names of the first plant that has it
        return estimates

    @cached_property
    def summaries(self) -> dict[str, Summary]:
        """The summary of each run, by label."""
        return {label: summarize(recording) for label, recording in self.recordings.items()}

    @cached_property
    def differences(self) -> list[EstimateDifference]:
        """The distance of every estimate from that of the first run, at their shared instants."""
        reference, *others = self.recordings or [""]
        differences: list[EstimateDifference] = []
        for estimate in self.estimates:
            for label in others:
                first = self.recordings[reference]
                other = self.recordings[label]
                if estimate in first and estimate in other:
                    _, values = difference(first, other, estimate)
                    finite = np.isfinite(values)
                    largest = np.abs(values).max(axis=0, where=finite, initial=-1.0).tolist()
                    known = tuple(None if one < 0.0 else one for one in largest)
                    differences.append(EstimateDifference(estimate, label, known))
        return differences

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        plants = []
        for outcome in self.outcomes:
            summary = self.summaries.get(outcome.label)
            plants.append(
                {
                    "plant": outcome.label,
                    "error": outcome.error or None,
                    "log": _path_of(outcome.recording),
                    "summary": None if summary is None else summary.to_dict(),
                }
            )
        return {
            "scenario": self.scenario,
            "component": self.component,
            "plants": plants,
            "differences": [asdict(row) for row in self.differences],
        }


def compare(
    scenario: str | Path | Scenario,
    *,
    swap: Mapping[str, Sequence[str | Path]],
    map: Mapping[str, PortNames] | None = None,
    set: Mapping[str, Any] | None = None,
    base: bool = True,
    out: str | Path | None = None,
    force: bool = False,
) -> Comparison:
    """Run a scenario with each of several plants.

    Parameters
    ----------
    scenario : str, Path or Scenario
        A shipped name, a path, or what :func:`load` returned.
    swap : mapping of one component to the paths of its alternatives
        Each an FMU (``x.fmu``, ``x.fmu#me``, ``x.fmu#cs``) or a recorded log.
    map : mapping of port to names, optional
        As for :func:`run`. An entry is for every alternative that has a port of that name; the
        others keep the scenario's.
    set : mapping of dotted key to value, optional
        For all of them, but what is set for the component itself is for its alternatives only.
    base : bool
        Run the scenario as it is too, as the first.
    out : str or Path, optional
        Folder for the logs, ``<label>.mcap``; without it the runs are kept in memory.
    force : bool
        Replace existing logs.

    Raises
    ------
    UsageError
        If there is not one component, fewer than two plants, a path that no plant has, or an entry
        of ``map`` or ``set`` that none of them can use. Other problems of a single plant are its
        outcome.
    """
    force = truth_argument("force", force)
    base = truth_argument("base", base)
    loaded = scenario if isinstance(scenario, Scenario) else load(scenario)
    component, paths = _alternatives(swap, base=base)
    changes = mapping_argument("set", set)
    of_others = {key: changes[key] for key in changes if component_in(short(key)) != component}
    common = loaded.edit(set=of_others)  # a problem of all plants is raised once
    document = loaded.document.with_changes(changes)
    maps = _maps_by_path(component, paths, mapping_argument("map", map))
    plants: list[tuple[Scenario | None, str]] = []
    for path in paths:
        swapped = document.with_swaps({component: path}, maps[path])
        plants.append(_attempt(partial(loaded.parse, swapped)))
    if all(plant is None for plant, _ in plants):
        raise UsageError("\n".join(dict.fromkeys(error for _, error in plants)))
    labels = [_label(path) for path in paths]
    if base:
        labels.insert(0, loaded.specs[component].kind)
        plants.insert(0, (common, ""))
    labels = _distinct(labels)
    names = [label.replace("#", "-") for label in labels]
    logs = _targets(out, names, partial(check_target, force=force))
    outcomes = []
    for label, (plant, error), log in zip(labels, plants, logs, strict=True):
        recording = None
        if plant is not None:
            recording, error = _attempt(partial(run, plant, out=log, force=force))
        outcomes.append(PlantRun(label, recording, error))
    return Comparison(loaded.name, component, tuple(outcomes))


def _label(path: str) -> str:
    """Return ``x`` for x.fmu and x.mcap, ``x#cs`` for x.fmu#cs."""
    file, _, interface_type = path.rpartition("#")
    return f"{Path(file).stem}#{interface_type}" if file_type(file) == "FMU" else Path(path).stem


def _distinct(labels: Iterable[str]) -> list[str]:
    """Append a number to labels that occur before."""
    distinct: list[str] = []
    for label in labels:
        numbered = (f"{label}-{number}" for number in count(2))
        distinct.append(next(name for name in chain([label], numbered) if name not in distinct))
    return distinct


def _alternatives(swap: Mapping[str, Sequence[str | Path]], *, base: bool) -> tuple[str, list[str]]:
    """Return the component that is swapped, and the paths of files that can take its place."""
    swap = swap_argument(swap)
    if len(swap) != 1:
        raise UsageError(
            f"{option('swap')}: expected alternatives of one component, such as a.fmu and b.fmu "
            f"of plant, got alternatives of {', '.join(swap) or 'none'}"
        )
    ((component, paths),) = swap.items()
    place = option("swap", component)
    if isinstance(paths, str) or not isinstance(paths, Sequence):
        raise UsageError(f"{place}: expected a list of paths, got {quoted(paths)}")
    if len(paths) + base < 2:
        raise UsageError(
            f"{place}: expected two plants to compare, got one; give another, or omit "
            f"{flag('base', False)}"
        )
    listed = [marked_path(str(path_argument("swap", path))) for path in paths]
    errors = [_attempt(partial(component_table, component, path))[1] for path in listed]
    if any(errors):
        raise UsageError("\n".join(f"{place}: {error}" for error in errors if error))
    return component, listed


def _maps_by_path(
    component: str, paths: Sequence[str], maps: Mapping[str, PortNames]
) -> dict[str, dict[str, PortNames]]:
    """Return for each alternative the entries whose names are ports of it.

    What else may be wrong with them is the outcome of its run.

    Raises
    ------
    UsageError
        If a name is none of a port of any.
    """
    if not maps:
        return {path: {} for path in paths}  # without a look into the files
    listed = {port: port_names(names) for port, names in maps.items()}
    mapped = list(chain.from_iterable(listed.values()))
    ports = {path: _ports(component, path, mapped) for path in paths}
    known = list(dict.fromkeys(chain.from_iterable(ports.values())))
    problems = []
    for port, names in listed.items():
        for name in names:
            if not _is_port(name, known):
                problem = f"no alternative has a port {name!r}; {nearest(name, known)}"
                problems.append(f"{option('map', port)}: {problem}")
    if problems:
        raise UsageError("\n".join(problems))
    return {
        path: {
            port: maps[port]
            for port, names in listed.items()
            if all(_is_port(name, ports[path]) for name in names)
        }
        for path in paths
    }


def _is_port(name: str, ports: Collection[str]) -> bool:
    """Return whether a name is that of a port, or of elements of one."""
    return name in ports or split_element(name)[0] in ports


def _ports(component: str, path: str, mapped: Sequence[str]) -> list[str]:
    """Return the ports of an alternative; none where it cannot be read: its run says why.

    Of an MCAP of another tool these are the mapped fields of its topics.
    """
    from cosim.fmi.reading.model_description import read
    from cosim.log.foreign.topics import read_channels
    from cosim.scenario.data_files.field_file import field_data

    table = component_table(component, path)
    try:
        if table["kind"] == "fmu":
            return [one.name for one in read(table["path"]).description.interface.signals]
        if table["kind"] == "recording":
            channel = open_log(table["log"]).channels.get(component)
            return [] if channel is None else list(channel.by_name)
        if file_type(table["path"]) == "log":
            topics = tuple(channel.topic for channel in read_channels(Path(table["path"])))
            return [name for name in mapped if name.lstrip('"').startswith(topics)]
        return [signal.name for signal in field_data(Path(table["path"])).signals]
    except CosimError:
        return []


# --- estimators ---


@dataclass(frozen=True, eq=False, kw_only=True)
class EstimatorResult:
    """What one method makes of the data, at the end of the run.

    Parameters
    ----------
    method : str
    recording : Log, Memory or None
        Its replay; None: that failed.
    failure : str
        Why it failed; empty: it did not.
    time_ratio : float or None
        Wall time of the identifier over that of all other components in the run.
    theta : Vector, shape (P,), or None
        NaN: no value.
    standard_error : Vector, shape (P,), or None
        None: the method has none.
    error : Vector, shape (P,), or None
        theta less the truth; None: there is no [truth].
    verdicts : tuple of ParameterVerdict
        What output error says of each theta; empty: nothing is said.
    """

    method: str
    recording: Log | Memory | None = None
    failure: str = ""
    time_ratio: float | None = None
    theta: Vector | None = None
    standard_error: Vector | None = None
    error: Vector | None = None
    verdicts: tuple[ParameterVerdict, ...] = ()

    @property
    def half_width(self) -> Vector:
        """Half of the 95 % intervals, shape (P,); NaN where there is none that may hold."""
        assert self.theta is not None
        if self.verdicts:
            return np.array([one.half_width for one in self.verdicts], np.float64)
        if self.standard_error is None:
            return np.full(len(self.theta), np.nan)
        return normal_two_sided(CONFIDENCE) * self.standard_error

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; None where there is no value."""
        return {
            "method": self.method,
            "failure": self.failure or None,
            "theta": _plain(self.theta),
            "standard_error": _plain(self.standard_error),
            "error": _plain(self.error),
            "time_ratio": self.time_ratio,
            "verdicts": [asdict(verdict) for verdict in self.verdicts],
            "log": _path_of(self.recording),
        }


def _plain(values: Vector | None) -> list[float | None] | None:
    if values is None:
        return None
    return [value if np.isfinite(value) else None for value in values.tolist()]


@dataclass(frozen=True)
class EstimatorComparison:
    """Several methods of one identifier, the failed ones included."""

    scenario: str
    component: str
    results: tuple[EstimatorResult, ...]

    @cached_property
    def recordings(self) -> dict[str, RecordedRun]:
        """The replays that did not fail, by method."""
        return {one.method: one.recording for one in self.results if one.recording is not None}

    @cached_property
    def estimates(self) -> dict[str, Any]:
        """theta with its truth, where there is one."""
        theta = f"{self.component}.theta"
        truths = [truth_of(recording).get(theta) for recording in self.recordings.values()]
        return next(({theta: truth} for truth in truths if truth is not None), {})

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; None where there is no value."""
        methods = [result.to_dict() for result in self.results]
        return {"scenario": self.scenario, "component": self.component, "methods": methods}


def compare_estimators(
    scenario: str | Path | Scenario,
    *,
    estimators: str | Sequence[str] = ALL,
    swap: Mapping[str, str | Path] | None = None,
    map: Mapping[str, PortNames] | None = None,
    set: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
    force: bool = False,
) -> EstimatorComparison:
    """Run a scenario once, and estimate theta from what it recorded by several methods.

    Parameters
    ----------
    scenario : str, Path or Scenario
        A shipped name, a path, or what :func:`load` returned; with one identifier.
    estimators : str or sequence of str
        Methods of the kind ``identifier``, or ``"all"``. Keys of the identifier that a method does
        not have are left out for it.
    swap, map, set
        As for :func:`run`.
    out : str or Path, optional
        Folder for the logs, ``<scenario>.mcap`` of the run and ``<method>.mcap`` of each replay;
        without it the replays are kept in memory.
    force : bool
        Replace existing logs.

    Raises
    ------
    UsageError
        If there is not one identifier, or no such method.
    CosimError
        If the run fails. What fails with one method is its result.
    """
    force = truth_argument("force", force)
    methods = _methods(estimators)
    loaded = scenario if isinstance(scenario, Scenario) else load(scenario)
    edited = loaded.edit(swap=swap, map=map, set=mapping_argument("set", set))
    component = _identifier(edited)
    table = edited.document.tables().tree["components"][component]
    targets = _targets(out, [edited.name, *methods], partial(check_target, force=force))
    results = []
    with ExitStack() as resources:
        path = targets[0]
        if path is None:
            path = resources.enter_context(TemporaryFolder("compare")) / f"{edited.name}.mcap"
        times: dict[str, float] = {}
        log = run(edited, out=path, force=force, profile=times)
        assert isinstance(log, Log)
        others = sum(times.get(name, 0.0) for name in edited.specs if name != component)
        for method, target in zip(methods, targets[1:], strict=True):
            foreign = foreign_keys(METHODS, method)
            own = {key: value for key, value in table.items() if key not in foreign}
            changes = {component: {**own, "method": method}}
            times = {}
            again, failure = _attempt(
                partial(replay, log, set=changes, out=target, force=force, profile=times)
            )
            if again is None:
                results.append(EstimatorResult(method=method, failure=failure))
            else:
                ratio = times[component] / others if others > 0.0 else None
                results.append(_result(method, again, component, ratio))
    return EstimatorComparison(edited.name, component, tuple(results))


def _methods(estimators: str | Sequence[str]) -> list[IdentificationMethod]:
    """Return the methods of these names."""
    if estimators == ALL:
        return list(METHODS)
    place = option("estimators")
    names = [estimators] if isinstance(estimators, str) else list(estimators)
    for name in names:
        if name not in METHODS:
            suggestion = nearest(str(name), [*METHODS, ALL])
            raise UsageError(f"{place}: no method {quoted(name)}; {suggestion}")
        if names.count(name) > 1:
            raise UsageError(f"{place}: {name} is given twice")
    if not names:
        raise UsageError(f"{place}: expected {ALL}, or some of: {tuple(METHODS)}; got none")
    known: dict[str, IdentificationMethod] = {method: method for method in METHODS}
    return [known[name] for name in names]


def _identifier(scenario: Scenario) -> str:
    """Return the name of the one identifier."""
    names = [name for name, spec in scenario.specs.items() if isinstance(spec, IdentifierKind)]
    if len(names) != 1:
        raise UsageError(
            f"{option('estimators')}: expected one component of kind 'identifier', got "
            f"{', '.join(names) or 'none'}"
        )
    return names[0]


def _result(
    method: str, recording: Log | Memory, component: str, time_ratio: float | None
) -> EstimatorResult:
    port = f"{component}.theta"
    theta = _last(recording, port)
    if theta is None:
        theta = np.zeros(0)  # no term has a parameter
    true = truth_of(recording).get(port)
    if true is not None and named_ports(true):
        _, rows = stacked_rows_of(recording, named_ports(true), like=port)
        true = rows[-1] if len(rows) else np.nan
    verdicts = recorded_identification(recording).get(component)
    return EstimatorResult(
        method=method,
        recording=recording,
        time_ratio=time_ratio,
        theta=theta,
        standard_error=_last(recording, f"{component}.standard_error"),
        error=None if true is None else theta - np.array(true, np.float64),
        verdicts=() if verdicts is None else verdicts.estimate,
    )


def _last(recording: Log | Memory, port: str) -> Vector | None:
    """Return the last row of a port; None: there is none."""
    if port not in recording:
        return None
    rows = as_columns(recording[port])
    last: Vector = rows[-1].copy() if len(rows) else np.full(rows.shape[1], np.nan)
    return last


# --- replays ---


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
        return tuple(dict.fromkeys(chain.from_iterable(row.results for row in self.rows)))

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
    stop: float | None = None,
    verdicts: bool | None = None,
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
    swap, map, allow_code, rerun, window, components, scenario, stop, verdicts
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
    with setting_arguments(set, stop=stop, verdicts=verdicts) as changes:
        replays = replays_of(
            log,
            set=changes,
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
    names = [str(number) for number in range(1, len(rows) + 1)]
    targets = _targets(out, names, partial(replays.check_target, force=force))
    for values in rows:
        try:
            replays.check(values)
        except UsageError as error:
            text = str(error)
            if len(values) == 1:
                text = text.removeprefix(f"{option('set', next(iter(values)))}: ")
            raise UsageError(f"{combination_text(values)}: {text}") from error
    done = []
    for number, (values, path) in enumerate(zip(rows, targets, strict=True)):
        part = None
        if progress is not None:
            part = partial(_part, progress, number, len(rows))
        again, problem = _attempt(
            partial(replays.record, values, Target(path, force), progress=part)
        )
        summary = None if again is None else summarize(again)
        done.append(SweepRow(values, summary, problem, path))
    return ReplaySweep(replays.label, tuple(rows[0]), tuple(done))


def _part(progress: Progress, number: int, count: int, time: float, end: float) -> None:
    """Report the progress of one replay as a part of that of all."""
    progress(number * end + time, count * end)
