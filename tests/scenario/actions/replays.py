"""Replays of runs with actions."""

import cosim
from cosim.report.verification import verify


def verified_replay(log):
    """Replay a log; it follows the recorded actions, bit for bit."""
    again = cosim.replay(log)
    verification = verify(log, again)
    assert verification.passed, verification.lines()
    assert again.events() == log.events()
    return again
