"""Reading an FMU, or a scenario with one, never loads its binary; a dry run does in a child."""

import json
import os
import subprocess
import sys

import pytest

from cosim.processes import COMMAND_VARIABLE
from tests.fmi.compiled import compile_fmu
from tests.fmi.rogues import XML

SCENARIO = """
[scenario]
name = "marked"
stop = 0.2
step = 0.1
[components]
plant = { kind = "fmu", path = "marked.fmu", outputs = ["k"] }
u = { kind = "constant", value = 1.0 }
[connections]
"plant.u" = { from = "u.y", unit = "m" }
"""


@pytest.fixture
def marked(tmp_path, monkeypatch):
    """Return the file that the FMU's library writes as soon as it is loaded."""
    mark = tmp_path / "loaded"
    source = tmp_path / "mark.c"
    source.write_text(
        "#include <stdio.h>\n#include <unistd.h>\n"
        "__attribute__((constructor)) static void leave_mark(void)\n"
        f'{{ FILE *file = fopen("{mark}", "a");\n'
        'fprintf(file, "%d\\n", getpid()); fclose(file); }\n'
    )
    xml = XML.replace('canGetAndSetFMUstate="true"', "")
    compile_fmu(tmp_path / "marked.fmu", xml, "rogue2.c", source, defines=("ROGUE=GOOD",))
    (tmp_path / "marked.toml").write_text(SCENARIO)
    return mark


def test_info_reads_descriptions_only(call, marked):
    """Of an FMU, and of a scenario with one; also where the scenario is wrong."""
    code, out, _ = call("info", "marked.fmu", "--json")
    assert (code, json.loads(out)["fmu"]["name"]) == (0, "rogue")
    code, out, _ = call("info", "marked.toml", "--json")
    assert code == 0
    signals = [row["signal"] for row in json.loads(out)["signals"]]
    assert signals == ["plant.u", "plant.y", "plant.z", "plant.k", "u.y"]
    wrong = marked.with_name("wrong.toml")
    wrong.write_text(SCENARIO.replace('"plant.u"', '"plant.v"'))
    code, _, err = call("info", "wrong.toml")
    assert code == 2
    assert "'plant' has no input 'v'" in err
    assert not marked.exists()


@pytest.mark.slow
def test_a_dry_run_loads_fmus_in_another_process(call, marked):
    """The library is loaded, and not into this process."""
    code, out, _ = call("run", "marked.toml", "--dry-run", "--set", "plant.start.k=1")
    assert code == 0
    assert out == "dry run: the scenario can run; warnings: 1\n"  # of z, which lags
    assert str(os.getpid()) not in marked.read_text().split()


def test_a_dry_run_says_what_is_wrong(call, marked):
    code, out, err = call("run", "marked.toml", "--dry-run", "--set", "plant.start.k=9")
    assert (code, out) == (2, "")
    assert "start value of 'k': expected 0.0 to 5.0, got 9" in err


def attach(tmp_path, statement):
    """Compile the FMU of the scenario with a statement that its library does when it is loaded."""
    source = tmp_path / "attached.c"
    source.write_text(
        "#include <signal.h>\n#include <stdlib.h>\n#include <unistd.h>\n"
        f"__attribute__((constructor)) static void attached(void) {{ {statement} }}\n"
    )
    compile_fmu(tmp_path / "marked.fmu", XML, "rogue2.c", source, defines=("ROGUE=GOOD",))
    (tmp_path / "marked.toml").write_text(SCENARIO)


@pytest.mark.slow
@pytest.mark.parametrize("command", [("run", "--dry-run"), ("check",)])
def test_an_fmu_that_crashes_ends_a_child(call, tmp_path, command):
    """The parent lives on and says so; the child has said which component it was."""
    attach(tmp_path, "raise(SIGSEGV);")
    code, out, err = call(*command, "marked.toml")
    assert (code, out) == (1, "")
    assert "cosim: plant, before its initialization: crashes: SIGSEGV" in err
    assert "the process that loaded FMUs and classes crashes: SIGSEGV" in err


@pytest.mark.slow
def test_an_fmu_that_hangs_is_not_waited_for(call, tmp_path, monkeypatch):
    """Its limit is that of a trial of `cosim check x.fmu`."""
    monkeypatch.setattr("cosim.fmi.child_process.TIMEOUT", 2.0)
    attach(tmp_path, "for (;;) pause();")
    code, out, err = call("check", "marked.toml")
    assert (code, out) == (1, "")
    assert "plant, before its initialization: does not return" in err
    assert "was ended, as a call did not return within 2 s" in err


@pytest.mark.slow
def test_what_an_fmu_starts_does_not_keep_a_command(call, tmp_path):
    """It holds stdout and stderr of the child open, and ends with it."""
    attach(tmp_path, 'if (!fork()) execlp("sleep", "sleep", "100", (char *)0);')
    code, out, _ = call("check", "marked.toml")
    assert code == 0
    assert "assumptions are fulfilled" in out


@pytest.mark.slow
def test_a_dry_run_of_an_fmu_that_ends_the_process(call, tmp_path):
    """Exit code 0 of it does not say that the scenario can run."""
    attach(tmp_path, "exit(0);")
    code, _, err = call("run", "marked.toml", "--dry-run")
    assert code == 1
    assert "plant, before its initialization: ends the process with exit code 0" in err
    text = "the process that loaded FMUs and classes was ended by one of them, with exit code 0"
    assert text in err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("option", "expected_code", "words"),
    [
        ("--dry-run", 0, "the scenario can run; warnings: 1\n"),
        ("--out=a.mcap", 0, "a.mcap\n"),
        ("--stop=0.05", 2, "nearest: 0.1 s\n"),
    ],
)
def test_how_a_binary_bears_the_end_of_the_process_is_no_result(
    tmp_path, option, expected_code, words
):
    """One that pins itself and crashes behind the command: the exit code is the command's."""
    end = tmp_path / "end.c"
    end.write_text(
        "#define _GNU_SOURCE\n#include <dlfcn.h>\n#include <signal.h>\n"
        "static void crash(void) { raise(SIGSEGV); }\n"
        "__attribute__((constructor)) static void pin(void)\n"
        "{ Dl_info own; dladdr((void *)&crash, &own); dlopen(own.dli_fname, RTLD_NOW); }\n"
        "__attribute__((destructor)) static void end(void) { crash(); }\n"
    )
    xml = XML.replace('canGetAndSetFMUstate="true"', "")
    compile_fmu(tmp_path / "marked.fmu", xml, "rogue2.c", end, defines=("ROGUE=GOOD",))
    (tmp_path / "marked.toml").write_text(SCENARIO)
    command = [sys.executable, "-m", "cosim", "run", "marked.toml", option]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == expected_code, done.stderr
    assert words in done.stdout + done.stderr


def test_the_child_does_it_itself(call, marked, monkeypatch):
    """A dry run or a check in a child starts no other."""
    monkeypatch.setenv(COMMAND_VARIABLE, "1")
    monkeypatch.setattr("cosim.processes.run_command", lambda *_: pytest.fail("another child"))
    monkeypatch.setattr("cosim.cli.options.limit_calls", lambda limit: None)
    assert call("run", "marked.toml", "--dry-run")[0] == 0
    assert call("check", "marked.toml")[0] == 0
