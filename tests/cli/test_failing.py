"""--fail-on and --assert: what makes a command that ran exit with 1."""

import re

import pytest

from cosim.cli import main

SHORT = ("--stop", "0.05", "--quiet")
HELD = ("--set", "scenario.input_interpolation=zero-order")


@pytest.fixture
def call(tmp_path, monkeypatch, capsys):
    """Return what runs a command line, and returns its exit code and its messages."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        with pytest.raises(SystemExit) as ended:
            main(list(arguments))
        return ended.value.code or 0, capsys.readouterr().err

    return run


def test_a_warning_fails_where_it_is_to(call):
    """And not where it is not; each once, with what it says."""
    assert call("run", "academic", *SHORT, *HELD, "--no-verdicts") == (0, "")
    code, err = call("run", "academic", *SHORT, *HELD, "--no-verdicts", "--fail-on", "warning")
    assert (code, err.count("\n")) == (1, 2)
    held, step = err.splitlines()
    assert held.startswith("cosim: --fail-on warning: observer: ")
    assert step.startswith("cosim: --fail-on warning: scenario.step: ")
    code, err = call("run", "academic", *SHORT, "--no-verdicts", "--fail-on", "warning")
    assert (code, err) == (0, "")


def test_an_assertion_of_a_run_and_of_its_replay(call):
    """Each that does not hold is a line with what its metrics are."""
    holds, not_ = "last(plant.y) < 1", "rms(observer.delta) < 0.1"
    given = ("--no-verdicts", "--assert", holds)
    assert call("run", "academic", *SHORT, *given, "--out", "a.mcap") == (0, "")
    for command in (("run", "academic", *SHORT), ("replay", "a.mcap", "--quiet")):
        code, err = call(*command, *given, "--assert", not_)
        assert code == 1
        assert err.startswith(f"cosim: --assert {not_}: rms(observer.delta) = ")
        assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--fail-on", "inconsistant"), "did you mean 'inconsistent'"),
        (("--fail-on", "inconsistent", "--no-verdicts"), "omit --no-verdicts"),
        (("--assert", "plant.y"), "expected a comparison|a reduction"),
        (("--assert", "rms(plant.q) < 1"), "'plant' has no signal 'q'"),
        (("--no-verdicts", "--set", "scenario.verdicts=true"), "--no-verdicts and --set"),
    ],
)
def test_what_cannot_be_checked_is_refused_before_the_run(options, named, call, tmp_path):
    """With exit code 2, and without a log."""
    code, err = call("run", "academic", *SHORT, *options)
    assert code == 2
    assert re.search(named, err)
    assert not list(tmp_path.glob("logs/*"))


def test_a_verdict_that_is_asked_for_and_not_made_fails(call):
    """A scenario may switch verdicts off: nobody then says that all is well."""
    options = ("--set", "scenario.verdicts=false", "--fail-on", "inconsistent")
    code, err = call("run", "academic", *SHORT, *options)
    assert code == 1
    assert "--fail-on inconsistent: identifier: no verdict was made" in err


@pytest.mark.slow
def test_an_estimate_that_contradicts_its_data_fails(call):
    """Its alpha is another one than that of the disturbance; the sentence is on stderr anyway."""
    wrong = ("--set", "regressor.terms[0].alpha=1.0 + sin(9*t)", "--stop", "0.5", "--quiet")
    code, err = call("run", "academic", *wrong)
    assert code == 0
    assert err.startswith("warning: identifier.theta[0], identifier.theta[1]: INCONSISTENT: ")
    code, err = call("run", "academic", *wrong, "--fail-on", "no-estimate,inconsistent")
    assert code == 1
    assert err.splitlines()[-1].startswith("cosim: --fail-on inconsistent: identifier.theta[0]")


@pytest.mark.slow
def test_members_of_a_study_fail_it(call):
    """By number, with the first as an example; a metric of the study goes by its name."""
    varied = ("study", "academic", "--vary", "observer.filter_rate=10,900", "--metric")
    common = (*varied, "e=last(plant.y)", *SHORT, *HELD, "--set", "observer.filter=first-order")
    code, err = call(*common, "--out", "a", "--assert", "e < 1", "--fail-on", "warning")
    assert code == 1
    assert "cosim: --fail-on warning: 1 of 2 members (1); member 1: observer: " in err
    assert "--assert" not in err
    code, err = call(*common, "--out", "b", "--assert", "rms(plant.y) < 0.1")
    assert code == 1
    assert "cosim: --assert rms(plant.y) < 0.1: 2 of 2 members (0, 1); member 0: rms(" in err
    code, err = call(*common, "--out", "c", "--fail-on", "inconsistent")
    assert (code, "--results" in err) == (2, True)
