"""Which member is in which part of a dataset.

A part ends at every multiple of the part size, and where the study ended when it was grown. So the
parts follow from the description of the dataset alone, however its members were run; a part that
is written again replaces itself.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Final

from pydantic import Field

from cosim.studies.contracts import MOST_MEMBERS

PARTS: Final = "parts"
_NAME: Final = re.compile(r"part-(\d+)-(\d+)\.parquet")


@dataclass(frozen=True, slots=True)
class PartLayout:
    """The division of members into parts.

    Parameters
    ----------
    size : int
        The most members of a part.
    lengths : tuple of int
        How many members the study had, each time that it was planned; rising.
    """

    size: Annotated[int, Field(ge=1)]
    lengths: Annotated[
        tuple[Annotated[int, Field(ge=0, le=MOST_MEMBERS)], ...], Field(min_length=1)
    ]

    def __post_init__(self) -> None:
        if list(self.lengths) != sorted(self.lengths):
            raise ValueError(f"expected rising numbers of members, got {self.lengths}")

    @property
    def total(self) -> int:
        """How many members there are."""
        return self.lengths[-1]

    def part_of(self, number: int) -> range:
        """Return the members of the part that holds a member."""
        first = number - number % self.size
        end = first + self.size
        place = bisect_right(self.lengths, number)
        if place:
            first = max(first, self.lengths[place - 1])
        if place < len(self.lengths):
            end = min(end, self.lengths[place])
        return range(first, end)

    def parts(self) -> Iterator[range]:
        """Yield the members of every part, in order."""
        number = 0
        while number < self.total:
            part = self.part_of(number)
            yield part
            number = part.stop

    def grown(self, total: int) -> PartLayout:
        """Return the division where there are ``total`` members.

        Fewer than before are possible where none of the others has an outcome.
        """
        kept = tuple(length for length in self.lengths if length < total)
        return PartLayout(self.size, (*kept, total))


def part_name(part: range) -> str:
    """Return the name of the file of a part; names are in the order of the members."""
    return f"{PARTS}/part-{part.start:010d}-{part.stop - 1:010d}.parquet"


def part_members(name: str) -> range | None:
    """Return the members of a part by the name of its file; None: it is no part."""
    found = _NAME.fullmatch(name)
    return None if found is None else range(int(found[1]), int(found[2]) + 1)
