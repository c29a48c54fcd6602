"""Replays of runs with actions, and actions that are refused."""

import re

import cosim
from cosim.errors import ScenarioError
from cosim.report.verification import verify
from tests.scenario.refusals import check_refused


def verified_replay(log):
    """Replay a log; it follows the recorded actions, bit for bit."""
    again = cosim.replay(log)
    verification = verify(log, again)
    assert verification.passed, verification.lines()
    assert again.events() == log.events()
    return again


def check_actions_refused(path, cases):
    """Check that actions are refused by one line: of (actions, key, words of the message)."""
    patterns = []
    for actions, key, words in cases:
        patterns.append((actions, rf"\A.*actions{re.escape(key)}: .*({words}).*\Z"))
    check_refused(
        patterns, lambda actions: cosim.run(path, set={"actions": actions}), ScenarioError
    )
