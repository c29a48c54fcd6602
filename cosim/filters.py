"""Filters of warnings, which are one for all threads of the process."""

from __future__ import annotations

import re
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

_LOCK = threading.RLock()


@contextmanager
def ignored_warnings(message: str = "") -> Iterator[None]:
    """Ignore warnings inside, all or those whose text matches; one thread at a time.

    Two of them would put back each other's filters, and leave one of these. Warnings never become
    errors here: those of the other threads would, too.
    """
    with _LOCK, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message)
        yield


@contextmanager
def collected_warnings(message: str) -> Iterator[list[str]]:
    """Yield a list that has the warnings whose text matches, when the block has ended.

    All others are shown then. One thread at a time, as with :func:`ignored_warnings`.
    """
    collected: list[str] = []
    caught: list[warnings.WarningMessage] = []
    try:
        with _LOCK, warnings.catch_warnings(record=True) as caught:
            warnings.filterwarnings("always", message)
            yield collected
    finally:
        for one in caught:
            if re.match(message, str(one.message)):
                collected.append(str(one.message))
            else:
                _show(one)


def _show(one: warnings.WarningMessage) -> None:
    """Show a warning that was meant for others."""
    warnings.showwarning(one.message, one.category, one.filename, one.lineno, one.file, one.line)
