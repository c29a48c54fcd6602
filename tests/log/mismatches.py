"""Tables of cases in one test: all that do not hold are reported, not the first alone."""

from __future__ import annotations

from contextlib import contextmanager

import pytest


class Mismatches(list):
    """What did not hold, and of which case.

    ``with wrong.of(case): ...`` for each case, then ``assert not wrong``.
    """

    @contextmanager
    def of(self, case):
        """Note a case whose assertions fail, and go on."""
        try:
            yield
        except (AssertionError, pytest.fail.Exception) as error:
            self.append(f"{case}: {error}")
