"""The command tune: what it reads, says and returns."""

import json
import re

import pytest

from cosim.cli.app import main
from cosim.cli.studies import stopped_text
from tests.studies.test_tuning import GOAL, LAG

pytestmark = pytest.mark.usefixtures("members_in_this_process")

VARY = "--vary=plant.time_constant=log:0.1:10"
OBJECTIVE = f"--minimize={GOAL}"


@pytest.fixture
def call(tmp_path, monkeypatch, capsys):
    """Return what tunes a lag in a folder of its own; with exit code, output and errors."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lag.toml").write_text(LAG)

    def run(*arguments):
        with pytest.raises(SystemExit) as ended:
            main(["tune", "lag.toml", "--workers=1", *arguments])
        return ended.value.code or 0, *capsys.readouterr()

    return run


def test_it_says_the_best_values_and_how_to_run_them(call, tmp_path):
    """1 - exp(-1 / T) = 0.5 has T = 1 / log 2 = 1.4427; the stop is that of all members."""
    code, out, _ = call(OBJECTIVE, VARY, "--stop=1", "--starts=1")
    objective, value, *statements, again = out.splitlines()
    assert code == 0
    assert objective.startswith(f"{GOAL} = ")
    assert value.startswith("  plant.time_constant = 1.4427")
    assert statements == [
        "COBYQA converged: trust region 1e-05 of the bounds",
        "searched from one start; better values elsewhere are not excluded",
    ]
    command = f"cosim run {tmp_path}/lag.toml --set scenario.stop=1.0 --set plant.time_constant"
    assert again.startswith(f"again: {command}=1.4427")


def test_it_prints_json(call):
    code, out, _ = call("--maximize=last(plant.y)", VARY, "--members=5", "--json")
    content = json.loads(out)
    assert code == 0
    assert content["members"] == 5
    assert content["maximize"]
    assert not content["converged"]
    assert content["best"]["values"].keys() == {"plant.time_constant"}


def test_a_tuning_that_is_interrupted_says_how_to_go_on(call, tmp_path, monkeypatch):
    """Ctrl-C while its sixth member would run."""
    call(OBJECTIVE, VARY, "--out=d", "--members=5")

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("cosim.studies.search.Trials._try", interrupt)
    options = [OBJECTIVE, VARY, "--members=9"]
    code, out, err = call(*options, "--out=d")
    assert (code, out) == (130, "")
    recorded = "stopped: 5 of 9 members are recorded in d; the same command "
    assert f"{recorded}resumes\n" in err
    assert f"{recorded}without --new resumes from them" in call(*options, "--out=d", "--new")[2]
    assert "stopped before the first member was recorded" in call(*options, "--out=e")[2]
    (tmp_path / "d" / "study.json").write_text("{")
    assert "damaged" in stopped_text("d", new=True)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([VARY], "--minimize and --maximize"),
        ([OBJECTIVE, "--maximize=last(plant.y)", VARY], "--minimize and --maximize"),
        ([OBJECTIVE, "--vary=plant.time_constant=3"], r"--vary plant\.time_constant: .*'3'"),
        ([OBJECTIVE, "--vary=plant.time_constant=1,2"], "'cobyqa'.*'optuna'"),
        ([OBJECTIVE, VARY, "--scheduler=tcp://127.0.0.1:1"], "--scheduler: .*'cobyqa'"),
        ([OBJECTIVE, VARY, "--standard-errors"], "--standard-errors: .* rms "),
    ],
)
def test_wrong_options_are_refused_with_exit_code_2(call, arguments, message):
    code, out, err = call(*arguments)
    assert (code, out) == (2, "")
    assert re.search(message, err)
