"""Limits of the files of a log."""

from __future__ import annotations

import pytest

from cosim.errors import UsageError
from cosim.log.files import read_rotation


def test_sizes_and_times_are_read():
    """Sizes in powers of 10 or 2, times of the simulation."""
    limits = {
        "1GB": (10**9, None),
        "2.5 MB": (2_500_000, None),
        "4MiB": (2**22, None),
        "3000000B": (3_000_000, None),
        "0.002TB": (2 * 10**9, None),
        "1h": (None, 3600 * 10**9),
        "2min": (None, 120 * 10**9),
        "0.5s": (None, 5 * 10**8),
    }
    found = {text: read_rotation(text) for text in limits}
    assert {text: (read.size, read.span_ns) for text, read in found.items()} == limits


def test_other_limits_are_refused(subtests):
    """With what is expected."""
    for text, expected in [
        *((text, "a size in B, kB, .* GiB or a") for text in ("1 parsec", "1gb", "GB", "-1GB", 5)),
        ("10kB", "at least 1MB"),
        *((text, "nanoseconds > 0") for text in ("0s", "0.0000000001s", "999999999999h")),
    ]:
        match = rf"^rotate: expected .*{expected}.*got {text!r}"
        with subtests.test(case=text), pytest.raises(UsageError, match=match):
            read_rotation(text)
