"""The command tune: what it reads, says and returns."""

import json
import re

import pytest

from cosim.cli.stopping import stopped_text
from tests.studies.test_tuning import LAG

pytestmark = pytest.mark.usefixtures("members_in_this_process")

VARY = "--vary=plant.time_constant=log:0.1:10"
OBJECTIVE = "--minimize=abs(last(plant.y) - 0.5)"


@pytest.fixture
def lag(tmp_path):
    path = tmp_path / "lag.toml"
    path.write_text(LAG)
    return str(path)


def call(capsys, *arguments):
    from cosim.cli.app import main

    with pytest.raises(SystemExit) as ended:
        main(["tune", *arguments])
    out, err = capsys.readouterr()
    return ended.value.code or 0, out, err


@pytest.mark.slow
def test_it_says_the_best_values_and_how_to_run_them(lag, capsys):
    code, out, _ = call(capsys, lag, OBJECTIVE, VARY, "--members=60", "--starts=1", "--workers=1")
    lines = out.splitlines()
    assert code == 0
    assert lines[0].startswith("abs(last(plant.y) - 0.5) = ")
    assert lines[1].startswith("  plant.time_constant = 2.885")  # 2 / log 2 = 2.88539
    assert lines[2] == "COBYQA converged: trust region 1e-05 of the bounds"
    assert lines[3] == "searched from one start; better values elsewhere are not excluded"
    assert lines[4].startswith(f"again: cosim run {lag} --set plant.time_constant=2.885")


def test_it_prints_json(lag, capsys):
    code, out, _ = call(capsys, lag, OBJECTIVE, VARY, "--members=5", "--workers=1", "--json")
    content = json.loads(out)
    assert code == 0
    assert content["members"] == 5
    assert not content["converged"]
    assert content["best"]["values"].keys() == {"plant.time_constant"}


@pytest.mark.slow
def test_maximizing_ends_at_a_bound(lag, capsys):
    """The faster the lag, the higher its output."""
    options = ["--maximize=last(plant.y)", "--vary=plant.time_constant=0.5:2", "--workers=1"]
    _, out, _ = call(capsys, lag, *options, "--starts=1")
    assert "plant.time_constant is at its lower bound: values beyond it may be better" in out


@pytest.mark.slow
def test_the_stop_is_that_of_all_members(lag, capsys):
    """1 - exp(-1 / T) = 0.5 has T = 1 / log 2."""
    options = [OBJECTIVE, VARY, "--stop=1", "--starts=1", "--workers=1"]
    code, out, _ = call(capsys, lag, *options)
    assert code == 0
    assert "  plant.time_constant = 1.44" in out
    assert f"again: cosim run {lag} --set scenario.stop=1.0 --set plant.time_constant=" in out


@pytest.mark.slow
def test_a_tuning_that_is_interrupted_says_how_to_go_on(lag, tmp_path, capsys, monkeypatch):
    """Ctrl-C while its sixth member would run."""
    options = [lag, OBJECTIVE, VARY, "--workers=1", f"--out={tmp_path / 'd'}"]
    call(capsys, *options, "--members=5")

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("cosim.studies.search.Trials._try", interrupt)
    code, out, err = call(capsys, *options, "--members=9")
    assert (code, out) == (130, "")
    recorded = f"stopped: 5 of 9 members are recorded in {tmp_path / 'd'}; the "
    assert f"{recorded}same command resumes\n" in err
    _, _, err = call(capsys, *options, "--members=9", "--new")
    assert f"{recorded}same command without --new resumes from them" in err
    _, _, err = call(capsys, *options[:-1], f"--out={tmp_path / 'e'}")
    assert "stopped before the first member was recorded" in err
    (tmp_path / "d" / "study.json").write_text("{")
    assert "damaged" in stopped_text(str(tmp_path / "d"), new=True)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([VARY], "--minimize and --maximize"),
        ([OBJECTIVE, "--maximize=last(plant.y)", VARY], "--minimize and --maximize"),
        ([OBJECTIVE], "--vary: "),
        (
            [OBJECTIVE, "--vary=plant.time_constant=3"],
            r"--vary plant\.time_constant: .*'3'",
        ),
        (
            [OBJECTIVE, "--vary=plant.time_constant=2:1"],
            r"--vary plant\.time_constant: .*2\.0 to 1\.0",
        ),
        (
            [OBJECTIVE, "--vary=plant.time_constant=1,2"],
            "'cobyqa'.*'optuna'",
        ),
        (
            [OBJECTIVE, VARY, "--stop=1", "--set=scenario.stop=2"],
            r"--stop and --set scenario\.stop",
        ),
        (
            [OBJECTIVE, VARY, "--scheduler=tcp://127.0.0.1:1"],
            "--scheduler: .*'cobyqa'",
        ),
        (
            [OBJECTIVE, VARY, "--quiet"],
            "--quiet without --out",
        ),
        ([OBJECTIVE, VARY, "--workers=0"], "--workers: .*0"),
        ([OBJECTIVE, VARY, "--replay=none.mcap"], "--replay: no file matches "),
        ([OBJECTIVE, VARY, "--members=0"], "--members: .*0"),
        (
            [OBJECTIVE, VARY, "--standard-errors"],
            "--standard-errors: .* rms ",
        ),
    ],
)
def test_wrong_options_are_refused_with_exit_code_2(lag, capsys, arguments, message):
    code, out, err = call(capsys, lag, *arguments)
    assert (code, out) == (2, "")
    assert re.search(message, err)
