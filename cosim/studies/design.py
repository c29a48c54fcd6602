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
from typing import Any, Final, final

import numpy as np

from cosim.arrays import Matrix
from cosim.errors import UsageError, option, quoted
from cosim.files import file_type
from cosim.scenario.document.edits import ACTIONS, COMPONENTS, FLAT, component_in, short
from cosim.scenario.document.elements import address
from cosim.scenario.parsing import Scenario
from cosim.scenario.recordings.replaying import texts_in
from cosim.studies.cases import ColumnValues, packed, read_cases
from cosim.studies.contracts import MOST_MEMBERS, RECORDING, SWAP, StudyMember, member_of
from cosim.studies.layout import NumberColumn, SampleKind, StudyLayout
from cosim.studies.study_file import SamplingMethod, StudyFile
from cosim.studies.variations import GridVariation, SampledVariation, chosen, quantiles

_BLOCK: Final = 2**16  # samples whose temporary arrays stay small


# --- members by number ---


@final
@dataclass(frozen=True, slots=True)
class ValueColumn:
    """Values of a key in turn, each of ``stride`` members; ``indices``: which of the values."""

    values: ColumnValues
    stride: int = 1
    indices: np.ndarray[Any, np.dtype[np.intp]] | None = None

    def take(self, layout: StudyLayout, numbers: NumberColumn) -> ColumnValues:
        """Return the values of some members."""
        turns: np.ndarray[Any, Any] = numbers // self.stride
        if self.indices is None:
            turns = turns % len(self.values)
        else:
            turns = self.indices[turns % len(self.indices)]
        if isinstance(self.values, np.ndarray):
            return np.asarray(self.values[turns])
        return [self.values[index] for index in turns.tolist()]

    def at(self, place: int) -> Any:
        """Return the value of a turn."""
        return self.values[place if self.indices is None else self.indices[place]]


@final
@dataclass(frozen=True, slots=True)
class NoiseSeedColumn:
    """The seeds of a noise source, from a stream of its own."""

    study_seed: int
    name: str

    def take(self, layout: StudyLayout, numbers: NumberColumn) -> ColumnValues:
        """Return the seeds of some members."""
        indices = layout.noises_of(numbers)
        if not len(indices):
            return np.empty(0, np.int64)
        begin = int(indices.min())
        stream = np.random.PCG64(_sequence(self.study_seed, self.name))
        stream.advance(begin)
        raw = np.asarray(stream.random_raw(int(indices.max()) + 1 - begin), np.uint64)
        return np.asarray((raw >> np.uint64(11)).astype(np.int64)[indices - begin])


def _sequence(seed: int, name: str = "") -> np.random.SeedSequence:
    return np.random.SeedSequence(seed, spawn_key=tuple(name.encode()))


def plain_values(values: ColumnValues) -> list[Any]:
    """Return the values of a column as a list."""
    return values.tolist() if isinstance(values, np.ndarray) else values


@dataclass(frozen=True, slots=True)
class StudyDesign:
    """The members of a study.

    Parameters
    ----------
    study : StudyFile
    layout : StudyLayout
    columns : mapping of key to ValueColumn or NoiseSeedColumn
        In the order of the dataset.
    """

    study: StudyFile
    layout: StudyLayout
    columns: Mapping[str, ValueColumn | NoiseSeedColumn] = field(repr=False)

    def __len__(self) -> int:
        return self.layout.members

    @property
    def names(self) -> tuple[str, ...]:
        """The keys."""
        return tuple(self.columns)

    @property
    def values(self) -> dict[str, ValueColumn]:
        """The columns of all but seeds of noise."""
        return {n: c for n, c in self.columns.items() if isinstance(c, ValueColumn)}

    @property
    def cases(self) -> dict[str, ValueColumn]:
        """Those of the table of cases."""
        settings = self.study.settings
        others = {item.key for item in self.study.variations}
        others |= set() if settings.replay is None else {RECORDING}
        columns = {} if settings.cases is None else self.values
        return {name: column for name, column in columns.items() if name not in others}

    def column(self, name: str, begin: int = 0, end: int | None = None) -> ColumnValues:
        """Return the values of a key, from one member to another (not included)."""
        return self.columns[name].take(self.layout, self._numbers(begin, end))

    def texts(self) -> set[str]:
        """Return all texts among the values: some are paths."""
        return texts_in([c.values for c in self.values.values() if isinstance(c.values, list)])

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

    def _numbers(self, begin: int, end: int | None) -> NumberColumn:
        last = len(self) if end is None else min(end, len(self))
        return np.arange(max(0, begin), last, dtype=np.int64)


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
    is_replay = bool(recordings) or RECORDING in cases
    grid = list(study.grid)
    if recordings:
        grid.insert(0, GridVariation(RECORDING, recordings))
    names = [*(item.key for item in grid), *(item.key for item in study.sampled), *cases]
    swapped = {name.removeprefix(SWAP) for name in names if name.startswith(SWAP)}
    firsts = {item.key: item.values[0] for item in study.variations if item.key.startswith(SWAP)}
    edited = edited_scenario(study, scenario, member_of(0, firsts).swap)
    sources = {} if settings.seeds is None else _noise_sources(edited, swapped, is_replay)
    froms = {RECORDING: "of the logs"} if recordings else {}
    froms |= dict.fromkeys((item.key for item in study.variations), "varied")
    given = [*froms.items()] + [(key, "of the cases") for key in cases]
    _check_keys(study, [*given, *((key, "of the seeds") for key in sources)])

    layout = _layout(study, grid, [*sources], cases)
    columns: dict[str, ValueColumn | NoiseSeedColumn] = {}
    stride = layout.grid
    for item in grid:
        stride //= len(item.values)
        columns[item.key] = ValueColumn(packed(item.values), stride)
    each = layout.grid * layout.seeds
    for drawn, points in zip(study.sampled, _unit_points(study), strict=True):
        columns[drawn.key] = _drawn_column(drawn, points, each, edited)
    columns |= {key: ValueColumn(values, each) for key, values in cases.items()}
    columns |= {key: NoiseSeedColumn(settings.seed, name) for key, name in sources.items()}
    return StudyDesign(study, layout, columns)


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
    if not study.sampled:
        for name in ("samples", "sampling"):
            if getattr(settings, name) is not None:
                seeds = f"; the runs of a noise source are {option('seeds')}"
                raise UsageError(
                    f"{option(name)}: nothing is drawn: no key has a distribution, such as "
                    f"{{ uniform = [0.0, 1.0] }}{seeds if name == 'samples' else ''}"
                )
    elif settings.samples is None:
        raise UsageError(
            f"{option('samples')}: expected the number of draws, such as 100, as "
            f"{study.sampled[0].key!r} has a distribution; got none"
        )
    elif settings.cases is not None:
        key = study.sampled[0].key
        raise UsageError(f"expected either {option('cases')} or distributions ({key!r}), got both")


def _check_keys(study: StudyFile, varied: Iterable[tuple[str, str]]) -> None:
    """Check that no key is given twice, or inside another one; each has where it comes from."""
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


def _layout(
    study: StudyFile, grid: Sequence[GridVariation], noise: Sequence[str], cases: Mapping[str, Any]
) -> StudyLayout:
    settings = study.settings
    kind: SampleKind = "cases" if cases else "grid"
    samples = max(map(len, cases.values()), default=1)
    if study.sampled and settings.samples is not None:
        kind = settings.sampling or "random"
        samples = settings.samples * (len(study.sampled) + 2 if kind == "saltelli" else 1)
    counts = [samples, settings.seeds or 1, *(len(item.values) for item in grid)]
    members = math.prod(counts)
    if members > MOST_MEMBERS:
        product = " x ".join(str(count) for count in counts if count > 1)
        raise UsageError(
            f"{study.source}: expected at most {MOST_MEMBERS} members, got {product} = {members}"
        )
    drawn = tuple(item.key for item in study.sampled)
    samples, seeds, *points = counts
    return StudyLayout(
        kind, drawn, tuple(noise), samples=samples, seeds=seeds, grid=math.prod(points)
    )


def _drawn_column(item: SampledVariation, p: Any, each: int, scenario: Scenario) -> ValueColumn:
    """Return what is drawn at probabilities, which are overwritten."""
    if item.distribution == "choice":
        return ValueColumn(packed(item.values), each, chosen(item, p))
    is_tolerance = item.distribution.startswith("tolerance")
    own = _own_number(scenario, item.key) if is_tolerance else math.nan
    for begin in range(0, len(p), _BLOCK):
        block = p[begin : begin + _BLOCK]
        block[:] = quantiles(item, block, own)
    wrong = p[~np.isfinite(p)]
    if len(wrong):
        raise UsageError(
            f"{option('vary', item.key)}: {item.distribution} of {quoted(list(item.numbers))} "
            f"gives {wrong[0]}; expected numbers below {np.finfo(float).max:g}"
        )
    return ValueColumn(p, each)


def _noise_sources(scenario: Scenario, swapped: set[str], is_replay: bool) -> dict[str, str]:
    """Return the noise sources that get seeds, by the keys of their seeds."""
    sources = {}
    for name, table in scenario.tree["components"].items():
        if table.get("seed") is not None and name not in swapped:
            sources[short(f"{COMPONENTS}.{name}.seed")] = name
    for number, action in scenario.actions.items():
        loses = action.drop is not None and not isinstance(action.drop, bool)
        if not is_replay and (action.noise is not None or loses):  # a replay has them recorded
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
    first, _, rest = key.removeprefix(f"{COMPONENTS}.").partition(".")
    parts = address(rest).split(".")
    if component_in(key) is not None:
        value = _inner(scenario.tree, (COMPONENTS, first, *parts))
        return _inner(scenario.specs.get(first), parts) if value is None else value
    if first in FLAT:
        return scenario.tree.get(first, {}).get(rest)
    value = _inner(scenario.tree, (first, *parts))
    if value is None and first == "scenario":
        return getattr(scenario.file.scenario, rest, None)
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


def _unit_points(study: StudyFile) -> Matrix:
    settings = study.settings
    keys = [item.key for item in study.sampled]
    if not keys or settings.samples is None:
        return np.empty((0, 0))
    return unit_points(settings.sampling or "random", keys, settings.samples, seed=settings.seed)


def unit_points(method: SamplingMethod, keys: Sequence[str], samples: int, *, seed: int) -> Matrix:
    """Return points of the unit cube, a row for each key: inside it, never on its faces.

    Raises
    ------
    UsageError
        If the method has not so many dimensions, or needs another number of samples.
    """
    dimensions = len(keys)
    match method:
        case "random":
            points = np.empty((dimensions, samples))
            for row, key in zip(points, keys, strict=True):
                np.random.Generator(np.random.PCG64(_sequence(seed, key))).random(out=row)
        case "latin-hypercube":
            from scipy.stats.qmc import LatinHypercube

            drawn = LatinHypercube(dimensions, rng=np.random.default_rng(_sequence(seed)))
            points = np.ascontiguousarray(drawn.random(samples).T)
        case "sobol":
            points = _sobol(dimensions, samples, seed)
        case "saltelli":
            points = _saltelli(dimensions, samples, seed)
    smallest = 2.0**-54
    return np.clip(points, smallest, 1.0 - 2 * smallest, out=points)


def _sobol(dimensions: int, samples: int, seed: int) -> Matrix:
    from scipy.stats.qmc import Sobol

    if dimensions > Sobol.MAXDIM:
        raise UsageError(
            f"{option('sampling')}: a Sobol sequence has at most {Sobol.MAXDIM} dimensions, "
            f"and the study has {dimensions}"
        )
    bits = 30
    generator = np.random.default_rng(_sequence(seed))
    sequence = Sobol(dimensions, scramble=True, bits=bits, rng=generator)
    points = sequence.random_base2((samples - 1).bit_length())[:samples]
    rows: Matrix = np.ascontiguousarray(points.T)
    rows += 2.0 ** -(bits + 1)
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
