"""The process of the command line: what it imports, and what reaches its streams."""

import gc
import json
import os
import subprocess
import sys
from importlib.util import find_spec

import pytest

from cosim.__main__ import main
from cosim.cli.command import start_collecting
from cosim.version import __version__
from tests.fmi.compiled import compile_fmu
from tests.fmi.rogues import XML

COSIM = [sys.executable, "-m", "cosim"]


def test_the_version_is_that_of_the_package(call):
    assert call("--version") == (0, f"cosim {__version__}\n", "")


def test_the_overview_cuts_no_sentence_short(call):
    """On a terminal of 80 columns each command is described in one line."""
    code, out, _ = call("--help")
    assert code == 0
    assert "export     Export a component as an FMU, C source and binary." in out
    assert "..." not in out.partition("Commands:")[2]


@pytest.mark.parametrize(("given", "expected"), [(None, "1"), ("2", "2")])
def test_linear_algebra_has_one_thread_unless_the_environment_has_another_number(
    given, expected, monkeypatch
):
    """It is set before numpy is imported, which would not see it later."""
    for changes_this_process in ("atexit.register", "gc.disable"):
        monkeypatch.setattr(changes_this_process, lambda *_: None)
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", given or "")
    if given is None:
        monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    monkeypatch.setattr("sys.argv", ["cosim", "--version"])
    with pytest.raises(SystemExit):
        main()
    assert os.environ["OPENBLAS_NUM_THREADS"] == expected


# --- what a command imports: an import takes as long as a short run ---

# packages, with those that they are made of, and which of whose parts a run does not need
OF_TYPER = {"typer", "rich", "annotated_doc", "click", "shellingham"}
OF_PYDANTIC = {"pydantic", "annotated_types", "pydantic_core", "typing_extensions"}
OF_PYDANTIC |= {"typing_inspection"}
OF_LOGS = {"mcap", "isal", "zstandard", "google"}
FOR_OTHERS = (
    "cosim.blocks.kalman_identifier",
    "cosim.blocks.pid",
    "cosim.blocks.renamed",
    "cosim.cli.logs",
    "cosim.fmi.exporting",
    "cosim.fmi.reading",
    "cosim.report.verification",
    "cosim.scenario.data_files.field_file",
    "cosim.scenario.kinds.parts",
    "cosim.scenario.kinds.compensators",
    "cosim.scenario.kinds.field_data",
    "cosim.scenario.recordings.swap_comparison",
    "cosim.theory.assessment.noise_color",
    "cosim.theory.bounded",
    "cosim.theory.compensation",
    "mcap.writer",
    "numpy.f2py",
    "numpy.random",
    "numpy.testing",
)
CODE = """
import gc, sys
before = set(sys.modules)
from cosim.__main__ import main
try:
    main()
except SystemExit:
    pass
print(*sorted(set(sys.modules) - before), file=sys.stderr)
print(gc.isenabled(), gc.get_freeze_count() > 0, file=sys.stderr)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "allowed"),
    [
        (["--help"], OF_TYPER),
        (["list"], {*OF_TYPER, *OF_PYDANTIC, "numpy"}),
        (["run", "academic", "--stop", "0.1"], {*OF_TYPER, *OF_PYDANTIC, *OF_LOGS, "numpy"}),
    ],
    ids=["help", "list", "run"],
)
def test_a_command_imports_no_library_that_it_does_not_use(command, allowed, tmp_path):
    """No scipy, fmpy, lz4 or matplotlib, nor the parts of packages that are for other things.

    What the imports made is frozen: the garbage collector, which starts behind them, never walks
    over it.
    """
    done = subprocess.run(
        [sys.executable, "-c", CODE, *command],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
        timeout=60,
    )
    *_, modules, collector = done.stderr.splitlines()
    packages = {name.partition(".")[0] for name in modules.split()} - sys.stdlib_module_names
    packages -= {name for name in packages if name.startswith("_sysconfigdata")}  # of Python
    assert packages <= {"cosim", *allowed}
    assert all(map(find_spec, FOR_OTHERS))
    if command[0] == "run":
        assert [name for name in modules.split() if name.startswith(FOR_OTHERS)] == []
    assert collector == "True True" or command == ["--help"]


def test_a_running_collector_is_left_alone():
    """A command that is called from Python freezes nothing of its caller."""
    frozen = gc.get_freeze_count()
    assert gc.isenabled()
    start_collecting()
    assert gc.get_freeze_count() == frozen


# --- what reaches the streams ---


NOISE = b"a line that nobody asked for\n" * 3


@pytest.mark.slow
def test_the_output_of_an_fmu_does_not_reach_the_data(tmp_path):
    """It goes to stderr; stdout is ours."""
    compile_fmu(tmp_path / "rogue.fmu", XML, "rogue2.c", defines=("ROGUE=PRINTS",))
    (tmp_path / "x.toml").write_text(
        'scenario = { name = "x", stop = 0.3, step = 0.1 }\n[components]\n'
        'p = { kind = "fmu", path = "rogue.fmu" }\none = { kind = "constant", value = 1.0 }\n'
        '[connections]\n"p.u" = "one.y"\n'
    )
    run = [*COSIM, "run", "x.toml", "--json"]
    done = subprocess.run(run, cwd=tmp_path, capture_output=True, check=True)
    assert (json.loads(done.stdout)["steps"], NOISE in done.stderr) == (3, True)


def test_a_working_folder_that_is_gone_is_named(call, tmp_path, monkeypatch):
    """Of a shipped scenario, and beside a path that leads nowhere without it."""
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    for command in (["run", "pair"], ["info", "a.mcap"]):
        code, _, err = call(*command)
        assert code in (1, 2)
        assert "working folder" in err


@pytest.mark.slow
def test_a_full_disk_is_one_line():
    """Exit 2 as for wrong use: 1 would say that a check failed."""
    environment = {**os.environ, "PYTHONUNBUFFERED": ""}
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [*COSIM, "list"], stdout=full, stderr=subprocess.PIPE, text=True, env=environment
        )
    assert (done.returncode, done.stderr) == (2, "cosim: output: No space left on device\n")
