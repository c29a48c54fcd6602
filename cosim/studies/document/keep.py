"""Which members' logs are kept: ``"failed"``, ``"all"``, ``"worst 5 of METRIC"``, or numbers."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, Literal

from cosim.errors import UsageError, quoted

NEEDED: Final = (
    'expected "failed", "all", "worst 5 of METRIC", "best 5 of METRIC", or a list of numbers'
)
_RANKED: Final = re.compile(r"(worst|best) ([1-9][0-9]{0,6}) of (\S.*)")


@dataclass(frozen=True, slots=True)
class KeptLogs:
    """Which members' logs are kept.

    Parameters
    ----------
    which : {"none", "failed", "all", "worst", "best", "numbers"}
        The worst members have the largest values of a metric, the best ones the smallest.
    count : int
        Of the worst or best ones.
    metric : str
        That these are of.
    numbers : tuple of int
        Of the members; in order, each once.
    """

    which: Literal["none", "failed", "all", "worst", "best", "numbers"] = "none"
    count: int = 0
    metric: str = ""
    numbers: tuple[int, ...] = ()


def read_keep(value: str | tuple[int, ...] | None) -> KeptLogs:
    """Read the key ``keep``.

    Raises
    ------
    UsageError
        If it is none of those.
    """
    if value is None:
        return KeptLogs()
    if not isinstance(value, str):
        if not value or min(value) < 0:
            raise UsageError(f"{NEEDED} from 0, got {quoted(list(value))}")
        return KeptLogs("numbers", numbers=tuple(sorted(set(value))))
    text = value.strip()
    if text == "failed":
        return KeptLogs("failed")
    if text == "all":
        return KeptLogs("all")
    match = _RANKED.fullmatch(text)
    if match is None:
        raise UsageError(f"{NEEDED}, got {quoted(value)}")
    count = int(match[2])
    if match[1] == "worst":
        return KeptLogs("worst", count, match[3])
    return KeptLogs("best", count, match[3])
