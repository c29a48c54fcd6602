"""When the log of a run goes on in a next file, and how its files are called.

A log that is rotated is ``run.mcap``, ``run.part2.mcap``, ``run.part3.mcap``, ...
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from math import ceil
from pathlib import Path
from typing import Final

from cosim.core.clock import LARGEST_NS
from cosim.core.signals import Channel
from cosim.errors import UsageError, option, quoted
from cosim.instants import NANOSECONDS, StepNs

_SIZES: Final = {
    "B": 1,
    "kB": 10**3,
    "MB": 10**6,
    "GB": 10**9,
    "TB": 10**12,
    "KiB": 2**10,
    "MiB": 2**20,
    "GiB": 2**30,
}
_TIMES: Final = {"s": NANOSECONDS, "min": 60 * NANOSECONDS, "h": 3600 * NANOSECONDS}
_LIMIT: Final = re.compile(r"(\d{1,15}(?:\.\d{1,15})?) ?([A-Za-z]+)", re.ASCII)
_SMALLEST: Final = 10**6  # bytes: about what is written at a time
_PART_NAME: Final = re.compile(r"(.+)\.part([2-9]|[1-9]\d{1,8})", re.ASCII)


@dataclass(frozen=True, slots=True)
class Rotation:
    """After how much of one file a next one begins; one of the two is given.

    Parameters
    ----------
    size : int or None
        Of the file [bytes].
    span_ns : int or None
        Simulated time in it [ns].
    text : str
        As it was asked for.
    """

    size: int | None
    span_ns: int | None
    text: str

    def check(self, channels: Sequence[Channel], step_ns: StepNs, head_bytes: int) -> None:
        """Check that every file has room for rows.

        Parameters
        ----------
        channels : sequence of Channel
            The components that are recorded.
        step_ns : int
            Communication step [ns].
        head_bytes : int
            What precedes the rows in each file.

        Raises
        ------
        UsageError
            If it has not.
        """
        if self.size is not None and self.size < 2 * head_bytes:
            raise UsageError(
                f"{option('rotate')}: expected at least {2 * head_bytes}B (twice what every file "
                f"begins with), got {self.text!r}"
            )
        period_ns = ceil(step_ns * max((channel.period for channel in channels), default=1))
        if self.span_ns is not None and self.span_ns < period_ns:
            raise UsageError(
                f"{option('rotate')}: expected at least {period_ns / NANOSECONDS} s, so that every "
                f"file has a row of every component, got {self.text!r}"
            )


def read_rotation(text: object) -> Rotation:
    """Read a limit, such as ``1GB`` or ``1h``.

    Raises
    ------
    UsageError
        If it is neither a size nor a time, or too small.
    """
    match = _LIMIT.fullmatch(text.strip()) if isinstance(text, str) else None
    unit = "" if match is None else match[2]
    if match is None or unit not in _SIZES | _TIMES:
        raise UsageError(
            f"{option('rotate')}: expected a size in {', '.join(_SIZES)} or a simulated time in "
            f"{', '.join(_TIMES)}, such as 1GB or 1h, got {quoted(text)}"
        )
    amount = Decimal(match[1]) * (_SIZES | _TIMES)[unit]
    limit = int(amount)
    if unit in _SIZES:
        if limit < _SMALLEST:
            raise UsageError(
                f"{option('rotate')}: expected at least 1MB (about as much is written at a time), "
                f"got {match[0]!r}"
            )
        return Rotation(limit, None, match[0])
    if amount != limit or not 0 < limit <= LARGEST_NS:
        raise UsageError(
            f"{option('rotate')}: expected a whole number of nanoseconds > 0, got {match[0]!r}"
        )
    return Rotation(None, limit, match[0])


def part_path(first: Path, number: int) -> Path:
    """Return the path of a file of a log, counted from 1."""
    return first if number == 1 else first.with_name(f"{first.stem}.part{number}{first.suffix}")


def part_paths(path: Path) -> list[Path]:
    """Return the paths of the files of a log up to one of them, by its name."""
    match = _PART_NAME.fullmatch(path.stem)
    if match is None:
        return [path]
    first = path.with_name(match[1] + path.suffix)
    return [part_path(first, number) for number in range(1, int(match[2]) + 1)]


def further_parts(first: Path) -> list[Path]:
    """Return the files after the first one of a log that are there, in their order."""
    found = []
    if first.parent.is_dir():
        for path in first.parent.iterdir():
            match = _PART_NAME.fullmatch(path.stem)
            if match is not None and match[1] == first.stem and path.suffix == first.suffix:
                found.append((int(match[2]), path))
    return [path for _, path in sorted(found)]


def all_parts(path: Path) -> list[Path]:
    """Return the paths of all files of a log of which one is given, by their names."""
    first = part_paths(path)[0]
    return [first, *further_parts(first)]
