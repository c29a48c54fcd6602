"""Columns of a design: what a key is in every member, computed where it is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Protocol, TypeAlias, final

import numpy as np
from pydantic import Field

from cosim.studies.contracts import MOST_MEMBERS

MemberIndices: TypeAlias = np.ndarray[tuple[int], np.dtype[np.int64]]
ColumnValues: TypeAlias = np.ndarray[Any, Any] | list[Any]
_Count: TypeAlias = Annotated[int, Field(ge=1, le=MOST_MEMBERS)]  # where it is read from a file


@dataclass(frozen=True, kw_only=True)
class MemberNumbering:
    """How members are numbered: ((sample or case) * seeds + seed) * grid + index in the grid.

    Parameters
    ----------
    samples : int
        Samples or cases; 1: there are none.
    seeds : int
        Of each sample, case or point of the grid.
    grid : int
        Points of the grid.
    """

    samples: _Count = 1
    seeds: _Count = 1
    grid: _Count = 1

    @property
    def members(self) -> int:
        """How many there are."""
        return self.samples * self.seeds * self.grid

    def samples_of(self, numbers: MemberIndices) -> MemberIndices:
        """Return the samples or cases of some members."""
        return numbers // (self.grid * self.seeds)

    def seeds_of(self, numbers: MemberIndices) -> MemberIndices:
        """Return which seed of their sample, case or point some members have."""
        return numbers // self.grid % self.seeds


@final
@dataclass(frozen=True, kw_only=True)
class MemberLayout(MemberNumbering):
    """How members are numbered, and which of them have the same noise.

    Parameters
    ----------
    noises : int
        Of samples, how many have noise of their own: all, or the n in each block of Saltelli's
        design, whose blocks have the same; 0: all have the same.
    """

    noises: int = 0

    def noises_of(self, numbers: MemberIndices) -> MemberIndices:
        """Return which of its seeds a noise source has in some members.

        Samples have seeds of their own, cases the same ones, so that they can be compared.
        """
        seeds = self.seeds_of(numbers)
        if not self.noises:
            return seeds
        return self.samples_of(numbers) % self.noises * self.seeds + seeds


class DesignColumn(Protocol):
    """The values of a key by the number of the member."""

    def take(self, layout: MemberLayout, numbers: MemberIndices) -> ColumnValues:
        """Return the values of some members."""
        ...


@final
@dataclass(frozen=True, slots=True)
class GridColumn:
    """Each of some values in turn.

    Parameters
    ----------
    values : array or list
    stride : int
        Members that have a value before the next.
    """

    values: ColumnValues
    stride: int

    def take(self, layout: MemberLayout, numbers: MemberIndices) -> ColumnValues:
        """Return the values of some members."""
        indices = numbers % layout.grid // self.stride % len(self.values)
        return taken(self.values, indices)


@final
@dataclass(frozen=True, slots=True)
class SampleColumn:
    """A value for each sample or case.

    Parameters
    ----------
    values : array or list
    indices : array or None
        Of the value that each has; None: they are as many.
    """

    values: ColumnValues
    indices: np.ndarray[Any, np.dtype[np.intp]] | None = None

    def take(self, layout: MemberLayout, numbers: MemberIndices) -> ColumnValues:
        """Return the values of some members."""
        samples = layout.samples_of(numbers)
        return taken(self.values, samples if self.indices is None else self.indices[samples])


@final
@dataclass(frozen=True, slots=True)
class NoiseSeedColumn:
    """The seed of a noise source.

    Parameters
    ----------
    study_seed : int
    name : str
        Of the source.
    """

    study_seed: int
    name: str

    def take(self, layout: MemberLayout, numbers: MemberIndices) -> ColumnValues:
        """Return the seeds of some members."""
        indices = layout.noises_of(numbers)
        if not len(indices):
            return np.empty(0, np.int64)
        begin = int(indices.min())
        seeds = noise_seeds(self.study_seed, self.name, begin, int(indices.max()) + 1)
        return taken(seeds, indices - begin)


def noise_seeds(study_seed: int, name: str, begin: int, end: int) -> MemberIndices:
    """Return the seeds of a noise source from one number to another (not included).

    They are 53 bits of each number of a stream of the source's own, so that neither another source
    nor more seeds change them.
    """
    sequence = np.random.SeedSequence(study_seed, spawn_key=tuple(name.encode()))
    stream = np.random.PCG64(sequence)
    stream.advance(begin)
    raw = np.asarray(stream.random_raw(end - begin), np.uint64)
    return (raw >> np.uint64(11)).astype(np.int64)


def packed(values: Sequence[Any]) -> ColumnValues:
    """Return floats or integers as an array, other values as a list."""
    kinds = {type(value) for value in values}
    if kinds == {float}:
        return np.array(values, np.float64)
    if kinds == {int} and all(-(2**63) <= value < 2**63 for value in values):
        return np.array(values, np.int64)
    return list(values)


def taken(values: ColumnValues, indices: np.ndarray[Any, Any]) -> ColumnValues:
    """Return some of the values of a column."""
    if isinstance(values, np.ndarray):
        some: np.ndarray[Any, Any] = values[indices]
        return some
    return [values[index] for index in indices.tolist()]


def plain_values(values: ColumnValues) -> list[Any]:
    """Return the values of a column as those of Python, which TOML has."""
    return values.tolist() if isinstance(values, np.ndarray) else values
