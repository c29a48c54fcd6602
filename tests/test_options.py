"""Rules about options that go together, in both languages."""

from contextlib import nullcontext

import pytest

from cosim.errors import UsageError, shell_language
from cosim.options import Rule, check_rules

RULES = (
    Rule("flush sync", "applies to a log", needs="out live"),
    Rule("find_step", "chooses the step", excludes="step assert_"),
)
NOTHING = {
    "flush": None,
    "sync": False,
    "out": None,
    "live": False,
    "find_step": [],
    "step": None,
    "assert_": None,
}


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"out": "a.mcap", "live": True},
        {"flush": 0.0, "out": "a.mcap"},
        {"sync": True, "live": True},
        {"find_step": ["a.y=1"]},
        {"step": 0.1, "assert_": ["a"]},
    ],
)
def test_what_goes_together_is_let_through(given):
    """None, False and an empty list are nothing; 0 is something."""
    check_rules(RULES, NOTHING | given)


@pytest.mark.parametrize(
    ("given", "in_python", "in_shell"),
    [
        ({"flush": 0.0}, r"^flush .* log; .*out or live=True", "^--flush .*--out or --live"),
        ({"sync": True}, r"^sync=True .* log; .*out", "^--sync .*--out"),
        ({"find_step": {"a.y": 1}, "step": 0.0}, "find_step .*step$", "--find-step .*--step$"),
        ({"find_step": ["a"], "assert_": ["b"]}, "find_step .*assert$", "--find-step .*--assert$"),
        (
            {"find_step": ["a"], "step": 0.1, "assert_": ["b"]},
            "find_step .* step and assert$",
            "--find-step .* --step and --assert$",
        ),
    ],
)
def test_what_does_not_is_refused_by_both_names(given, in_python, in_shell):
    """In the language of the caller."""
    for language, text in ((nullcontext(), in_python), (shell_language(), in_shell)):
        with language, pytest.raises(UsageError, match=text):
            check_rules(RULES, NOTHING | given)
