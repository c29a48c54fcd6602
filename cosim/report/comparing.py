"""The same scenario on several plants: runs, errors against the truth, and how far the estimates are from each other."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cosim.arrays import Vector
from cosim.core.contracts import Recording
from cosim.core.recorders import Memory
from cosim.core.signals import Interface
from cosim.errors import CosimError, Interrupted, UsageError, nearest
from cosim.log import Log
from cosim.report.summary import Summary, difference, has_signal, summarize, truth_of
from cosim.scenario.build import Scenario
from cosim.scenario.execution import load, run
from cosim.scenario.swap import component_table


@dataclass(frozen=True)
class PlantRun:
    """What came of one plant.

    Parameters
    ----------
    label : str
        What it is called in tables and pictures, and its log.
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
    """An estimate of one plant against that of the first."""

    estimate: str
    label: str
    largest: tuple[
        float | None, ...
    ]  # |difference| by element where both have a value; None: one never has


@dataclass(frozen=True)
class Comparison:
    """Several plants in one scenario; those that failed stay in it."""

    scenario: str
    component: str
    outcomes: tuple[PlantRun, ...]

    @property
    def recordings(self) -> dict[str, Recording]:
        """The runs that came to an end, by label."""
        return {
            outcome.label: outcome.recording
            for outcome in self.outcomes
            if outcome.recording is not None
        }

    @property
    def estimates(self) -> dict[str, Any]:
        """What the runs estimate with its truth, in the order of the scenario's."""
        found: dict[str, Any] = {}
        for recording in self.recordings.values():
            found = found | truth_of(recording) | found  # the names of the first that has it
        return found

    @property
    def summaries(self) -> dict[str, Summary]:
        """What each run found, by label."""
        return {label: summarize(recording) for label, recording in self.recordings.items()}

    @property
    def differences(self) -> list[EstimateDifference]:
        """How far every estimate is from that of the first run, at the instants that both have."""
        found: list[EstimateDifference] = []
        labels = list(self.recordings)
        for estimate in self.estimates if labels else ():
            reference = self.recordings[labels[0]]
            for label in labels[1:]:
                recording = self.recordings[label]
                if not (has_signal(reference, estimate) and has_signal(recording, estimate)):
                    continue
                _, values = difference(reference, recording, estimate)
                found.append(EstimateDifference(estimate, label, tuple(map(_largest, values.T))))
        return found

    def to_dict(self) -> dict[str, Any]:
        """Give plain values for JSON."""
        summaries = self.summaries
        plants = [
            {
                "plant": one.label,
                "error": one.error or None,
                "log": str(one.recording.path) if isinstance(one.recording, Log) else None,
                "summary": summaries[one.label].to_dict() if one.label in summaries else None,
            }
            for one in self.outcomes
        ]
        differences = [asdict(one) for one in self.differences]
        return {
            "scenario": self.scenario,
            "component": self.component,
            "plants": plants,
            "differences": differences,
        }


def compare(
    scenario: str | Path | Scenario,
    *,
    swap: Mapping[str, Sequence[str | Path]],
    map: Mapping[str, str] | None = None,
    set: Mapping[str, Any] | None = None,
    base: bool = True,
    out: str | Path | None = None,
    force: bool = False,
) -> Comparison:
    """Run a scenario with each of several plants.

    Parameters
    ----------
    scenario : str, Path or Scenario
        A shipped name, a path, or what :func:`load` gave.
    swap : mapping of one component to the paths of its alternatives
        Each an FMU (``x.fmu``, ``x.fmu#me``, ``x.fmu#cs``) or a recorded log.
    map : mapping of port to name, optional
        As for :func:`run`. An entry is for every alternative that has a port of that name; the others keep the scenario's.
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
        If there is not one component, fewer than two plants, or an entry of ``map`` that none of them can use. What is wrong with
        a single plant is its outcome.
    """
    loaded = scenario if isinstance(scenario, Scenario) else load(scenario)
    component, paths = _alternatives(loaded, swap, base=base)
    maps = _maps(component, paths, map or {})
    changes = dict(set or {})
    kept = {
        key: value
        for key, value in changes.items()
        if not key.removeprefix("components.").startswith(f"{component}.")
    }
    runs: list[tuple[str, str | None, dict[str, Any]]] = (
        [(loaded.specs[component].kind, None, kept)] if base else []
    )
    runs += [
        (
            Path(path).stem + Path(path).suffix.removeprefix(".fmu").removeprefix(".mcap"),
            path,
            changes,
        )
        for path in paths
    ]
    loaded.edit(set=kept)  # what is wrong for all of them is told once
    outcomes = []
    for label, (_, path, chosen) in zip(
        _distinct([label for label, _, _ in runs]), runs, strict=True
    ):
        log = None if out is None else Path(out) / f"{label.replace('#', '-')}.mcap"
        swapped: dict[str, str | Path] = {} if path is None else {component: path}
        try:
            recording = run(
                loaded, swap=swapped, map=maps.get(path), set=chosen, out=log, force=force
            )
            outcomes.append(PlantRun(label, recording))
        except Interrupted:
            raise
        except CosimError as error:  # one plant's, whatever it is: the others go on
            outcomes.append(PlantRun(label, None, str(error)))
    return Comparison(loaded.name, component, tuple(outcomes))


def _largest(values: Vector) -> float | None:
    found = np.abs(values[np.isfinite(values)])
    return float(found.max()) if found.size else None


def _alternatives(
    loaded: Scenario, swap: Mapping[str, Sequence[str | Path]], *, base: bool
) -> tuple[str, list[str]]:
    if len(swap) != 1:
        found = ", ".join(swap) or "none"
        raise UsageError(
            f"--swap: found alternatives of {found}; needed those of one component, such as plant=a.fmu plant=b.fmu"
        )
    (component, paths), *_ = swap.items()
    if component not in loaded.specs:
        raise UsageError(
            f"--swap {component}: there is no component {component!r}; {nearest(component, loaded.specs)}"
        )
    if len(paths) + base < 2:
        raise UsageError(
            f"--swap {component}: found one plant, needed two to compare; give another, or leave out --no-base"
        )
    return component, [str(path) for path in paths]


def _distinct(labels: Sequence[str]) -> list[str]:
    """Give a number to labels that are there already."""
    found: list[str] = []
    for label in labels:
        number = 1
        while (name := label if number == 1 else f"{label}-{number}") in found:
            number += 1
        found.append(name)
    return found


def _maps(
    component: str, paths: Sequence[str], maps: Mapping[str, str]
) -> dict[str | None, dict[str, str]]:
    """Give each alternative the entries whose name is one of its ports."""
    ports = {path: _ports(component, path) for path in paths}
    unused = [
        port
        for port, name in maps.items()
        if not any(_has(names, name) for names in ports.values())
    ]
    if unused:
        known = dict.fromkeys(name for names in ports.values() for name in names)
        raise UsageError(
            "\n".join(
                f"--map {port}: no alternative has a port {maps[port]!r}; {nearest(maps[port], known)}"
                for port in unused
            )
        )
    return {
        path: {port: name for port, name in maps.items() if _has(names, name)}
        for path, names in ports.items()
    }


def _has(ports: Sequence[str], name: str) -> bool:
    return name in ports or re.sub(r"\[\d+\]$", "", name) in ports


def _ports(component: str, path: str) -> list[str]:
    """Give the ports of an alternative; none where it cannot be read: its run says why."""
    try:
        face = _interface(component, path)
    except CosimError:
        return []
    return [signal.name for signal in (*face.inputs, *face.outputs)]


def _interface(component: str, path: str) -> Interface:
    from cosim.fmi.reading.model_description import read
    from cosim.log import open_log

    table = component_table(component, path)
    if table["kind"] == "fmu":
        return read(table["path"]).description.interface
    channels = open_log(table["log"]).channels
    return channels[component].interface if component in channels else Interface()
