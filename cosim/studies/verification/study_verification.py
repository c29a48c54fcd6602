"""What came of running members of a study again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class VerifiedDifference:
    """What is otherwise now than it is recorded.

    Parameters
    ----------
    member : int
    name : str
        Of a metric, a result, ``status``, ``reason`` or ``steps``.
    recorded, now : float, int, str or None
    """

    member: int
    name: str
    recorded: Any
    now: Any


@dataclass(frozen=True)
class StudyVerification:
    """What came of running members again.

    Parameters
    ----------
    name : str
        Of the study.
    members : tuple of int
        That ran again.
    done : int
        Members that have an outcome.
    values : tuple of str
        The names of what was compared.
    differences : tuple of VerifiedDifference
    elsewhere : tuple of str
        The machines on which these members ran, other than this one.
    environment : mapping of str to (str, str)
        What is recorded of versions and processor, and what there is now, where these differ.
    is_searched : bool
        A search chose the members; that it would choose these again is not verified.
    """

    name: str
    members: tuple[int, ...]
    done: int
    values: tuple[str, ...]
    differences: tuple[VerifiedDifference, ...]
    elsewhere: tuple[str, ...]
    environment: Mapping[str, tuple[str, str]]
    is_searched: bool

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return asdict(self)
