"""A replay opens its log, what its own command line names, and nothing else."""

import json
import subprocess
import sys

import pytest

import cosim
from cosim.scenario.exporting import export_component
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
RECORDING = {"kind": "recording", "log": "bait.mcap", "component": "u"}
CHANGES = [
    {"observer.model": FMU_MODEL},
    {"u": {"kind": "table", "file": "bait.csv"}},
    {"u": {"kind": "fmu", "path": "bait.fmu"}},
    {"u": RECORDING},
    {"other": {"kind": "table", "file": "bait.csv"}},
    {"other": {"kind": "fmu", "path": "bait.fmu"}},
    {"other": RECORDING},
    {"plant": {"kind": "fmu", "path": "bait.fmu"}},
]


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


def bait(folder):
    """Write files that a log may name: an FMU, a table, another log."""
    cosim.run("academic", out=folder / "bait.mcap", set={"scenario.stop": 0.05})
    export_component("academic", "plant", folder / "bait.fmu")
    (folder / "bait.csv").write_text("t,y\n0,0\n1,1\n", encoding="utf-8")


def craft(folder, name, changes):
    """Write a log whose scenario has been changed after the run; return its path."""
    content = take_apart(folder / "bait.mcap")
    for record, items in content.metadata:
        if record == "cosim.run":
            edits = json.loads(items["edits"])
            edits["changes"].update(changes)
            items["edits"] = json.dumps(edits)
    return put_together(content, folder / name)


@pytest.mark.slow
def test_a_replay_opens_its_log_and_what_the_command_line_names(tmp_path):
    """No table, FMU, design model or recording that the log alone names, and no library of one."""
    bait(tmp_path)
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
