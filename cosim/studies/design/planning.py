"""Plan a study: which members it has, and what each of them is."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from cosim.errors import UsageError, nearest, option, quoted
from cosim.scenario.document.edits import short
from cosim.scenario.document.elements import address
from cosim.scenario.parsing import Scenario
from cosim.studies.contracts import MOST_MEMBERS, RECORDING, SWAP
from cosim.studies.design.cases import read_cases
from cosim.studies.design.columns import (
    DesignColumn,
    GridColumn,
    MemberLayout,
    NoiseSeedColumn,
    SampleColumn,
    packed,
)
from cosim.studies.design.own_values import noise_sources, own_number
from cosim.studies.design.probabilities import unit_points
from cosim.studies.design.quantiles import chosen, quantiles
from cosim.studies.design.recordings import find_recordings
from cosim.studies.design.study_design import SampleKind, StudyDesign
from cosim.studies.document.study_file import StudyFile
from cosim.studies.document.variations import GridVariation, SampledVariation

_BLOCK: Final = 2**16  # samples


def plan_design(study: StudyFile, scenario: Scenario) -> StudyDesign:
    """Return the members of a study; all of it follows from the study and its scenario.

    Parameters
    ----------
    study : StudyFile
    scenario : Scenario
        That of the study, as its file says: without the edits of the study.

    Raises
    ------
    UsageError
        If what is sampled, varied and set does not go together, a table of cases or a log is
        missing, or there are too many members.
    """
    _check_sampling(study)
    cases = {} if study.settings.cases is None else read_cases(Path(study.settings.cases))
    recordings = find_recordings(study.settings.replay)
    if not recordings and RECORDING not in cases:
        _check_swapped(study, scenario, cases)
    grid = list(study.grid)
    if recordings:
        grid.insert(0, GridVariation(RECORDING, recordings))
    names = [item.key for item in grid] + [item.key for item in study.sampled] + list(cases)
    sources = _noise_sources(study, scenario, names)
    _check_keys(study, [*names, *sources])
    layout = _layout(study, grid, len(next(iter(cases.values()))) if cases else 1)
    columns = _grid_columns(grid) | _sampled_columns(study, scenario)
    columns |= {key: SampleColumn(values) for key, values in cases.items()}
    seed = study.settings.seed
    columns |= {key: NoiseSeedColumn(seed, name) for key, name in sources.items()}
    kind: SampleKind = "cases" if cases else "grid"
    if study.sampled:
        kind = study.settings.sampling or "random"
    sampled = tuple(item.key for item in study.sampled)
    ordered = {name: columns[name] for name in [*names, *sources]}
    return StudyDesign(study, kind, layout, ordered, sampled)


def edited_scenario(
    study: StudyFile,
    scenario: Scenario,
    swaps: Mapping[str, str],
    changes: Mapping[str, Any] = MappingProxyType({}),
) -> Scenario:
    """Return the scenario of a study with the edits that all members have, and some of a member."""
    settings = study.settings
    swap = {**settings.swap, **swaps}
    may_replay = settings.replay is not None or settings.cases is not None
    # The ports are those of recordings of another tool where nothing takes the place of anything.
    is_of_recording = may_replay and not swap
    return scenario.edit(
        swap=swap,
        map={} if is_of_recording else dict(settings.map),
        set={**settings.set, **changes},
    )


# --- checks ---


def _check_swapped(study: StudyFile, scenario: Scenario, cases: Mapping[str, object]) -> None:
    """Check that columns of a table of cases that are no dotted keys are components.

    Raises
    ------
    UsageError
        If there is no such component.
    """
    for key in cases:
        name = key.removeprefix(SWAP)
        if key.startswith(SWAP) and name not in scenario.specs:
            raise UsageError(
                f"file {study.settings.cases!r}, column {name!r}: no component {name!r} to swap, "
                f"and keys have a dot, such as 'scenario.stop'; {nearest(name, scenario.specs)}"
            )


def _check_sampling(study: StudyFile) -> None:
    """Check that samples and what is sampled go together."""
    settings = study.settings
    if study.sampled and settings.samples is None:
        raise UsageError(
            f"{option('samples')}: expected the number of draws, such as "
            f"{_example('samples', '100')}, as {study.sampled[0].key!r} has a distribution; got "
            "none"
        )
    if study.sampled and settings.cases is not None:
        raise UsageError(
            f"expected either {option('cases')} or distributions ({study.sampled[0].key!r}), got "
            "both"
        )
    for name in ("samples", "sampling"):
        if getattr(settings, name) is not None and not study.sampled:
            way_out = (
                f"; the runs of a noise source are {_example('seeds', 'N')}"
                if name == "samples"
                else ""
            )
            raise UsageError(
                f"{option(name)}: nothing is drawn: no key has a distribution, such as "
                f"{{ uniform = [0.0, 1.0] }}{way_out}"
            )


def _example(name: str, value: str) -> str:
    label = option(name)
    return f"{label} {value}" if label.startswith("--") else f"{label}={value}"


def _check_keys(study: StudyFile, names: Iterable[str]) -> None:
    """Check that no key is given twice, nor one inside another.

    Raises
    ------
    UsageError
        If one is.
    """
    given = [(address(name), "varied", name) for name in names]
    for key in study.settings.set:
        given.append((address(short(key)), "set", short(key)))
    for name in study.settings.swap:
        given.append((f"{SWAP}{name}", "set", f"{SWAP}{name}"))
    # Behind a key sorted by its parts come those inside it.
    given.sort(key=lambda item: item[0].split("."))
    for before, after in pairwise(given):
        is_same = before[0] == after[0]
        is_inside = is_same or after[0].startswith(f"{before[0]}.")
        # A list that all members have may have an element that varies, but not the other way.
        if is_same or (is_inside and before[1] == "varied"):
            verbs = "" if before[1] == after[1] else f", {before[1]} and {after[1]}"
            raise UsageError(f"expected one of {before[2]!r} and {after[2]!r}, got both{verbs}")


def _layout(study: StudyFile, grid: list[GridVariation], cases: int) -> MemberLayout:
    """Return how the members are numbered."""
    settings = study.settings
    samples = cases
    noises = 0
    if study.sampled and settings.samples is not None:
        noises = settings.samples
        blocks = len(study.sampled) + 2 if settings.sampling == "saltelli" else 1
        samples = blocks * noises
    counts = [len(item.values) for item in grid]
    layout = MemberLayout(
        samples=samples, seeds=settings.seeds or 1, grid=math.prod(counts), noises=noises
    )
    if layout.members > MOST_MEMBERS:
        factors = [count for count in (samples, layout.seeds, *counts) if count > 1]
        product = " x ".join(map(str, factors))
        raise UsageError(
            f"{study.source}: expected at most {MOST_MEMBERS} members, got {product} = "
            f"{layout.members}"
        )
    return layout


# --- columns ---


def _grid_columns(grid: list[GridVariation]) -> dict[str, DesignColumn]:
    """Return the columns of the grid; the first key is the slowest."""
    columns: dict[str, DesignColumn] = {}
    stride = 1
    for item in reversed(grid):
        columns[item.key] = GridColumn(packed(item.values), stride)
        stride *= len(item.values)
    return columns


def _sampled_columns(study: StudyFile, scenario: Scenario) -> dict[str, DesignColumn]:
    """Return the columns of what is drawn."""
    settings = study.settings
    if not study.sampled or settings.samples is None:
        return {}
    keys = [item.key for item in study.sampled]
    method = settings.sampling or "random"
    points = unit_points(method, keys, settings.samples, seed=settings.seed)
    own = _own_numbers(study, scenario)
    columns: dict[str, DesignColumn] = {}
    for item, p in zip(study.sampled, points, strict=True):
        if item.distribution == "choice":
            columns[item.key] = SampleColumn(packed(item.values), chosen(item, p))
        else:
            for begin in range(0, len(p), _BLOCK):  # whose temporary arrays stay small
                block = p[begin : begin + _BLOCK]
                block[:] = quantiles(item, block, own.get(item.key, math.nan))
            _check_finite(item, p)
            columns[item.key] = SampleColumn(p)
    return columns


def _check_finite(item: SampledVariation, values: np.ndarray[Any, Any]) -> None:
    wrong = values[~np.isfinite(values)]
    if len(wrong):
        raise UsageError(
            f"{option('vary', item.key)}: {item.distribution} of {quoted(list(item.numbers))} "
            f"gives {wrong[0]}; expected numbers below {np.finfo(float).max:g}"
        )


def _own_numbers(study: StudyFile, scenario: Scenario) -> dict[str, float]:
    """Return the values that tolerances are relative to."""
    keys = [item.key for item in study.sampled if item.distribution.startswith("tolerance")]
    if not keys:
        return {}
    edited = edited_scenario(study, scenario, _first_swaps(study))
    return {key: own_number(edited, key) for key in keys}


def _first_swaps(study: StudyFile) -> dict[str, str]:
    """Return the first path of every swap that is varied."""
    return {
        item.key.removeprefix(SWAP): item.values[0]
        for item in study.variations
        if item.key.startswith(SWAP)
    }


def _noise_sources(study: StudyFile, scenario: Scenario, names: list[str]) -> dict[str, str]:
    """Return what gets seeds, by their keys; nothing where the study has none."""
    if study.settings.seeds is None:
        return {}
    is_replay = study.settings.replay is not None or RECORDING in names
    edited = edited_scenario(study, scenario, _first_swaps(study))
    swapped = {name.removeprefix(SWAP) for name in names if name.startswith(SWAP)}
    sources = {}
    for key, name in noise_sources(edited, is_replay=is_replay).items():
        if name not in swapped:
            sources[key] = name
    if not sources:
        raise UsageError(
            f"{option('seeds')}: nothing in the scenario has a seed; add a component with noise, "
            'such as { kind = "sensor", noise = 1e-3, seed = 1 }'
        )
    return sources
