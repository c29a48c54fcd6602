"""Every trial of a tuning may replay a log; the command that is printed runs the best one again."""

import shlex

import pytest

import cosim
from cosim.cli.app import main
from cosim.errors import CosimError, UsageError
from cosim.studies.metrics import parse_metrics
from tests.studies.tuning.fitted_fmu import EXPRESSION, write_fit

ERROR = "rms(observer.delta - delta.y, t > 0.2)"
RATE = {"observer.filter_rate": {"log": [10.0, 1e4]}}


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Record a run whose observer is not that of the scenario file."""
    path = tmp_path_factory.mktemp("recorded") / "run.mcap"
    changes = {"scenario.stop": 1.0, "observer.filter_rate": 300.0, "delta.terms[0].theta": -0.2}
    cosim.run("academic", set=changes, out=path)
    return str(path)


def metric_of_command(command, expression, folder):
    """Run the line of a shell; return the metric of its log."""
    out = folder / "again.mcap"
    with pytest.raises(SystemExit, match=r"^0$"):
        main([*shlex.split(command)[1:], "--quiet", f"--out={out}"])
    return parse_metrics({"x": expression}).of(cosim.open_log(out))["x"]


@pytest.mark.slow
@pytest.mark.parametrize("is_scenario", [True, False])
def test_a_log_is_replayed_with_every_point(log, tmp_path, is_scenario):
    """It is tried first with the values of its run, which are those of the log, bit for bit."""
    source, options = ("academic", {"replay": log}) if is_scenario else (log, {})
    result = cosim.tune(source, minimize=ERROR, vary=RATE, members=4, workers=1, **options)
    own = parse_metrics({"x": ERROR}).of(cosim.open_log(log))["x"]
    assert result.history[0] == {
        "member": 0,
        "values": {"observer.filter_rate": 300.0},
        "objective": own,
    }
    assert result.best.objective < own
    assert result.command.startswith(f"cosim replay {log} --set observer.filter_rate=")
    assert metric_of_command(result.command, ERROR, tmp_path) == result.best.objective


@pytest.mark.slow
def test_a_tuning_of_a_log_goes_on_and_its_dataset_has_the_command(log, tmp_path, capsys):
    """With another log, or other edits, it is another tuning."""
    options = {"minimize": ERROR, "vary": RATE, "workers": 1, "out": tmp_path / "d"}
    few = cosim.tune("academic", replay=log, members=3, **options)
    more = cosim.tune("academic", replay=log, members=5, **options)
    assert more.history[:3] == few.history
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["study", "show", str(tmp_path / "d"), "--member", str(more.best.number)])
    assert f"alone: {more.command}" in capsys.readouterr().out
    with pytest.raises(CosimError, match="another study"):
        cosim.tune("academic", members=3, **options)
    with pytest.raises(CosimError, match="what all members have changed"):
        cosim.tune("academic", replay=log, set={"scenario.stop": 0.5}, members=3, **options)


def test_the_command_runs_the_best_member_bit_for_bit(tmp_path):
    """Of a scenario with an FMU, edits, and an end of its own."""
    scenario = write_fit(tmp_path)
    vary = {"plant.start.A": {"linear": [-3.0, -0.1]}, "plant.start.B": {"log": [0.1, 10.0]}}
    result = cosim.tune(
        scenario,
        minimize=EXPRESSION,
        vary=vary,
        set={"scenario.stop": 0.7},
        members=7,
        workers=1,
    )
    assert metric_of_command(result.command, EXPRESSION, tmp_path) == result.best.objective


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scenario": "closed-loop"}, "the log is of 'academic', and the study is of"),
        ({"replay": ["LOG", "COPY"]}, r"replay: expected one log.*got 2 \(.*\)"),
        ({"minimize": "rms(nothing.y)"}, "minimize: the run has no component 'nothing'"),
        ({"vary": {"plant.x_a0[0]": {"linear": [0.0, 1.0]}}}, "plant"),
        pytest.param(
            {"vary": {"plant": ["x.fmu", "y.fmu"]}, "method": "optuna"},
            "no such file",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_wrong_replay_is_refused_before_a_trial_runs(log, tmp_path, options, message):
    copy = tmp_path / "copy.mcap"
    copy.write_bytes(b"")
    given = {"scenario": "academic", "replay": "LOG", "minimize": ERROR, "vary": RATE, **options}
    logs = {"LOG": log, "COPY": str(copy)}
    names = given.pop("replay")
    replay = logs[names] if isinstance(names, str) else [logs[name] for name in names]
    source = given.pop("scenario")
    with pytest.raises(UsageError, match=message):
        cosim.tune(source, replay=replay, out=tmp_path / "d", workers=1, **given)
    assert not (tmp_path / "d").exists()
