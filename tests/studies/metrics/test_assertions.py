"""Assertions compare metrics with numbers and with each other."""

import re

import pytest

import cosim
from cosim.errors import UsageError, shell_language
from cosim.studies.measuring import AssertedView, Assertions

VALUES = {"rms(a.y)": 0.5, "last(a.y)": 2.0, "first(t, a.y > 1 for 1 s)": None, "peak": 3.0}
FULFILLED = {
    "rms(a.y) < 0.6": True,
    "rms(a.y) < 0.5": False,
    "rms(a.y) <= 0.5": True,
    "last(a.y) == 2": True,
    "last(a.y) != 2": False,
    "0 < rms(a.y) < last(a.y)": True,
    "0 < rms(a.y) < 0.1*pi": False,
    "rms(a.y) < 1 and last(a.y) > 3": False,
    "rms(a.y) < 1 and last(a.y) > -2*e": True,
    "peak >= 3": True,
    "first(t, a.y > 1 for 1 s) < 9": False,
    "first(t, a.y > 1 for 1 s) != 9": False,
}


@pytest.mark.parametrize(("text", "holds"), FULFILLED.items())
def test_a_comparison_holds_or_says_what_the_metrics_are(text, holds):
    """A metric without a value fulfils nothing."""
    problems = Assertions([text], {"peak": "max(a.y)"}).problems(VALUES)
    assert (text not in problems) is holds
    if not holds:
        assert re.search(r"= (0\.5|2\.0|no value)", problems[text])


def test_metrics_of_a_study_go_by_their_names():
    """Others are named by their texts, with their durations."""
    found = Assertions(["peak < 2*rms(a.y)", "first(t, a.y > 1 for 1 s) < 3"], {"peak": "max(a.y)"})
    assert found.metrics["peak"] == "max(a.y)"
    assert "first(t, a.y > 1 for 1 s)" in found.metrics


@pytest.mark.parametrize(
    ("text", "named"),
    {
        "rms(a.y)": "expected a comparison, such as rms",
        "rms(a.y) < 1 or rms(a.y) > 2": "expected a comparison, such as rms",
        "not rms(a.y) < 1": "expected a comparison, such as rms",
        "rms(a.y) in 3": "< <= > >= == !=",
        "1 < 2": "at least one reduction",
        "a.y < 1": r"a reduction, such as last\(a\.y\)",
        "peak < 1": r"a reduction, such as last\(peak\)",
        "rms(a.y) <": "not a metric",
        "__import__('os').getcwd() < 1": "allowed: numbers",
        "(lambda: 1)() < rms(a.y)": "allowed: numbers",
    }.items(),
)
def test_what_is_no_assertion_is_refused(text, named):
    """Nothing of a text is run: it is one of the language of metrics."""
    with shell_language(), pytest.raises(UsageError, match=f"--assert: .*{named}"):
        Assertions([text])


def test_assertions_of_a_run_are_those_of_its_log(tmp_path):
    """Computed while it goes on, to the last bit."""
    text = "rms(plant.y) < 0.1"
    view = AssertedView(Assertions([text]))
    changes = {"scenario.stop": 0.05, "scenario.verdicts": False}
    log = cosim.run("academic", live=view, set=changes, out=tmp_path / "a.mcap")
    (value,) = cosim.metrics(log, {"rms": "rms(plant.y)"}).values()
    assert view.problems == {text: f"rms(plant.y) = {value!r}"}


def test_a_signal_that_is_not_there_is_refused_before_the_run(tmp_path):
    """There is no log of it."""
    view = AssertedView(Assertions(["rms(plant.q) < 1"]))
    with pytest.raises(UsageError, match=r"'plant' has no signal 'q'"):
        cosim.run("academic", live=view, out=tmp_path / "a.mcap")
    assert not list(tmp_path.iterdir())
