"""Runs beside each other, and how they end: each has its own log, and leaves nothing else."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import re
import select
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

import cosim
from cosim.log import open_log
from tests.fmi.compiled import compile_fmu
from tests.fmi.eventful import build
from tests.fmi.rogues import XML

ONE = "from cosim.cli import main; main()"
EIGHT = """
import os, sys
import cosim.report.tables.run, cosim.scenario.running.execution
from cosim.cli import main
children = []
for _ in range(8):
    children.append(os.fork())
    if children[-1] == 0:
        main()
codes = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
sys.exit(max(codes))
"""
LONG = ("closed-loop", "--stop", "10000", "--quiet")


@pytest.fixture(autouse=True)
def listening():
    """Let signals end the child processes, also in tests started where they are ignored."""
    defaults = {signal.SIGINT: signal.default_int_handler, signal.SIGHUP: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in defaults.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def start(tmp_path):
    """Start cosim in a process of its own, with temporary files in ``tmp_path/temporary``."""
    (tmp_path / "temporary").mkdir()
    with contextlib.ExitStack() as processes:

        def start(*arguments, code=ONE, **options):
            environment = {**os.environ, "TMPDIR": str(tmp_path / "temporary")}
            process = subprocess.Popen(
                [sys.executable, "-c", code, *map(str, arguments)],
                cwd=tmp_path,
                env=environment,
                **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, **options},
            )
            processes.enter_context(process)
            processes.callback(process.kill)
            return process

        yield start


def wait_for(path, process, size=20_000):
    """Wait until a log has that many bytes."""
    for _ in range(6000):
        if path.exists() and path.stat().st_size > size:
            return
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(0.01)
            pytest.fail(f"ended early: {process.communicate()}")
    pytest.fail("has not begun to write")


@pytest.mark.slow
def test_runs_at_once_without_a_path_get_one_name_each(start, tmp_path):
    """Of eight processes none fails, no number is left out, and nothing else is left."""
    process = start("run", "academic", "--stop", "0.05", "--json", code=EIGHT)
    out, err = process.communicate(timeout=120)
    assert (process.returncode, err) == (0, "")
    logs = {json.loads(text)["log"] for text in re.findall(r"^\{.*?^\}", out, re.M | re.S)}
    names = ["academic.mcap", *(f"academic-{number}.mcap" for number in range(2, 9))]
    assert logs == {f"logs/{name}" for name in names}
    assert sorted(os.listdir(tmp_path / "logs")) == sorted(names)


@pytest.mark.slow
def test_threads_may_share_a_path_too(tmp_path):
    """Each of eight threads gets its own log back, with the value that it set."""
    logs = {}

    def run(rate):
        edits = {"scenario.stop": 0.02, "u.rate": rate}
        out = tmp_path / "a.mcap"
        logs[rate] = cosim.run("academic", out=out, numbered=True, set=edits)

    threads = [threading.Thread(target=run, args=(float(rate),)) for rate in range(1, 9)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len({log.path for log in logs.values()}) == 8
    assert len(os.listdir(tmp_path)) == 8
    for rate, log in logs.items():
        table = json.loads(log.metadata["cosim.component.u"]["table"])
        assert table["rate"] == rate
        assert cosim.diff(log, cosim.open_log(log.path)).equal


@pytest.mark.slow
def test_a_run_does_not_replace_the_log_that_another_writes(start, tmp_path):
    """Two runs with --force on one path: the second is refused, the first goes on."""
    path = tmp_path / "a.mcap"
    first = start("run", *LONG, "--out", path, "--force", "--json")
    wait_for(path, first)
    inode = path.stat().st_ino
    second = start("run", "academic", "--stop", "0.01", "--out", path, "--force")
    _, err = second.communicate(timeout=60)
    assert second.returncode == 2
    assert (
        err
        == f"cosim: {path} is being written by another run; choose another path, or stop that run\n"
    )
    assert path.stat().st_ino == inode
    first.send_signal(signal.SIGINT)
    _, err = first.communicate(timeout=60)
    assert first.returncode == 130
    assert "cosim: interrupted by the user\n" in err
    assert cosim.open_log(path).status == "interrupted"


@pytest.mark.parametrize("removed", [False, True])
def test_a_run_returns_its_own_rows_whatever_happens_to_its_path(tmp_path, capsys, removed):
    """Whatever happens to the path meanwhile: rows, summary, and what is said of the path."""
    path = tmp_path / "a.mcap"

    def displace(time, end):
        if time < end:
            return
        path.unlink()
        if not removed:
            cosim.run("academic", out=path, set={"scenario.stop": 0.01})

    log = cosim.run(
        "academic",
        out=path,
        set={"scenario.stop": 0.02},
        flush=3600.0,  # s: nobody looks at the path meanwhile
        progress=displace,
    )
    assert not log.is_at_its_path
    assert log.time("plant")[-1] == 0.02
    assert log.content_hash() == log.recorded_hash
    assert log.status == "complete"
    from cosim.report.tables.run import print_summary

    print_summary(log, wall={}, profile=None, as_json=True, quiet=False)
    out, err = capsys.readouterr()
    assert json.loads(out)["log"] is None
    assert json.loads(out)["end"] == 0.02
    state = "was removed" if removed else "holds the log of another run by now"
    assert err.startswith(f"warning: {path} {state}")


def test_the_files_of_very_many_runs_are_not_held_open(tmp_path):
    """A process may keep the logs of more runs than it may have open files."""
    from cosim.log import files

    own_files = []
    for number in range(files._MOST_HELD + 10):
        path = tmp_path / f"{number}"
        path.write_text(f"{number}")
        own = files.OwnFile(path)
        own.hold(path)
        own_files.append(own)
        if number == 3:
            path.unlink()
    assert [own.open() is None for own in own_files].count(True) == 9  # not the one that was lost
    with own_files[3].open() as stream:
        assert stream.read() == b"3"
    with own_files[-1].open() as one, own_files[-1].open() as other:
        assert one.read() == other.read() == f"{files._MOST_HELD + 9}".encode()
        assert one.seek(-1, os.SEEK_END) == 1
        assert one.read() == b"3"


ENDS = [
    (signal.SIGINT, 130, "interrupted by the user"),
    (signal.SIGTERM, 143, "terminated from outside"),
    (signal.SIGHUP, 129, "its terminal was closed"),
]


def assert_whole(path, reason):
    log = cosim.open_log(path)
    assert (log.status, log.reason) == ("interrupted", reason)
    assert len(log["plant.y"]) == log.steps + 1
    assert log.content_hash() == log.recorded_hash
    assert cosim.diff(log, cosim.replay(path)).equal


@pytest.mark.parametrize(
    ("number", "code", "reason"),
    [ENDS[0], *(pytest.param(*end, marks=pytest.mark.slow) for end in ENDS[1:])],
)
def test_a_signal_ends_a_run_with_a_whole_log(start, tmp_path, number, code, reason):
    """With the exit code that a shell gives, and nothing is left but the log."""
    path = tmp_path / "a.mcap"
    process = start("run", *LONG, "--out", path)
    wait_for(path, process)
    os.kill(process.pid, number)
    out, err = process.communicate(timeout=60)
    end = cosim.open_log(path).end_ns / 1e9
    assert (process.returncode, out) == (code, "")
    assert err == f"cosim: {reason}\ncosim: {path} holds the run up to t = {end} s\n"
    assert_whole(path, reason)
    assert sorted(os.listdir(tmp_path)) == ["a.mcap", "temporary"]
    assert not os.listdir(tmp_path / "temporary")


@pytest.mark.slow
def test_a_closed_terminal_ends_a_run_with_a_whole_log(start, tmp_path):
    """The kernel sends SIGHUP to the programs of a terminal, and nothing can be written to it."""
    path = tmp_path / "a.mcap"
    pid, terminal = pty.fork()
    if pid == 0:
        with contextlib.suppress(BaseException):
            os.chdir(tmp_path)
            arguments = [sys.executable, "-m", "cosim", "run", *LONG, "--out", str(path)]
            os.execv(sys.executable, arguments)
        os._exit(99)
    for _ in range(6000):
        assert os.waitpid(pid, os.WNOHANG) == (0, 0)
        if path.exists() and path.stat().st_size > 20_000:
            break
        threading.Event().wait(0.01)
    os.close(terminal)
    _, status = os.waitpid(pid, 0)
    assert os.waitstatus_to_exitcode(status) == 129
    assert_whole(path, "its terminal was closed")


@pytest.mark.slow
def test_an_ignored_signal_does_not_end_a_run(start, tmp_path):
    """Such as SIGHUP in a program that nohup started, or SIGINT in a shell's background."""
    path = tmp_path / "a.mcap"
    ignored = (signal.SIGHUP, signal.SIGINT)
    for number in ignored:
        signal.signal(number, signal.SIG_IGN)
    reader, writer = pty.openpty()  # its messages go to a terminal that is closed
    process = start("run", *LONG, "--out", path, stderr=writer)
    os.close(writer)
    wait_for(path, process)
    os.close(reader)
    size = path.stat().st_size
    for number in ignored * 2:
        os.kill(process.pid, number)
    wait_for(path, process, size + 20_000)
    os.kill(process.pid, signal.SIGTERM)
    process.communicate(timeout=60)
    assert process.returncode == 143
    assert_whole(path, "terminated from outside")


@pytest.mark.parametrize(("number", "reason"), [(number, reason) for number, _, reason in ENDS])
def test_a_second_signal_ends_a_run_in_the_midst_of_a_block(tmp_path, number, reason):
    """The first waits for the end of the block; the second raises where the run is."""
    path = tmp_path / "a.mcap"
    reached = []

    def press(time, end):
        signal.raise_signal(number)
        reached.append("first")
        signal.raise_signal(number)
        reached.append("second")

    with pytest.raises(KeyboardInterrupt):
        cosim.run("academic", out=path, set={"scenario.stop": 0.05}, progress=press)
    assert reached == ["first"]
    log = cosim.open_log(path)
    assert (log.status, log.reason) == ("interrupted", reason)
    assert log.content_hash() == log.recorded_hash


SCENARIO = """
[scenario]
name = "x"
stop = {stop}
step = 0.1
[components.plant]
kind = "fmu"
path = "{path}"
start = {{ p = {p} }}
[components.zero]
kind = "constant"
value = 0.0
[connections]
"plant.u" = "zero.y"
"plant.d" = "zero.y"
"""


@pytest.mark.slow
@pytest.mark.parametrize("end", ["success", "stop", "refused", "failed", *ENDS, "killed"])
def test_no_temporary_folder_is_left(start, tmp_path, end):
    """However a run with an FMU ends; what a killed one leaves, the next removes."""
    scenario = tmp_path / "x.toml"
    stop = 1e6 if end in (*ENDS, "killed") else 1.0
    p = 0.325 if end == "stop" else 1e9
    text = SCENARIO.format(stop=stop, path=build("ENDS"), p=p)
    if end == "failed":
        text += '[components.large]\nkind = "ramp"\noffset = 1.7e308\nslope = 1e308\n'
    if end == "refused":
        text += '"plant.none" = "zero.y"\n'
    scenario.write_text(text)
    path = tmp_path / "x.mcap"
    process = start("run", scenario, "--out", path)
    if stop > 1.0:
        wait_for(path, process)
        (folder,) = (tmp_path / "temporary").iterdir()
        assert folder.name.startswith("cosim.fmu-")
        process.send_signal(signal.SIGKILL if end == "killed" else end[0])
    process.communicate(timeout=60)
    codes = {"success": 0, "stop": 0, "refused": 2, "failed": 1, "killed": -9}
    assert process.returncode == (codes[end] if end in codes else end[1])
    if end == "killed":
        assert folder.exists()
        long_ago = folder.stat().st_mtime - 3600
        os.utime(folder, (long_ago, long_ago))
        scenario.write_text(text.replace(f"stop = {stop}", "stop = 1.0"))
        start("run", scenario, "--out", path, "--force").communicate(timeout=60)
    assert os.listdir(tmp_path / "temporary") == []
    expected = {"temporary", "x.toml"} | ({"x.mcap"} if end != "refused" else set())
    assert set(os.listdir(tmp_path)) == expected


# --- places that cannot be written ---


@pytest.fixture
def places(tmp_path):
    """Make what no file can be written to."""
    (tmp_path / "file").touch()
    for name in ("folder.mcap", "folder.png", "folder.fmu"):
        (tmp_path / name).mkdir()
    os.mkfifo(tmp_path / "pipe.png")


PLACES = [
    ("/proc/x{}", "/proc/x{}"),  # a folder that takes no files, whoever asks
    ("/proc/deep/x{}", "/proc/deep/x{}"),
    ("file/x{}", "file/x{}"),
    ("folder{}", "folder{}"),
]
COMMANDS = [
    (".mcap", ("run", "academic", "--force", "--out")),
    (".png", ("run", "academic", "--plot")),
    (".mcap", ("replay", "a.mcap", "--force", "--out")),
    (".png", ("replay", "a.mcap", "--plot")),
    (".png", ("compare", "academic", "--swap", "plant=a.mcap", "--plot")),
    (".png", ("plot", "a.mcap", "plant.y", "--out")),
    (".png", ("identify", "a.mcap", "--plot")),
    (".fmu", ("export", "academic", "--component", "plant", "--force", "--out")),
]


@pytest.mark.usefixtures("places")
@pytest.mark.parametrize(("ending", "command"), COMMANDS, ids=lambda value: "-".join(value[:1]))
def test_a_place_that_cannot_be_written_is_refused_before_the_run(
    call, tmp_path, monkeypatch, ending, command
):
    """Every output file of every command: the error names it, and nothing has been computed."""
    if "a.mcap" in command or "plant=a.mcap" in command:
        cosim.run("academic", out="a.mcap", set={"scenario.stop": 0.01})
    monkeypatch.setattr("cosim.scenario.recordings.recording.run_into", None)
    monkeypatch.setattr("cosim.scenario.exporting.export", None)
    before = set(os.listdir(tmp_path))
    for place, named in PLACES:
        code, _, err = call(*command, place.format(ending))
        assert code == 2, (place, err)
        assert named.format(ending) in err
        assert "cannot be" in err or "is a folder" in err
    assert set(os.listdir(tmp_path)) == before


@pytest.mark.usefixtures("places")
def test_a_picture_cannot_replace_a_log_or_go_to_a_pipe(call, tmp_path, monkeypatch):
    """Two outputs need two paths; a pipe may have no other end."""
    monkeypatch.setattr("cosim.scenario.recordings.recording.run_into", None)
    for arguments, text in [
        (("--out", "a.mcap", "--plot", "a.mcap"), "'.mcap'"),
        (("--out", "a.mcap", "--plot", "a.mcap/x.png"), "is the path of the log"),
        (("--plot", "pipe.png"), "it is a pipe, not a regular file"),
        (("--out", "a.log"), "expected a path that ends in .mcap"),
        (("--out", "folder.mcap"), "is a folder; name a file"),
    ]:
        code, _, err = call("run", "academic", *arguments)
        assert (code, text in err) == (2, True), err


@pytest.mark.usefixtures("places")
def test_a_comparison_is_refused_before_its_first_run(call, tmp_path, monkeypatch):
    """Where the log of any of its plants exists, or its folder takes none."""
    cosim.run("academic", out="a.mcap", set={"scenario.stop": 0.01})
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "a.mcap").touch()
    monkeypatch.setattr("cosim.scenario.recordings.recording.run_into", None)
    command = ("compare", "academic", "--swap", "plant=a.mcap", "--out")
    code, _, err = call(*command, "logs")
    assert (code, "logs/a.mcap exists" in err) == (2, True), err
    for folder in ("/proc", "/proc/x"):
        code, _, err = call(*command, folder)
        assert (code, "cannot be created" in err) == (2, True), err
    code, _, err = call(*command, "file")
    assert (code, "expected a folder for the logs, got 'file'" in err) == (2, True), err
    code, _, err = call(*command, "x.png", "--plot", "x.png")
    assert (code, "is the path of the log" in err) == (2, True), err
    assert os.listdir(tmp_path / "logs") == ["a.mcap"]


@pytest.mark.slow
@pytest.mark.parametrize("closed", [(1,), (2,), (0, 1, 2)])
def test_closed_standard_streams_are_nothing(tmp_path, closed):
    """No traceback, and no file of the run is stdout to C code, whose text would be in it."""
    redirections = " ".join(f"{number}{'<' if number == 0 else '>'}&-" for number in closed)
    program = f"{sys.executable} -c '{ONE}'"
    for arguments in ("run academic --stop 0.1 --out a.mcap", "info a.mcap"):
        result = subprocess.run(
            f"{program} {arguments} {redirections}",
            shell=True,
            cwd=tmp_path,
            capture_output=True,
            text=True,
        )
        assert (result.returncode, result.stderr) == (0, "")
    assert open_log(tmp_path / "a.mcap").status == "complete"


@pytest.mark.slow
def test_ctrl_c_while_the_command_line_is_imported_ends_without_a_traceback():
    """As later: with its exit code, and nothing on stderr."""
    code = (
        "import sys\n"
        "class Interrupting:\n"
        "    def find_spec(self, name, *rest):\n"
        "        if name == 'typer':\n"
        "            raise KeyboardInterrupt\n"
        "sys.meta_path.insert(0, Interrupting())\n"
        "from cosim.__main__ import main\n"
        "main()\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (result.returncode, result.stderr) == (130, "")


def trials_of(fmu):
    """Return the processes that try an FMU."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            words = (folder / "cmdline").read_bytes().split(b"\0")
            if b"cosim.fmi.checking.trial" in words and str(fmu).encode() in words:
                found.append(int(folder.name))
    return found


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="asks Linux for it")
def test_a_trial_ends_with_the_command_that_began_it(start, tmp_path):
    """However that ends; an FMU that hangs in its trial would go on computing without end."""
    fmu = compile_fmu(tmp_path / "hangs.fmu", XML, "rogue2.c", defines=("ROGUE=HANG",))
    process = start("check", fmu)
    for _ in range(3000):
        trials = trials_of(fmu)
        if trials:
            break
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(0.01)
            pytest.fail(f"ended early: {process.communicate()}")
    assert trials
    ends = [os.pidfd_open(pid) for pid in trials]
    process.kill()
    for end in ends:
        readable, _, _ = select.select([end], [], [], 10.0)  # readable once the process has ended
        os.close(end)
        assert readable
