"""The certificate of a run as it is shown."""

import json
import re

import pytest

import cosim
from cosim.cli import main
from cosim.errors import LogError
from tests.scenario import certified
from tests.scenario.certified import write


def run(capsys, *arguments):
    """Run a command; return what it prints."""
    with pytest.raises(SystemExit) as left:
        main([*map(str, arguments)])
    assert not left.value.code
    return capsys.readouterr().out


@pytest.fixture
def log(tmp_path, capsys):
    """Run a command that certifies an oscillator behind a jump; return the log and the output."""
    jump = '    jump = { kind = "python", class = "parts:Jump", instant = 1.003 }\n'
    text = certified.SPRING.replace("[components]\n", f"[components]\n{jump}", 1)
    text = text.replace('"mass.u" = "speed.y"', '"mass.u" = "speed.y"\n    "late.u" = "jump.y"')
    lag = '    late = { kind = "lag", time_constant = 1.0 }\n'
    text = text.replace(jump, jump + lag)
    text += '\n    [truth]\n    "mass.y" = -0.1455\n'
    path = tmp_path / "a.mcap"
    return path, run(capsys, "run", write(tmp_path, text), "--certify", "--out", path)


def test_table_has_estimates_and_reasons(log):
    """cos 2t at 4 s is -0.1455; of the error of first order there, nearly all is the coupling."""
    _, output = log
    lines = output.splitlines()
    (title,) = [i for i, line in enumerate(lines) if line.endswith("with 0.005 s and 0.0025 s")]
    assert "0.01 s" in lines[title]
    table = lines[title:]
    assert table[1] == "signal\tlargest\tat t\tat the end\torder"
    assert table[2].startswith("mass.y\t0.0337\t3.3 s\t")
    assert table[2].endswith("\t1.02")
    (reason,) = [line for line in table if line.startswith("no estimate\t")]
    assert re.match(r"no estimate\tlate\.y: jump\.y jumps between .*quarter.* t = 1\.005 s", reason)
    (equal,) = [line for line in table if line.startswith("no error\t")]
    assert "jump.y" in equal
    (share,) = [line for line in table if line.endswith("coupling error")]
    assert re.match(r"mass\.y\terror \S+ at the end, of which \S+ \([89]\d %\)", share)


def test_log_shows_it(log, capsys):
    path, _ = log
    shown = run(capsys, "info", path)
    assert "step\t0.01 s" in shown
    assert "mass.y\t0.0337\t3.3\t" in shown
    content = json.loads(run(capsys, "info", path, "--json"))
    signals = {row["signal"]: row for row in content["error of the step"]}
    assert signals["mass.y"]["largest"] == 0.0337
    assert signals["late.y"]["largest"] is None
    assert signals["late.y"]["at most"] is None
    assert "jump.y jumps between" in signals["late.y"]["no estimate"]


def test_ends_that_differ_are_named(tmp_path, capsys):
    scenario = write(tmp_path, certified.SPRING)
    setting = ("--set", "scenario.until=mass.y < 0")
    output = run(capsys, "run", scenario, "--certify", *setting, "--out", tmp_path / "a.mcap")
    assert re.search(r"note\t.*0\.79 s, 0\.79 s, 0\.7875 s.* up to 0\.7875 s\n", output)


def test_json_has_it(tmp_path, capsys):
    path = write(tmp_path, certified.SPRING)
    output = run(capsys, "run", path, "--certify", "--json", "--out", tmp_path / "a.mcap")
    found = json.loads(output)["certificate"]
    assert found["finer_steps"] == [0.005, 0.0025]
    (mass,) = [row for row in found["signals"] if row["signal"] == "mass.y"]
    assert mass["order"] == pytest.approx(1.0, abs=0.1)


def test_table_and_log_have_the_steps_that_were_tried(tmp_path, capsys):
    path = tmp_path / "a.mcap"
    scenario = write(tmp_path, certified.SPRING)
    output = run(capsys, "run", scenario, "--find-step", "mass.y=0.02", "--out", path)
    fine = "step 0.005 s\twithin mass.y 0.02"
    assert any(line.startswith(fine) for line in output.splitlines())
    assert re.search(r"step 0\.00625 s\t.*mass\.y.*0\.02", output)
    assert fine in run(capsys, "info", path)


def test_a_tolerance_that_is_no_number_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit) as left:
        main(["run", str(write(tmp_path, certified.SPRING)), "--find-step", "mass.y=small"])
    assert left.value.code == 2
    assert re.search(r"--find-step mass\.y: .*'small'", capsys.readouterr().err)


@pytest.mark.parametrize("option", [["--certify"], ["--find-step", "mass.y=0.1"]])
def test_a_dry_run_certifies_nothing(tmp_path, capsys, option):
    with pytest.raises(SystemExit) as left:
        main(["run", str(write(tmp_path, certified.SPRING)), "--dry-run", *option])
    assert left.value.code == 2
    assert re.search(f"--dry-run .*{option[0]}", capsys.readouterr().err)


@pytest.mark.parametrize(
    ("content", "place"),
    [
        ({"step": "small", "finer_steps": [], "every": 1}, "step"),
        ({"step": 0.1, "finer_steps": [0.05], "every": 1, "signals": {"a.y": 3}}, "signals.a.y"),
        ([], ""),
    ],
)
def test_a_certificate_that_cannot_be_understood_is_an_error_of_the_log(content, place):
    """A log may come from anywhere."""
    memory = cosim.run(certified.parsed(certified.EXACT))
    memory.result({"certificate": content})
    with pytest.raises(LogError, match=f"certificate cannot be understood: {place}"):
        cosim.certificate(memory)
