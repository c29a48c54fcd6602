"""A replay opens its log, what its own command line names, and nothing else."""

import json
import subprocess
import sys

import pytest

import cosim
from cosim.scenario.exporting import export_component
from tests.fmi import lag
from tests.fmi.compiled import compile_fmu
from tests.log.crafting import put_together, take_apart

MONITOR = """
import json, os, sys
opened = []
def audit(event, arguments):
    if event == "open" and not isinstance(arguments[0], int):
        opened.append(os.path.abspath(os.fsdecode(arguments[0])))
    if event == "ctypes.dlopen" and arguments[0]:
        opened.append(os.path.abspath(str(arguments[0])))
from cosim.cli import main
sys.addaudithook(audit)
answers = []
for command in json.loads(sys.argv[1]):
    opened.clear()
    try:
        main(command)
    except SystemExit as left:
        answers.append([left.code or 0, list(opened)])
with open("answers.json", "w") as file:
    json.dump(answers, file)
"""
FMU_MODEL = {"fmu": "bait.fmu", "disturbance": "delta"}
BAITS = [
    {"kind": "table", "file": "bait.csv"},
    {"kind": "fmu", "path": "bait.fmu"},
    {"kind": "recording", "log": "bait.mcap", "component": "u"},
]
CHANGES = [{"observer.model": FMU_MODEL}, {"plant": BAITS[1]}]
CHANGES += [{name: bait} for name in ("u", "other") for bait in BAITS]


def run_monitored(commands, folder):
    """Run commands in one child process; return exit code and opened files of each, and stderr."""
    texts = [[str(argument) for argument in command] for command in commands]
    done = subprocess.run(
        [sys.executable, "-c", MONITOR, json.dumps(texts)],
        capture_output=True,
        text=True,
        cwd=folder,
        check=True,
        timeout=120,
    )
    return json.loads((folder / "answers.json").read_text(encoding="utf-8")), done.stderr


def craft(folder, name, changes):
    """Write a log whose scenario has been changed after the run; return its path."""
    content = take_apart(folder / "bait.mcap")
    items = dict(content.metadata)["cosim.run"]
    edits = json.loads(items["edits"])
    edits["changes"].update(changes)
    items["edits"] = json.dumps(edits)
    return put_together(content, folder / name)


@pytest.mark.slow
def test_a_replay_opens_its_log_and_what_the_command_line_names(tmp_path):
    """No table, FMU, design model or recording that the log alone names, and no library of one."""
    cosim.run("academic", out=tmp_path / "bait.mcap", set={"scenario.stop": 0.05})
    export_component("academic", "plant", tmp_path / "bait.fmu")
    (tmp_path / "bait.csv").write_text("t,y\n0,0\n1,1\n")
    logs = [craft(tmp_path, f"{i}.mcap", changes) for i, changes in enumerate(CHANGES)]
    commands = [[command, log] for log in logs for command in ("replay", "info")]
    named = ["replay", logs[0], "--set", "observer.model.fmu=bait.fmu"]
    answers, errors = run_monitored([*commands, named], tmp_path)
    for (command, log), (code, opened) in zip(commands, answers[:-1], strict=True):
        here = {name for name in opened if name.startswith(str(tmp_path))}
        assert here == {str(log)}, command
        assert code in (0, 2)
    assert answers[0][0] == 2
    assert "'bait.fmu': a replay opens no files that only the log names" in errors
    code, opened = answers[-1]
    assert code == 0, errors
    assert str(tmp_path / "bait.fmu") in opened


CODE = """
from pathlib import Path

from cosim.core import Interface, Signal

Path("ran").write_text(__name__)


class Own:
    interface = Interface((Signal("u"),), (Signal("y"),), feedthrough={"y": ("u",)})

    def initialize(self, t, u):
        return u

    def outputs(self, t, u):
        return u

    def advance(self, t, h, u):
        return u[1:]
"""
OF_CODE = """
scenario = { name = "code", stop = 0.1, step = 0.01 }
[components]
u = { kind = "sine", rate = 5.0 }
plant = { kind = "fmu", path = "lag.fmu" }
own = { kind = "python", class = "own:Own" }
filter = { kind = "lag", time_constant = 0.1 }

[connections]
"plant.u" = "u.y"
"own.u" = "plant.y"
"filter.u" = "own.y"
"""
KEYS = ["nothing.x", "filter.zzz", "plant.start.zzz", "own.zzz", "scenario.zzz"]
WRONG = [
    *[["--set", f"{key}=1"] for key in KEYS],
    *[["--set", text] for text in ("filter.time_constant='a'", "=1", "scenario.step=0.007")],
    *[["--swap", text] for text in ("x=bait.mcap", "filter=missing.fmu", "own=bait.mcap#own")],
    ["--map", "plant.y=z"],
    ["--stop", "x"],
]
METRICS = ["m=last(filter.y)", "m=last(nothing.y)", "m=last("]


def commands_on(log):
    """Return every command with a log from elsewhere, rightly and with wrong arguments."""
    replay = ["replay", log]
    study = ["study", log, "--dry-run", "--metric", METRICS[0]]
    tune = ["tune", log, "--members", "2", "--minimize", "last(filter.y)"]
    commands = [[*replay, *more] for more in ([], ["--verify"], ["--rerun"], *WRONG)]
    commands += [[*replay, "--component", name] for name in ("own", "plant")]
    for key in (KEYS[2], "filter.time_constant"):
        commands.append([*replay, "--vary", f"{key}=1,2"])
        commands += [[*study, "--vary", f"{key}=1,2", *more] for more in ([], *WRONG[-3:])]
        commands += [[*tune, "--vary", f"{key}=1:2", *more] for more in ([], *WRONG[-3:])]
    of_a_scenario = [["run"], ["compare"], ["design"], ["info"], ["check"], ["show"]]
    of_a_scenario += [["export", "--component", "filter"], ["linearize"], ["identify"]]
    commands += [[*words, log, *more] for words in of_a_scenario for more in ([], WRONG[0])]
    commands += [[name, log] for name in ("hash", "cat", "metrics", "recover", "cut", "merge")]
    commands += [["metrics", log, text] for text in METRICS]
    commands += [["diff", log, log], ["convert", log, "out.csv", "--force"]]
    return commands


@pytest.mark.slow
def test_no_command_runs_the_code_of_a_log(tmp_path, monkeypatch):
    """Neither the FMU in it nor the class it names, whatever is wrong with the other arguments.

    Both leave a file behind as soon as they are loaded, in a worker of a study too.
    """
    monkeypatch.chdir(tmp_path)
    compile_fmu(
        tmp_path / "lag.fmu",
        lag.xml("2"),
        "lag2.c",
        "marking.c",
        defines=(f'MARK="{tmp_path}/ran"',),
    )
    (tmp_path / "own.py").write_text(CODE, encoding="utf-8")
    (tmp_path / "code.toml").write_text(OF_CODE, encoding="utf-8")
    run_monitored([["run", "code.toml", "--out", "bait.mcap", "--embed", "--quiet"]], tmp_path)
    (tmp_path / "ran").unlink()
    commands = commands_on("bait.mcap")
    answers, _ = run_monitored(commands, tmp_path)
    for command, (code, opened) in zip(commands, answers, strict=True):
        libraries = [name for name in opened if name.endswith(("model.so", "own.py", "lag.fmu"))]
        assert libraries == [], command
        assert code in (0, 1, 2), command
    assert not (tmp_path / "ran").exists()
