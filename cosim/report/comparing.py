"""Several runs side by side: a scenario on several plants, its data by several estimators.

A run that fails is an outcome like the others, with its reason.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from itertools import chain, count, product
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from rich.table import Table

from cosim.arguments import (
    mapping_argument,
    path_argument,
    swap_argument,
    truth_argument,
)
from cosim.arrays import Vector
from cosim.core.port import named_ports, split_element
from cosim.core.recorded.run import RecordedRun
from cosim.core.recorded.signals import warning_texts
from cosim.core.recorders import Memory
from cosim.errors import CosimError, Interrupted, UsageError, flag, nearest, option, quoted
from cosim.files import file_type
from cosim.log import Log, open_log
from cosim.report.printable import print_notice
from cosim.report.recorded_rows import difference, last_value, stacked_rows_of
from cosim.report.summary import (
    ERROR,
    HALF_WIDTH,
    LARGEST_ERROR,
    ResultValue,
    Summary,
    results_of,
    summarize,
)
from cosim.report.tables.console import Shown, new_table
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
from cosim.scenario.recordings.recording import Target, check_target
from cosim.scenario.recordings.replay_request import ReplayRequest
from cosim.scenario.running.execution import load, run
from cosim.scenario.running.replay import replays_of
from cosim.temporary import TemporaryFolder
from cosim.theory.documents import ParameterVerdict
from cosim.theory.quantiles import CONFIDENCE, normal_two_sided

ALL: Final = "all"  # estimators
_Made = TypeVar("_Made")


def attempt(make: Callable[[], _Made]) -> tuple[_Made | None, str]:
    """Return what is made, or why it failed, whatever it is: the others go on."""
    try:
        return make(), ""
    except Interrupted:
        raise
    except CosimError as error:
        return None, str(error)


def log_paths(
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


def results_table(
    title: str,
    heads: Sequence[str],
    rows: Sequence[tuple[Sequence[str], Mapping[str, ResultValue] | None]],
) -> Table:
    """Return a table of the results of several runs.

    Parameters
    ----------
    title : str
    heads : sequence of str
        Of what tells a run from the others.
    rows : sequence of (texts, results)
        That, and the results by name; half widths and errors stand behind what they are of. None:
        the run failed.
    """
    names = dict.fromkeys(chain.from_iterable(results or () for _, results in rows))
    beside = {name + suffix for name, suffix in product(names, (HALF_WIDTH, ERROR))}
    columns = [name for name in names if name not in beside and not name.endswith(LARGEST_ERROR)]
    cells = []
    for texts, results in rows:
        found = ["failed"]
        if results is not None:
            found = [_result_text(results, name) for name in columns]
        cells.append([*texts, *found])
    return new_table(title, (*heads, *columns), cells)


def _result_text(results: Mapping[str, ResultValue], name: str) -> str:
    value = results.get(name, "")
    text = "no value" if value is None else str(value)
    if isinstance(value, float):
        text = f"{value:.6g}"
    for suffix, words in ((HALF_WIDTH, " ± "), (ERROR, ", error ")):
        other = results.get(f"{name}{suffix}")
        if isinstance(other, float):
            text += f"{words}{other:.2g}"
    return text


def print_failures(failures: Iterable[tuple[str, str]]) -> None:
    """Print why some of several runs failed."""
    for name, text in failures:
        for line in text.splitlines():
            print_notice(f"{name}: failed: {line}")


def _path_of(recording: Log | Memory | None) -> str | None:
    """Return where a run was recorded; None: nowhere that is there still."""
    if isinstance(recording, Log) and recording.is_at_its_path:
        return str(recording.path)
    return None


def _truths(recordings: Mapping[str, RecordedRun]) -> dict[str, Any]:
    """Return the estimates of runs with their truth, under the names of the first that has it."""
    truths: dict[str, Any] = {}
    for recording in recordings.values():
        truths |= {key: true for key, true in truth_of(recording).items() if key not in truths}
    return truths


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
        return _truths(self.recordings)

    @cached_property
    def summaries(self) -> dict[str, Summary]:
        """The summary of each run, by label."""
        return {label: summarize(recording) for label, recording in self.recordings.items()}

    @cached_property
    def differences(self) -> list[EstimateDifference]:
        """The distance of every estimate from that of the first run, at their shared instants."""
        differences = []
        runs = list(self.recordings.items())
        for estimate, (label, other) in product(self.estimates, runs[1:]):
            _, first = runs[0]
            if estimate in first and estimate in other:
                _, values = difference(first, other, estimate)
                sizes = np.abs(values).max(axis=0, where=np.isfinite(values), initial=-1.0).tolist()
                largest = tuple(None if size < 0.0 else size for size in sizes)
                differences.append(EstimateDifference(estimate, label, largest))
        return differences

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        summaries = {label: summary.to_dict() for label, summary in self.summaries.items()}
        plants = [
            {
                "plant": one.label,
                "error": one.error or None,
                "log": _path_of(one.recording),
                "summary": summaries.get(one.label),
            }
            for one in self.outcomes
        ]
        return {
            "scenario": self.scenario,
            "component": self.component,
            "plants": plants,
            "differences": [asdict(row) for row in self.differences],
        }


def show_plants(comparison: Comparison) -> Shown:
    """Show the results of several plants, and how far their estimates are from the first one's."""
    yield comparison.to_dict()
    first = next(iter(comparison.recordings), "")
    results = {label: results_of(summary) for label, summary in comparison.summaries.items()}
    for one in comparison.differences:
        known = [size for size in one.largest if size is not None]
        results[one.label][f"{one.estimate} from {first}"] = max(known, default=None)
    rows = [([one.label], results.get(one.label)) for one in comparison.outcomes]
    yield results_table(f"{comparison.scenario}: {comparison.component}", ["plant"], rows)
    if not comparison.estimates:
        yield (
            "no estimates to compare: the scenario has no [truth]; --out keeps the logs, and "
            "'cosim diff' compares all their signals"
        )
    for label, recording in comparison.recordings.items():
        for text in warning_texts(recording.warnings):
            print_notice(f"warning: {label}: {text}")
    print_failures((one.label, one.error) for one in comparison.outcomes)


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
    swapped = [document.with_swaps({component: path}, maps[path]) for path in paths]
    plants = [attempt(partial(loaded.parse, one)) for one in swapped]
    if all(error for _, error in plants):
        raise UsageError("\n".join(dict.fromkeys(error for _, error in plants)))
    labels = [_label(path) for path in paths]
    if base:
        labels.insert(0, loaded.specs[component].kind)
        plants.insert(0, (common, ""))
    labels = _distinct(labels)
    names = [label.replace("#", "-") for label in labels]
    logs = log_paths(out, names, partial(check_target, force=force))
    outcomes = []
    for label, (plant, error), log in zip(labels, plants, logs, strict=True):
        recording = None
        if plant is not None:
            recording, error = attempt(partial(run, plant, out=log, force=force))
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
    errors = [attempt(partial(component_table, component, path))[1] for path in listed]
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
    from cosim.log.foreign.topics import ForeignFile
    from cosim.scenario.data_files.field_file import field_data

    table = component_table(component, path)
    try:
        if table["kind"] == "fmu":
            return [one.name for one in read(table["path"]).description.interface.signals]
        if table["kind"] == "recording":
            channel = open_log(table["log"]).channels.get(component)
            return [] if channel is None else list(channel.by_name)
        if file_type(table["path"]) == "log":
            channels = ForeignFile(Path(table["path"])).channels
            topics = tuple(channel.topic for channel in channels)
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

    @property
    def results(self) -> dict[str, ResultValue]:
        """What the method says, by name; empty where it failed."""
        results: dict[str, ResultValue] = {}
        if self.theta is None:
            return results
        parts = {"": self.theta, HALF_WIDTH: self.half_width, ERROR: self.error}
        for suffix, values in parts.items():
            for number, value in enumerate(_plain(values) or []):
                results[f"theta[{number}]{suffix}"] = value
        verdicts = ", ".join(one.verdict for one in self.verdicts)
        return {**results, "time / rest": self.time_ratio, "verdict": verdicts}

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; None where there is no value."""
        return {
            "method": self.method,
            "failure": self.failure or None,
            **{key: _plain(vars(self)[key]) for key in ("theta", "standard_error", "error")},
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
        return {name: true for name, true in _truths(self.recordings).items() if name == theta}

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
    targets = log_paths(out, [edited.name, *methods], partial(check_target, force=force))
    results = []
    with ExitStack() as resources:
        path = targets[0]
        if path is None:
            path = resources.enter_context(TemporaryFolder("compare")) / f"{edited.name}.mcap"
        times: dict[str, float] = {}
        run(edited, out=path, force=force, profile=times)
        replays = replays_of(path, ReplayRequest())
        others = sum(times.get(name, 0.0) for name in edited.specs if name != component)
        for method, target in zip(methods, targets[1:], strict=True):
            foreign = foreign_keys(METHODS, method)
            own = {key: value for key, value in table.items() if key not in foreign}
            values = {component: {**own, "method": method}}
            times = {}
            to = Target(target, force)
            make = partial(replays.record, values, to, progress=None, profile=times)
            again, failure = attempt(make)
            if again is None:
                results.append(EstimatorResult(method=method, failure=failure))
            else:
                ratio = times[component] / others if others > 0.0 else None
                results.append(_result(method, again, component, ratio))
    return EstimatorComparison(edited.name, component, tuple(results))


def _methods(estimators: str | Sequence[str]) -> list[IdentificationMethod]:
    """Return the methods of these names."""
    known: dict[str, IdentificationMethod] = {method: method for method in METHODS}
    names = [estimators] if isinstance(estimators, str) else list(estimators)
    names = list(known) if names == [ALL] else names
    place = option("estimators")
    if not names:
        raise UsageError(f"{place}: expected {ALL}, or some of: {tuple(known)}; got none")
    for name in names:
        if name not in known:
            suggestion = nearest(str(name), [*known, ALL])
            raise UsageError(f"{place}: no method {quoted(name)}; {suggestion}")
        if names.count(name) > 1:
            raise UsageError(f"{place}: {name} is given twice")
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
    port, deviation = f"{component}.theta", f"{component}.standard_error"
    # no term has a parameter where there is no theta
    theta = last_value(recording, port) if port in recording else np.zeros(0)
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
        standard_error=last_value(recording, deviation) if deviation in recording else None,
        error=None if true is None else theta - np.array(true, np.float64),
        verdicts=() if verdicts is None else verdicts.estimate,
    )


def show_estimators(comparison: EstimatorComparison) -> Shown:
    """Show what several methods estimate from the same data."""
    yield comparison.to_dict()
    title = f"{comparison.scenario}: {comparison.component}"
    rows = [([one.method], None if one.failure else one.results) for one in comparison.results]
    yield results_table(title, ["method"], rows)
    yield "±: half width of the 95 % interval, where there is one"
    yield "time / rest: computing time of the identifier over that of all other components"
    print_failures((one.method, one.failure) for one in comparison.results)
