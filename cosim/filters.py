"""Filters of warnings, which are one for all threads of the process."""

from __future__ import annotations

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
