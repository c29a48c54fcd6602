"""The design of a study: which members there are, by number.

Samples (or cases) are the outermost loop, then the seeds of noise, then the grid. A column gives
the values of a key for any members, so that no list of all members is ever made. Each key and each
noise source has a stream of random numbers of its own: what is appended changes nothing before it.
"""

from __future__ import annotations

import glob
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Final, Literal, TypeAlias

import numpy as np
from pydantic import Field

from cosim.arrays import Matrix
from cosim.errors import UsageError, nearest, option, quoted
from cosim.files import file_type
from cosim.scenario.document.edits import ACTIONS, COMPONENTS, FLAT, component_in, short
from cosim.scenario.document.elements import address
from cosim.scenario.parsing import Scenario
from cosim.scenario.recordings.replaying import texts_in
from cosim.studies.cases import ColumnValues, packed, read_cases
from cosim.studies.contracts import MOST_MEMBERS, RECORDING, SWAP, StudyMember
from cosim.studies.study_file import SamplingMethod, StudyFile
from cosim.studies.variations import GridVariation, SampledVariation, chosen, quantiles

MemberIndices: TypeAlias = np.ndarray[tuple[int], np.dtype[np.int64]]
SampleKind: TypeAlias = Literal["grid", "cases", "random", "latin-hypercube", "sobol", "saltelli"]
_Count: TypeAlias = Annotated[int, Field(ge=1, le=MOST_MEMBERS)]  # where it is read from a file
_BLOCK: Final = 2**16  # samples whose temporary arrays stay small
_BITS: Final = 30  # of a point of a Sobol sequence
_SMALLEST: Final = 2.0**-54


# --- members by number ---


@dataclass(frozen=True, kw_only=True)
class MemberNumbering:
    """How members are numbered: by sample, then by seed, then by point of the grid."""

    samples: _Count = 1
    seeds: _Count = 1
    grid: _Count = 1

    @property
    def members(self) -> int:
        """How many there are."""
        return self.samples * self.seeds * self.grid

    def samples_of(self, numbers: MemberIndices) -> MemberIndices:
        """Return the samples of members."""
        return numbers // (self.grid * self.seeds)

    def seeds_of(self, numbers: MemberIndices) -> MemberIndices:
        """Return which of the seeds members have."""
        return numbers // self.grid % self.seeds


@dataclass(frozen=True, kw_only=True)
class MemberLayout(MemberNumbering):
    """The numbering, and after how many samples the seeds of noise repeat (0: never)."""

    noises: int = 0

    def noises_of(self, numbers: MemberIndices) -> MemberIndices:
        """Return the places of members in the streams of noise seeds."""
        seeds = self.seeds_of(numbers)
        if not self.noises:
            return seeds
        return self.samples_of(numbers) % self.noises * self.seeds + seeds


@dataclass(frozen=True, slots=True)
class GridColumn:
    """The values of a key of the grid; ``stride`` members in a row have the same."""

    values: ColumnValues
    stride: int

    def take(self, layout: MemberLayout, numbers: MemberIndices) -> ColumnValues:
        """Return the values of some members."""
        return _taken(self.values, numbers % layout.grid // self.stride % len(self.values))


@dataclass(frozen=True, slots=True)
class SampleColumn:
    """A value for each sample, or for each case; ``indices``: which of the values it is."""

    values: ColumnValues
    indices: np.ndarray[Any, np.dtype[np.intp]] | None = None

    def take(self, layout: MemberLayout, numbers: MemberIndices) -> ColumnValues:
        """Return the values of some members."""
        samples = layout.samples_of(numbers)
        return _taken(self.values, samples if self.indices is None else self.indices[samples])


@dataclass(frozen=True, slots=True)
class NoiseSeedColumn:
    """The seeds of a noise source, from a stream of its own."""

    study_seed: int
    name: str

    def take(self, layout: MemberLayout, numbers: MemberIndices) -> ColumnValues:
        """Return the seeds of some members."""
        indices = layout.noises_of(numbers)
        if not len(indices):
            return np.empty(0, np.int64)
        begin = int(indices.min())
        stream = np.random.PCG64(_sequence(self.study_seed, self.name))
        stream.advance(begin)
        raw = np.asarray(stream.random_raw(int(indices.max()) + 1 - begin), np.uint64)
        seeds: ColumnValues = (raw >> np.uint64(11)).astype(np.int64)[indices - begin]
        return seeds


DesignColumn: TypeAlias = GridColumn | SampleColumn | NoiseSeedColumn


def _sequence(seed: int, name: str = "") -> np.random.SeedSequence:
    return np.random.SeedSequence(seed, spawn_key=tuple(name.encode()))


def _generator(seed: int, name: str = "") -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(_sequence(seed, name)))


def _taken(values: ColumnValues, indices: np.ndarray[Any, Any]) -> ColumnValues:
    if isinstance(values, np.ndarray):
        some: np.ndarray[Any, Any] = values[indices]
        return some
    return [values[index] for index in indices.tolist()]


def plain_values(values: ColumnValues) -> list[Any]:
    """Return the values of a column as a list."""
    return values.tolist() if isinstance(values, np.ndarray) else values


@dataclass(frozen=True, slots=True)
class StudyDesign:
    """The members of a study.

    Parameters
    ----------
    study : StudyFile
    kind : str
        How samples came about.
    layout : MemberLayout
    columns : mapping of key to DesignColumn
        In the order of the dataset.
    sampled : tuple of str
        The keys that are drawn.
    """

    study: StudyFile
    kind: SampleKind
    layout: MemberLayout
    columns: Mapping[str, DesignColumn] = field(repr=False)
    sampled: tuple[str, ...] = ()

    def __len__(self) -> int:
        return self.layout.members

    @property
    def names(self) -> tuple[str, ...]:
        """The keys."""
        return tuple(self.columns)

    def column(self, name: str, begin: int = 0, end: int | None = None) -> ColumnValues:
        """Return the values of a key, from one member to another (not included)."""
        return self.columns[name].take(self.layout, self._numbers(begin, end))

    def texts(self) -> set[str]:
        """Return all texts among the values: some are paths."""
        lists = [getattr(column, "values", None) for column in self.columns.values()]
        return set().union(*(texts_in(values) for values in lists if isinstance(values, list)))

    def member(self, number: int) -> StudyMember:
        """Return a member."""
        if not 0 <= number < len(self):
            raise UsageError(f"no member {number}; the study has {len(self)}, numbered from 0")
        return self.members(number, number + 1)[0]

    def members(self, begin: int = 0, end: int | None = None) -> list[StudyMember]:
        """Return the members from one number to another (not included)."""
        numbers = self._numbers(begin, end)
        columns = [plain_values(c.take(self.layout, numbers)) for c in self.columns.values()]
        rows = zip(*columns, strict=True) if columns else ((),) * len(numbers)
        return [
            member_of(number, dict(zip(self.columns, row, strict=True)))
            for number, row in zip(numbers.tolist(), rows, strict=True)
        ]

    def _numbers(self, begin: int, end: int | None) -> MemberIndices:
        last = len(self) if end is None else min(end, len(self))
        return np.arange(max(0, begin), last, dtype=np.int64)


def member_of(number: int, values: Mapping[str, Any]) -> StudyMember:
    """Return the member that has some values; None stands for the scenario's own."""
    given = {name: value for name, value in values.items() if value is not None}
    recording = given.pop(RECORDING, None)
    swaps = {n.removeprefix(SWAP): str(v) for n, v in given.items() if n.startswith(SWAP)}
    changes = {name: value for name, value in given.items() if not name.startswith(SWAP)}
    return StudyMember(number, changes, swaps, recording)


# --- planning ---


def plan_design(study: StudyFile, scenario: Scenario) -> StudyDesign:
    """Return the members of a study.

    Raises
    ------
    UsageError
        If samples, cases, seeds and keys do not go together; files are missing or no tables.
    """
    settings = study.settings
    _check_sampling(study)
    cases = {} if settings.cases is None else read_cases(Path(settings.cases))
    recordings = find_recordings(settings.replay)
    if not recordings and RECORDING not in cases:
        _check_swapped(study, scenario, cases)
    grid = list(study.grid)
    if recordings:
        grid.insert(0, GridVariation(RECORDING, recordings))
    varied = dict.fromkeys((item.key for item in study.variations), "varied")
    given = [*varied.items()] + [(key, "of the cases") for key in cases]
    given += [(RECORDING, "of the replay")] if recordings else []
    sources = _noise_sources(study, scenario, [name for name, _ in given])
    _check_keys(study, [*given, *((key, "of the seeds") for key in sources)])
    layout = _layout(study, grid, len(next(iter(cases.values()))) if cases else 1)
    columns: dict[str, DesignColumn] = {}
    stride = layout.grid
    for item in grid:
        stride //= len(item.values)
        columns[item.key] = GridColumn(packed(item.values), stride)
    columns |= _sampled_columns(study, scenario)
    columns |= {key: SampleColumn(values) for key, values in cases.items()}
    columns |= {key: NoiseSeedColumn(settings.seed, name) for key, name in sources.items()}
    kind: SampleKind = "cases" if cases else "grid"
    if study.sampled:
        kind = settings.sampling or "random"
    return StudyDesign(study, kind, layout, columns, tuple(item.key for item in study.sampled))


def edited_scenario(
    study: StudyFile,
    scenario: Scenario,
    swaps: Mapping[str, str],
    changes: Mapping[str, Any] = MappingProxyType({}),
) -> Scenario:
    """Return the scenario of a member; of a replay as far as it is known without its log."""
    settings = study.settings
    swap = {**settings.swap, **swaps}
    may_replay = settings.replay is not None or settings.cases is not None
    maps = {} if may_replay and not swap else dict(settings.map)
    return scenario.edit(swap=swap, map=maps, set={**settings.set, **changes})


def find_recordings(patterns: str | Iterable[str] | None) -> tuple[str, ...]:
    """Return the logs that paths and patterns name, each once."""
    found: dict[str, None] = {}
    for pattern in [patterns] if isinstance(patterns, str) else patterns or ():
        is_path = os.path.exists(pattern)  # also where it has a bracket in its name
        paths = [pattern] if is_path else sorted(glob.glob(pattern, recursive=True))
        if not paths:
            raise UsageError(
                f"{option('replay')}: no file matches {quoted(pattern)}; expected logs (.mcap)"
            )
        for path in paths:
            if file_type(path) != "log":
                raise UsageError(f"{option('replay')}: {path}: expected a log (.mcap)")
        found |= dict.fromkeys(paths)
    return tuple(found)


def _check_sampling(study: StudyFile) -> None:
    settings = study.settings
    if study.sampled:
        key = study.sampled[0].key
        if settings.samples is None:
            raise UsageError(
                f"{option('samples')}: expected the number of draws, such as 100, as {key!r} has a "
                "distribution; got none"
            )
        if settings.cases is not None:
            raise UsageError(
                f"expected either {option('cases')} or distributions ({key!r}), got both"
            )
        return
    for name in ("samples", "sampling"):
        if getattr(settings, name) is not None:
            seeds = (
                f"; the runs of a noise source are {option('seeds')}" if name == "samples" else ""
            )
            raise UsageError(
                f"{option(name)}: nothing is drawn: no key has a distribution, such as "
                f"{{ uniform = [0.0, 1.0] }}{seeds}"
            )


def _check_swapped(study: StudyFile, scenario: Scenario, cases: Mapping[str, object]) -> None:
    for key in cases:
        name = key.removeprefix(SWAP)
        if key.startswith(SWAP) and name not in scenario.specs:
            raise UsageError(
                f"file {study.settings.cases!r}, column {name!r}: no component {name!r} to swap, "
                f"and keys have a dot, such as 'scenario.stop'; {nearest(name, scenario.specs)}"
            )


def _check_keys(study: StudyFile, varied: Iterable[tuple[str, str]]) -> None:
    """Check that no key is given twice, or inside another one; each has whence it comes."""
    given = [(address(name), how, name) for name, how in varied]
    given += [(address(short(key)), "set", short(key)) for key in study.settings.set]
    given += [(f"{SWAP}{name}", "set", f"{SWAP}{name}") for name in study.settings.swap]
    given.sort(key=lambda item: item[0].split("."))
    for (one, how, first), (other, again, second) in pairwise(given):
        is_inside = other.startswith(f"{one}.") and how != "set"
        if one == other or is_inside:
            raise UsageError(
                f"expected one of {first!r} ({how}) and {second!r} ({again}), got both"
            )


def _layout(study: StudyFile, grid: Sequence[GridVariation], cases: int) -> MemberLayout:
    settings = study.settings
    noises = settings.samples or 0
    samples = cases
    if noises:
        samples = noises * (len(study.sampled) + 2 if settings.sampling == "saltelli" else 1)
    counts = [len(item.values) for item in grid]
    layout = MemberLayout(
        samples=samples, seeds=settings.seeds or 1, grid=math.prod(counts), noises=noises
    )
    if layout.members > MOST_MEMBERS:
        factors = [count for count in (samples, layout.seeds, *counts) if count > 1]
        raise UsageError(
            f"{study.source}: expected at most {MOST_MEMBERS} members, got "
            f"{' x '.join(map(str, factors))} = {layout.members}"
        )
    return layout


def _sampled_columns(study: StudyFile, scenario: Scenario) -> dict[str, DesignColumn]:
    settings = study.settings
    if not study.sampled or settings.samples is None:
        return {}
    keys = [item.key for item in study.sampled]
    points = unit_points(settings.sampling or "random", keys, settings.samples, seed=settings.seed)
    columns: dict[str, DesignColumn] = {}
    for item, p in zip(study.sampled, points, strict=True):
        if item.distribution == "choice":
            columns[item.key] = SampleColumn(packed(item.values), chosen(item, p))
            continue
        own = math.nan
        if item.distribution.startswith("tolerance"):
            own = _own_number(edited_scenario(study, scenario, _first_swaps(study)), item.key)
        for begin in range(0, len(p), _BLOCK):
            block = p[begin : begin + _BLOCK]
            block[:] = quantiles(item, block, own)
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


def _first_swaps(study: StudyFile) -> dict[str, str]:
    varied = [item for item in study.variations if item.key.startswith(SWAP)]
    return {item.key.removeprefix(SWAP): item.values[0] for item in varied}


def _noise_sources(study: StudyFile, scenario: Scenario, names: Sequence[str]) -> dict[str, str]:
    """Return the noise sources that get seeds, by the keys of their seeds."""
    if study.settings.seeds is None:
        return {}
    edited = edited_scenario(study, scenario, _first_swaps(study))
    sources = {}
    for name, table in edited.tree["components"].items():
        if table.get("seed") is not None and f"{SWAP}{name}" not in names:
            sources[short(f"{COMPONENTS}.{name}.seed")] = name
    if study.settings.replay is None and RECORDING not in names:  # a replay has them recorded
        for number, action in edited.actions.items():
            loses = action.drop is not None and not isinstance(action.drop, bool)
            if action.noise is not None or loses:
                sources[f"{ACTIONS}.{number}.seed"] = f"{ACTIONS}.{number}"
    if not sources:
        raise UsageError(
            f"{option('seeds')}: nothing in the scenario has a seed; add a component with noise, "
            'such as { kind = "sensor", noise = 1e-3, seed = 1 }'
        )
    return sources


# --- the scenario's own values ---


def _own_number(scenario: Scenario, key: str) -> float:
    """Return the number that a tolerance is of."""
    value = own_value(scenario, key)
    label = f"{option('vary', key)}: a tolerance is relative to the scenario's own value"
    if value is None or value == 0:
        found = "which it does not set" if value is None else "which is 0"
        raise UsageError(
            f"{label}, {found}; use another distribution, such as {{ uniform = [LOWER, UPPER] }}"
        )
    if isinstance(value, bool) or not isinstance(value, int | float):
        way_out = f"; name an element: {key}[0]" if isinstance(value, list | tuple) else ""
        raise UsageError(f"{label}, a number; got {quoted(value)}{way_out}")
    return float(value)


def own_value(scenario: Scenario, key: str) -> Any:
    """Return what the scenario has for a key, a default included; None: nothing."""
    component = component_in(key)
    first, _, rest = key.removeprefix(f"{COMPONENTS}.").partition(".")
    if component is None and first in FLAT:
        return scenario.tree.get(first, {}).get(rest)
    parts = address(rest).split(".")
    path = (first, *parts) if component is None else (COMPONENTS, first, *parts)
    value = _inner(scenario.tree, path)
    if value is None and component is not None:
        value = _inner(scenario.specs.get(first), parts)
    if value is None and component is None and first == "scenario":
        value = getattr(scenario.file.scenario, rest, None)
    return value


def _inner(value: Any, path: Iterable[str]) -> Any:
    for part in path:
        match value:
            case dict():
                value = value.get(part)
            case list() | tuple():
                is_there = part.isdigit() and int(part) < len(value)
                value = value[int(part)] if is_there else None
            case _:
                value = getattr(value, part, None) if part.isidentifier() else None
    return value


# --- points between 0 and 1 ---


def unit_points(method: SamplingMethod, keys: Sequence[str], samples: int, *, seed: int) -> Matrix:
    """Return points of the unit cube, a row for each key: inside it, never on its faces.

    Raises
    ------
    UsageError
        If the method needs another number of samples.
    """
    match method:
        case "random":
            points = np.stack([_generator(seed, key).random(samples) for key in keys])
        case "latin-hypercube":
            from scipy.stats.qmc import LatinHypercube

            hypercube = LatinHypercube(len(keys), rng=_generator(seed))
            points = np.ascontiguousarray(hypercube.random(samples).T)
        case "sobol":
            points = _sobol(len(keys), samples, seed)
        case "saltelli":
            points = _saltelli(len(keys), samples, seed)
    return np.clip(points, _SMALLEST, 1.0 - 2 * _SMALLEST, out=points)


def _sobol(dimensions: int, samples: int, seed: int) -> Matrix:
    from scipy.stats.qmc import Sobol

    sequence = Sobol(dimensions, scramble=True, bits=_BITS, rng=_generator(seed))
    points = sequence.random_base2((samples - 1).bit_length())[:samples]
    rows = np.ascontiguousarray(points.T)
    rows += 2.0 ** -(_BITS + 1)
    return rows


def _saltelli(dimensions: int, samples: int, seed: int) -> Matrix:
    """Return matrices A, B, and A with one column of B, one behind the other."""
    if samples & (samples - 1):
        below = 1 << (samples.bit_length() - 1)
        raise UsageError(
            f"{option('samples')}: expected a power of two for Saltelli's design, got {samples}; "
            f"nearest: {below} or {2 * below}"
        )
    first, second = np.split(_sobol(2 * dimensions, samples, seed), 2)
    points = np.repeat(first[:, np.newaxis], dimensions + 2, axis=1)
    points[:, 1] = second
    for number in range(dimensions):
        points[number, number + 2] = second[number]
    return points.reshape(dimensions, -1)
