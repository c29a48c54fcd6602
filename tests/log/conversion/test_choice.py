"""What of a log is converted."""

from __future__ import annotations

import pytest

from cosim.errors import UnknownSignalError, UsageError
from cosim.log.text import choose


def test_a_choice_of_unknown_signals_or_no_time_is_refused(recorded):
    """Before a file is begun."""
    log, _ = recorded
    with pytest.raises(UnknownSignalError, match=r"'x\.\*'"):
        choose(log, ["x.*"], None, None)
    with pytest.raises(UsageError, match=r"--(from|to).*--(from|to)"):
        choose(log, None, 2.0, 1.0)
