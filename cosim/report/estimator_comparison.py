"""Several methods of identification on the same recorded data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from cosim.arguments import mapping_argument, path_argument, truth_argument
from cosim.arrays import Vector
from cosim.core.recorders import Memory
from cosim.core.recording import Recording
from cosim.errors import CosimError, Interrupted, UsageError, nearest, option, quoted
from cosim.log import Log
from cosim.report.recorded_rows import has_signal, rows_of, stacked_rows_of
from cosim.scenario.document.schema import truth_ports
from cosim.scenario.document.swap import PortNames
from cosim.scenario.kinds.identification import IdentifierKind
from cosim.scenario.kinds.methods import METHODS, IdentificationMethod
from cosim.scenario.kinds.variants import foreign_keys
from cosim.scenario.parsing import Scenario
from cosim.scenario.record import recorded_identification, truth_of
from cosim.scenario.recordings.recording import check_target
from cosim.scenario.running.execution import load, run
from cosim.scenario.running.replay import replay
from cosim.temporary import TemporaryFolder
from cosim.theory.assessment.documents import ParameterVerdict
from cosim.theory.quantiles import CONFIDENCE, normal_two_sided

ALL = "all"


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
        if not self.verdicts:
            error = self.standard_error
            unknown = np.full(len(self.theta), np.nan)
            return unknown if error is None else normal_two_sided(CONFIDENCE) * error
        widths = []
        for record in self.verdicts:
            width = np.nan
            if record.lower is not None and record.upper is not None:
                width = 0.5 * (record.upper - record.lower)
            widths.append(width)
        return np.array(widths)


@dataclass(frozen=True)
class EstimatorComparison:
    """Several methods of one identifier, the failed ones included."""

    scenario: str
    component: str
    results: tuple[EstimatorResult, ...]

    @cached_property
    def recordings(self) -> dict[str, Recording]:
        """The replays that did not fail, by method."""
        recordings: dict[str, Recording] = {}
        for result in self.results:
            if result.recording is not None:
                recordings[result.method] = result.recording
        return recordings

    @cached_property
    def estimates(self) -> dict[str, Any]:
        """theta with its truth, where there is one."""
        theta = f"{self.component}.theta"
        for recording in self.recordings.values():
            truth = truth_of(recording)
            if theta in truth:
                return {theta: truth[theta]}
        return {}

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; None where there is no value."""
        methods = []
        for result in self.results:
            log = None
            if isinstance(result.recording, Log) and result.recording.is_at_its_path:
                log = str(result.recording.path)
            methods.append(
                {
                    "method": result.method,
                    "failure": result.failure or None,
                    "theta": _plain(result.theta),
                    "standard_error": _plain(result.standard_error),
                    "error": _plain(result.error),
                    "time_ratio": result.time_ratio,
                    "verdicts": [asdict(verdict) for verdict in result.verdicts],
                    "log": log,
                }
            )
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
    folder = None if out is None else path_argument("out", out)
    methods = _methods(estimators)
    loaded = scenario if isinstance(scenario, Scenario) else load(scenario)
    edited = loaded.edit(swap=swap, map=map, set=mapping_argument("set", set))
    component = _identifier(edited)
    with ExitStack() as resources:
        logs = folder or resources.enter_context(TemporaryFolder("compare"))
        source_path = logs / f"{edited.name}.mcap"
        targets: list[Path | None] = []
        for method in methods:
            target = None if folder is None else folder / f"{method}.mcap"
            check_target(target, force=force)  # all of them, before the run
            targets.append(target)
        times: dict[str, float] = {}
        log = run(edited, out=source_path, force=force, profile=times)
        assert isinstance(log, Log)
        others = [times.get(name, 0.0) for name in edited.specs if name != component]
        table = edited.document.tree()[0]["components"][component]
        source = _Source(log, component, table, sum(others))
        results = []
        for method, target in zip(methods, targets, strict=True):
            results.append(_estimate(source, method, target=target, force=force))
    return EstimatorComparison(edited.name, component, tuple(results))


def _methods(estimators: str | Sequence[str]) -> list[IdentificationMethod]:
    """Return the methods of these names."""
    if estimators == ALL:
        return list(METHODS)
    names = [estimators] if isinstance(estimators, str) else list(estimators)
    known: dict[str, IdentificationMethod] = {method: method for method in METHODS}
    methods: list[IdentificationMethod] = []
    for name in names:
        if name not in known:
            suggestion = nearest(str(name), [*known, ALL])
            raise UsageError(f"{option('estimators')}: no method {quoted(name)}; {suggestion}")
        if known[name] in methods:
            raise UsageError(f"{option('estimators')}: {name} is given twice")
        methods.append(known[name])
    if not methods:
        raise UsageError(
            f"{option('estimators')}: expected {ALL}, or some of: {tuple(METHODS)}; got none"
        )
    return methods


def _identifier(scenario: Scenario) -> str:
    """Return the name of the one identifier."""
    names = [name for name, spec in scenario.specs.items() if isinstance(spec, IdentifierKind)]
    if len(names) != 1:
        found = ", ".join(names) or "none"
        raise UsageError(
            f"{option('estimators')}: expected one component of kind 'identifier', got {found}"
        )
    return names[0]


@dataclass(frozen=True)
class _Source:
    """A run, its identifier with its table, and the time of all other components [s]."""

    log: Log
    component: str
    table: Mapping[str, Any]
    seconds: float


def _estimate(
    source: _Source, method: IdentificationMethod, *, target: Path | None, force: bool
) -> EstimatorResult:
    """Replay a run with another method."""
    component = source.component
    foreign = foreign_keys(METHODS, method)
    own = {key: value for key, value in source.table.items() if key not in foreign}
    changes = {component: {**own, "method": method}}
    times: dict[str, float] = {}
    try:
        recording = replay(source.log, set=changes, out=target, force=force, profile=times)
    except Interrupted:
        raise
    except CosimError as error:  # of one method, whatever it is: the others go on
        return EstimatorResult(method=method, failure=str(error))
    theta = _last(recording, f"{component}.theta")
    error_port = f"{component}.standard_error"
    return EstimatorResult(
        method=method,
        recording=recording,
        time_ratio=times[component] / source.seconds if source.seconds > 0.0 else None,
        theta=theta,
        standard_error=_last(recording, error_port) if has_signal(recording, error_port) else None,
        error=_error(recording, f"{component}.theta", theta),
        verdicts=_verdicts(recording, component),
    )


def _verdicts(recording: Recording, component: str) -> tuple[ParameterVerdict, ...]:
    """Return what was recorded of the identifier's own estimate."""
    record = recorded_identification(recording).get(component)
    return () if record is None else record.estimate


def _last(recording: Recording, port: str) -> Vector:
    if not has_signal(recording, port):
        return np.zeros(0)  # no term has a parameter
    rows = rows_of(recording, port)
    if not len(rows):
        return np.full(rows.shape[1], np.nan)
    last: Vector = rows[-1].copy()
    return last


def _error(recording: Recording, port: str, values: Vector) -> Vector | None:
    """Return the values less their truth."""
    truth = truth_of(recording).get(port)
    if truth is None:
        return None
    ports = truth_ports(truth)
    true = np.atleast_1d(np.array(0.0 if ports else truth, np.float64))
    if ports:
        _, rows = stacked_rows_of(recording, ports, like=port)
        true = rows[-1] if len(rows) else np.full(len(values), np.nan)
    error: Vector = values - true
    return error


def _plain(values: Vector | None) -> list[float | None] | None:
    if values is None:
        return None
    return [float(value) if np.isfinite(value) else None for value in values]
