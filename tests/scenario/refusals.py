"""Tables of bad input: every case is refused, and all that are not, or otherwise, are named."""

import re
from collections.abc import Callable, Iterable
from typing import Any

from cosim.errors import UsageError


def check_refused(
    cases: Iterable[tuple[Any, ...]],
    act: Callable[..., object],
    error: type[Exception] = UsageError,
) -> None:
    """Check that ``act`` refuses every case by ``error``, with place, names and values.

    Parameters
    ----------
    cases : iterable of (*case, pattern)
        The pattern is searched for in the message.
    act : callable
        Called with what makes each case.
    error : type of Exception
    """
    mismatches = []
    for *case, pattern in cases:
        try:
            act(*case)
        except error as refusal:
            if not re.search(pattern, str(refusal)):
                mismatches.append(f"{case!r:.200}: expected {pattern!r}, got {str(refusal)!r}")
        except Exception as other:
            mismatches.append(f"{case!r:.200}: expected {error.__name__}, got {other!r}")
        else:
            mismatches.append(f"{case!r:.200}: accepted")
    assert not mismatches, "\n".join(mismatches)
