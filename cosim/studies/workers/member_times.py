"""How long members take: how many a worker has at a time, and when one hangs."""

from __future__ import annotations

from typing import Final, final

AHEAD: Final = 0.25  # [s] of members that a worker has
MOST_AHEAD: Final = 256  # members
FORGETTING: Final = 0.9  # of the time of a member, with each faster one that follows

FIRST_MEMBERS: Final = 10  # that are timed, where no limit is given
FACTOR: Final = 10.0  # of the longest of those
LEAST: Final = 60.0  # [s]
UNTIL_TIMED: Final = 3600.0  # [s]; nothing is known before a member was completed


@final
class MemberTimes:
    """Follows the wall times of members.

    Parameters
    ----------
    timeout : float or None
        [s]; None: 10 times the longest of the first ten that were completed, and at least 60 s.

    Attributes
    ----------
    limit : float
        Wall time after which a member hangs [s].
    """

    def __init__(self, timeout: float | None) -> None:
        self._recent = AHEAD  # [s], of the slow ones among the last
        self._timed = 0
        self._longest = 0.0
        self._is_given = timeout is not None
        self.limit = UNTIL_TIMED if timeout is None else timeout

    @property
    def origin(self) -> str:
        """Where the limit comes from, and how to have another one; empty: it was given."""
        if self._is_given:
            return ""
        if not self._timed:
            return ", the limit until a member is completed; set a timeout for another one"
        return (
            f", the larger of {LEAST:g} s and {FACTOR:g} times the longest of the first members; "
            "set a timeout for another one"
        )

    @property
    def ahead(self) -> int:
        """How many members a worker is to have, with the one that it runs."""
        return min(MOST_AHEAD, max(1, int(AHEAD / self._recent)))

    def note(self, seconds: float, *, is_complete: bool) -> None:
        """Take the time of a member into account [s]; one that failed says nothing of a hang."""
        self._recent = max(seconds, FORGETTING * self._recent)
        if self._is_given or not is_complete or self._timed == FIRST_MEMBERS:
            return
        self._timed += 1
        self._longest = max(self._longest, seconds)
        self.limit = max(LEAST, FACTOR * self._longest)
