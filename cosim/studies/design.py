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
from typing import Any, TypeAlias, final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.errors import UsageError, option, quoted
from cosim.files import file_type
from cosim.scenario.document.document import component_in, parts_of, short
from cosim.scenario.document.places import PORTS
from cosim.scenario.document.schema import ACTIONS, COMPONENTS
from cosim.scenario.kinds.base import Scenario
from cosim.scenario.recordings.replaying import texts_in
from cosim.studies.cases import packed, read_cases
from cosim.studies.contracts import MOST_MEMBERS, RECORDING, SWAP, StudyMember, member_of
from cosim.studies.layout import SampleKind, StudyLayout
from cosim.studies.study_file import SamplingMethod, StudyFile
from cosim.studies.variations import GridVariation, SampledVariation, chosen, quantiles

_Array: TypeAlias = NDArray[Any]  # of float64, int64 or object


@final
@dataclass(frozen=True, slots=True)
class ValueColumn:
    """Values of a key, each of ``stride`` members in turn, over and over."""

    values: _Array
    stride: int = 1

    def take(self, numbers: NDArray[np.int64]) -> _Array:
        """Return the values of some members."""
        return np.asarray(self.values[numbers // self.stride % len(self.values)])


@dataclass(frozen=True, slots=True)
class StudyDesign:
    """The members of a study.

    Parameters
    ----------
    study : StudyFile
    layout : StudyLayout
    columns : mapping of key to ValueColumn
        In the order of the dataset.
    """

    study: StudyFile
    layout: StudyLayout
    columns: Mapping[str, ValueColumn] = field(repr=False)

    def __len__(self) -> int:
        return self.layout.members

    @property
    def cases(self) -> dict[str, ValueColumn]:
        """The columns of the table of cases."""
        if self.study.settings.cases is None:
            return {}
        others = {*(item.key for item in self.study.variations), *self.layout.noise_seeds}
        others |= set() if self.study.settings.replay is None else {RECORDING}
        return {name: column for name, column in self.columns.items() if name not in others}

    def column(self, name: str, begin: int = 0, end: int | None = None) -> _Array:
        """Return the values of a key, from one member to another (not included)."""
        numbers = range(len(self))[begin:end]
        return self.columns[name].take(np.arange(numbers.start, numbers.stop))

    def texts(self) -> set[str]:
        """Return all texts among the values: some are paths."""
        columns = [column.values for column in self.columns.values()]
        return texts_in([values.tolist() for values in columns if values.dtype == object])

    def member(self, number: int) -> StudyMember:
        """Return a member."""
        return self.members(number, number + 1)[0]

    def members(self, begin: int = 0, end: int | None = None) -> list[StudyMember]:
        """Return the members from one number to another (not included)."""
        numbers = range(len(self))[begin:end]
        columns = [self.column(name, begin, end).tolist() for name in self.columns]
        rows = zip(*columns, strict=True) if columns else ((),) * len(numbers)
        return [
            member_of(number, dict(zip(self.columns, row, strict=True)))
            for number, row in zip(numbers, rows, strict=True)
        ]


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
    grid = list(study.grid)
    if recordings:
        grid.insert(0, GridVariation(RECORDING, recordings))
    given = [(RECORDING, "of the logs")] if recordings else []
    given += [(item.key, "varied") for item in study.variations]
    given += [(key, "of the cases") for key in cases]
    firsts = {item.key: item.values[0] for item in study.variations if item.key.startswith(SWAP)}
    edited = edited_scenario(study, scenario, member_of(0, firsts).swap)
    sources: dict[str, str] = {}
    if settings.seeds is not None:
        sources = _noise_sources(edited, {key for key, _ in given})
    given += [(key, "of the seeds") for key in sources]
    check_keys(given, [*settings.set, *(f"{SWAP}{name}" for name in settings.swap)])

    layout = _layout(study, grid, [*sources], cases)
    columns = {}
    stride = layout.grid
    for item in grid:
        stride //= len(item.values)
        columns[item.key] = ValueColumn(packed(item.values), stride)
    each = layout.grid * layout.seeds
    if study.sampled:
        method, samples = settings.sampling or "random", settings.samples or 1
        points = unit_points(method, layout.parameters, samples, seed=settings.seed)
        for drawn, row in zip(study.sampled, points, strict=True):
            columns[drawn.key] = ValueColumn(_drawn(drawn, row, edited), each)
    columns |= {key: ValueColumn(values, each) for key, values in cases.items()}
    # Seeds are the same in every case, and of Saltelli's matrices; each sample has its own.
    count = layout.seeds * (settings.samples or 1)
    for key, name in sources.items():
        raw = np.random.PCG64(_sequence(settings.seed, name)).random_raw(count)
        columns[key] = ValueColumn((raw >> np.uint64(11)).view(np.int64), layout.grid)
    return StudyDesign(study, layout, columns)


def _sequence(seed: int, name: str = "") -> np.random.SeedSequence:
    return np.random.SeedSequence(seed, spawn_key=tuple(name.encode()))


def edited_scenario(
    study: StudyFile,
    scenario: Scenario,
    swaps: Mapping[str, str],
    changes: Mapping[str, Any] | None = None,
) -> Scenario:
    """Return the scenario of a member; of a replay as far as it is known without its log."""
    settings = study.settings
    swap = {**settings.swap, **swaps}
    maps = {} if study.may_replay and not swap else dict(settings.map)
    return scenario.edit(swap=swap, map=maps, set={**settings.set, **(changes or {})})


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
                raise UsageError(
                    f"{option(name)}: nothing is drawn: no key has a distribution, such as "
                    f"{{ uniform = [0.0, 1.0] }}; the runs of a noise source are {option('seeds')}"
                )
        return
    key = study.sampled[0].key
    if settings.samples is None:
        raise UsageError(
            f"{option('samples')}: expected the number of draws, such as 100, as {key!r} has a "
            "distribution; got none"
        )
    if settings.cases is not None:
        raise UsageError(f"expected either {option('cases')} or distributions ({key!r}), got both")


def check_keys(varied: Iterable[tuple[str, str]], common: Iterable[str]) -> None:
    """Check that no key is given twice, or inside another one.

    Parameters
    ----------
    varied : iterable of (key, how)
        How it is varied, in a word.
    common : iterable of str
        Keys of what all members have.

    Raises
    ------
    UsageError
        If one is; names both.
    """
    given = [(parts_of(name), how, name) for name, how in varied]
    given += [(parts_of(short(key)), "set", short(key)) for key in common]
    given.sort(key=lambda item: item[0])
    for (one, how, first), (other, again, second) in pairwise(given):
        is_inside = other[: len(one)] == one and how != "set"
        if one == other or is_inside:
            raise UsageError(
                f"expected one of {first!r} ({how}) and {second!r} ({again}), got both"
            )


def _layout(
    study: StudyFile, grid: Sequence[GridVariation], noise: Sequence[str], cases: Mapping[str, Any]
) -> StudyLayout:
    settings = study.settings
    kind: SampleKind = "cases" if cases else "grid"
    drawn = tuple(item.key for item in study.sampled)
    samples = max(map(len, cases.values()), default=settings.samples or 1)
    if drawn:
        kind = settings.sampling or "random"
        samples *= len(drawn) + 2 if kind == "saltelli" else 1
    counts = [samples, settings.seeds or 1, *(len(item.values) for item in grid)]
    members = math.prod(counts)
    if members > MOST_MEMBERS:
        product = " x ".join(str(count) for count in counts if count > 1)
        raise UsageError(
            f"{study.source}: expected at most {MOST_MEMBERS} members, got {product} = {members}"
        )
    points = math.prod(counts[2:])
    return StudyLayout(kind, drawn, tuple(noise), samples=samples, seeds=counts[1], grid=points)


def _drawn(item: SampledVariation, p: Vector, scenario: Scenario) -> _Array:
    """Return what is drawn at some probabilities."""
    if item.distribution == "choice":
        return packed(item.values)[chosen(item, p)]
    is_tolerance = item.distribution.startswith("tolerance")
    own = _own_number(scenario, item.key) if is_tolerance else math.nan
    values = quantiles(item, p, own)
    wrong = values[~np.isfinite(values)]
    if len(wrong):
        raise UsageError(
            f"{option('vary', item.key)}: {item.distribution} of {quoted(list(item.numbers))} "
            f"gives {wrong[0]}; expected numbers below {np.finfo(float).max:g}"
        )
    return values


def _noise_sources(scenario: Scenario, varied: set[str]) -> dict[str, str]:
    """Return the noise sources that get seeds, by the keys of their seeds."""
    sources = {}
    for name, table in scenario.tree["components"].items():
        if table.get("seed") is not None and f"{SWAP}{name}" not in varied:
            sources[short(f"{COMPONENTS}.{name}.seed")] = name
    for number, action in scenario.actions.items():
        loses = action.drop is not None and not isinstance(action.drop, bool)
        is_noisy = action.noise is not None or loses
        if is_noisy and RECORDING not in varied:  # a replay has it recorded
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
    parts = parts_of(rest)
    if component_in(key) is not None:
        value = _inner(scenario.tree, (COMPONENTS, first, *parts))
        return _inner(scenario.specs.get(first), parts) if value is None else value
    if first in PORTS:
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
                value = getattr(value, part, None)
    return value


# --- points between 0 and 1 ---


def unit_points(method: SamplingMethod, keys: Sequence[str], samples: int, *, seed: int) -> Matrix:
    """Return points of the unit cube, a row for each key: inside it, never on its faces.

    Of Saltelli's design these are matrices A, B, and A with one column of B, one behind the other.

    Raises
    ------
    UsageError
        If the method needs another number of samples.
    """
    count = len(keys)
    match method:
        case "random":
            points = np.empty((count, samples))
            for row, key in zip(points, keys, strict=True):
                np.random.Generator(np.random.PCG64(_sequence(seed, key))).random(out=row)
        case "latin-hypercube":
            from scipy.stats.qmc import LatinHypercube

            drawn = LatinHypercube(count, rng=np.random.default_rng(_sequence(seed)))
            points = np.ascontiguousarray(drawn.random(samples).T)
        case "sobol":
            points = _sobol(count, samples, seed)
        case "saltelli":
            if samples & (samples - 1):
                below = 1 << (samples.bit_length() - 1)
                raise UsageError(
                    f"{option('samples')}: expected a power of two for Saltelli's design, got "
                    f"{samples}; nearest: {below} or {2 * below}"
                )
            first, second = np.split(_sobol(2 * count, samples, seed), 2)
            matrices = np.repeat(first[:, np.newaxis], count + 2, axis=1)
            matrices[:, 1] = second
            matrices[range(count), range(2, count + 2)] = second
            points = matrices.reshape(count, -1)
    smallest = 2.0**-54
    return np.clip(points, smallest, 1.0 - 2 * smallest, out=points)


def _sobol(dimensions: int, samples: int, seed: int) -> Matrix:
    from scipy.stats.qmc import Sobol

    bits = 30
    generator = np.random.default_rng(_sequence(seed))
    sequence = Sobol(dimensions, scramble=True, bits=bits, rng=generator)
    points = sequence.random_base2((samples - 1).bit_length())[:samples]
    rows: Matrix = np.ascontiguousarray(points.T)
    rows += 2.0 ** -(bits + 1)
    return rows
