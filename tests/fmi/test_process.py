"""What an FMU does to the process, and what it returns besides errors, is found and reported."""

import ctypes
import locale
import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import cosim
from cosim.core import Clock, Graph, Stopped
from cosim.core.master import run as run_graph
from cosim.core.recorders import Memory
from cosim.core.signals import Interface
from cosim.errors import RunError
from cosim.fmi.binary.process import CHANGES, Process
from cosim.fmi.component import load
from cosim.fmi.driving.guarded import Guarded
from tests.fmi.rogues import STATELESS, compile_rogue

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the FMU is written for Linux")

REPORT = {
    "FLUSHES": "how subnormal numbers are computed",
    "TRAPS": "that floating-point exceptions end the process",
    "SPEAKS": "the locale of numbers",
    "MOVES": "the working directory",
    "CATCHES": "what Ctrl-C and a request to terminate do",
    "CLOSES": "that stdin, stdout or stderr is open",
}
CHANGED = [
    *((what, "STEP") for what in REPORT),
    ("FLUSHES", "INSTANTIATE"),
    ("MOVES", "INSTANTIATE"),
    ("TRAPS", "INITIALIZE"),
    ("CLOSES", "TERMINATE"),
]


@pytest.fixture
def rogue(tmp_path):
    """Compile the FMU that does one thing wrong, and write a scenario with it."""

    def make(what: str, where: str = "STEP") -> Path:
        compile_rogue(tmp_path / "rogue.fmu", what, STATELESS, f"WHERE={where}")
        scenario = tmp_path / "one.toml"
        scenario.write_text(
            '[scenario]\nname = "one"\nstop = 0.05\nstep = 0.01\n'
            '[components.u]\nkind = "constant"\nvalue = 0.5\n'
            '[components.plant]\nkind = "fmu"\npath = "rogue.fmu"\n'
            '[connections]\n"plant.u" = "u.y"\n'
        )
        return scenario

    return make


@pytest.fixture(autouse=True)
def process_stays():
    """Whatever an FMU does, the process is afterwards as it was."""
    process = Process()
    process.save()
    stdout = sys.stdout
    keep = os.dup(1)
    yield
    changes = process.restore()
    os.dup2(keep, 1)
    os.close(keep)
    assert changes == 0
    assert sys.stdout is stdout


def texts(recording):
    return [text for *_, text in recording.messages()]


def euler():
    """Return x of the FMU for u = 1/2, from 1, at the communication points."""
    x = [1.0]
    for _ in range(5):
        x.append(x[-1] + 0.01 * (0.5 - x[-1]))
    return np.array(x)


# --- the process ---


@pytest.mark.parametrize(("what", "where"), CHANGED)
def test_a_change_of_the_process_is_undone_and_reported_once(rogue, what, where):
    """The numbers are right all the same, so the run goes on."""
    memory = cosim.run(rogue(what, where), recorder=Memory())
    assert (memory.status, memory.reason) == ("complete", "")
    assert memory["plant.y"] == pytest.approx(euler(), rel=1e-15)
    assert [text for text in texts(memory) if REPORT[what] in text and "as before" in text] != []
    assert len([text for text in texts(memory) if REPORT[what] in text]) == 1


def test_another_rounding_mode_in_a_step_ends_the_run(rogue, tmp_path):
    """What was computed in that block is not to be relied on: the row before it is kept."""
    out = tmp_path / "one.mcap"
    with pytest.raises(RunError, match=r"rogue: changed the rounding mode or the precision"):
        cosim.run(rogue("ROUNDS"), out=out, block=1)
    log = cosim.open_log(out)
    assert log.status == "failed"
    assert log["plant.y"].tolist() == [1.0]
    assert 1.0 + 2.0**-54 == 1.0


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        ("ROUNDS_ENDS", "the FMU requests the end of the run"),
        ("ROUNDS_FAILS", "fmi2DoStep returned 3 (error)"),
    ],
)
def test_no_row_of_another_rounding_mode_is_kept_where_the_fmu_stops(rogue, what, reason):
    """It stops in its third step, on request or with an error; the mode changed in the first."""
    path = rogue(what).with_name("rogue.fmu")
    t = np.arange(6) / 100
    with load(path) as fmu:
        fmu.component.initialize(0.0, np.zeros(1))
        with pytest.raises(RunError, match="rogue: changed the rounding") as caught:
            fmu.component.advance(t, 0.01, np.zeros((6, 1)))
    assert not isinstance(caught.value, Stopped)
    assert reason in str(caught.value)


@pytest.mark.parametrize("call", ["save", "restore"])
def test_another_rounding_mode_from_saving_a_state_is_undone(call):
    """Else it would be taken for what the next call found, and be kept."""
    libm = ctypes.CDLL("libm.so.6")
    guarded = Guarded(Rounding(lambda: libm.fesetround(0x800)), "rounder", "")
    with pytest.raises(RunError, match=r"rounder: changed the rounding mode"):
        getattr(guarded, call)(*([(None, 0)] if call == "restore" else []))
    assert 1.0 + 2.0**-54 == 1.0


@pytest.mark.parametrize("where", ["INSTANTIATE", "TERMINATE"])
def test_another_rounding_mode_outside_the_run_is_only_reported(rogue, where):
    """It is undone before anything is computed with it."""
    memory = cosim.run(rogue("ROUNDS", where), recorder=Memory())
    assert memory.status == "complete"
    assert memory["plant.y"] == pytest.approx(euler(), rel=1e-15)
    assert sum("the rounding mode" in text for text in texts(memory)) == 1


def test_another_rounding_mode_in_the_initialization_ends_the_run(rogue):
    with pytest.raises(RunError, match=r"changed the rounding mode or the precision"):
        cosim.run(rogue("ROUNDS", "INITIALIZE"), recorder=Memory())


def test_python_and_c_see_the_same_process():
    """A change that Python itself makes: each is found, put back, and then no longer there."""
    process = Process()
    home = os.getcwd()

    def close_stdin():
        os.close(0)

    def change_handler():
        signal.signal(signal.SIGTERM, signal.SIG_IGN)

    libm = ctypes.CDLL("libm.so.6")
    changes = {
        "rounding mode": lambda: libm.fesetround(0x800),
        "locale": lambda: locale.setlocale(locale.LC_NUMERIC, "C.UTF-8"),
        "working directory": lambda: os.chdir("/"),
        "Ctrl-C": change_handler,
        "stdin": close_stdin,
    }
    stdin = os.dup(0)
    try:
        for text, change in changes.items():
            process.save()
            change()
            found = process.restore()
            assert [text in CHANGES[bit] for bit in CHANGES if bit & found] == [True]
            assert process.restore() == 0
    finally:
        os.dup2(stdin, 0)
        os.close(stdin)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
    assert os.getcwd() == home


def test_another_thread_may_change_what_is_shared(rogue):
    """An FMU that runs in a thread: what the main thread does meanwhile is not undone."""
    process = Process()
    found = []

    def in_thread():
        process.save()
        moved.wait(5.0)
        found.append(process.restore())

    home = os.getcwd()
    moved = threading.Event()
    thread = threading.Thread(target=in_thread)
    thread.start()
    try:
        os.chdir("/")
        moved.set()
        thread.join()
        assert (found, os.getcwd()) == ([0], "/")
    finally:
        os.chdir(home)


# --- statuses ---


def test_a_failure_at_the_end_fails_the_run(rogue, tmp_path):
    """All rows are kept."""
    out = tmp_path / "one.mcap"
    with pytest.raises(RunError, match=r"'plant' failed at the end of the run: .*fmi2Terminate"):
        cosim.run(rogue("FAILS_END"), out=out)
    log = cosim.open_log(out)
    assert (log.status, len(log["plant.y"])) == ("failed", 6)
    assert "fmi2Terminate returned 3 (error)" in log.reason


def test_a_failure_at_the_end_is_raised_where_an_fmu_is_used_directly(rogue):
    """Unless there is another error, which says more."""
    path = rogue("FAILS_END").with_name("rogue.fmu")
    with pytest.raises(RunError, match=r"fmi2Terminate returned 3 \(error\)"), load(path) as fmu:
        started(fmu)
    with pytest.raises(RunError, match="needed a finite"), load(path) as fmu:
        started(fmu, other_error="needed a finite")
    fmu = load(path)
    started(fmu)
    fmu.close()


def started(fmu, other_error=""):
    fmu.component.initialize(0.0, np.zeros(1))
    fmu.component.advance(np.array([0.0, 0.01]), 0.01, np.zeros((2, 1)))
    if other_error:
        raise RunError(other_error)


def test_a_warning_is_reported_once(rogue):
    memory = cosim.run(rogue("WARNS"), recorder=Memory())
    found = [m for m in memory.messages() if "fmi2DoStep returned 1 (warning)" in m.text]
    assert [(m.time_ns, m.level, m.source) for m in found] == [(0, "warning", "plant")]
    assert memory["plant.y"] == pytest.approx(euler(), rel=1e-15)


# --- threads ---


def test_fmus_run_side_by_side_in_threads(rogue):
    """Each gives its own rows, and nothing of the process is another's afterwards."""
    scenario = rogue("PRINTS")
    with ThreadPoolExecutor(4) as pool:
        runs = [pool.submit(cosim.run, scenario, recorder=Memory()) for _ in range(12)]
        for future in runs:
            memory = future.result()
            assert memory.status == "complete"
            assert memory["plant.y"] == pytest.approx(euler(), rel=1e-15)


def test_nothing_redirects_what_all_threads_share():
    """Only the command line, handlers of the main thread and, with a lock, filters of warnings."""
    allowed = {"terminal.py", "interrupts.py", "recording.py", "filters.py", "options.py"}
    allowed.add("platforms.py")  # the folder of a binary that has others beside it
    words = ("redirect_std", "chdir(", "catch_warnings", "signal.signal(", "np.seterr(", "putenv")
    found = set()
    for path in Path(cosim.__file__).parent.rglob("*.py"):
        if any(word in path.read_text(encoding="utf-8") for word in words):
            found.add(path.name)
    assert found <= allowed


def test_a_graph_in_a_thread_runs(rogue):
    """Without a scenario too: the FMU is loaded in one thread and advances in another."""
    path = rogue("GOOD").with_name("rogue.fmu")
    with load(path) as fmu:
        memory = Memory()
        source = load(path)
        with source, ThreadPoolExecutor(1) as pool:
            graph = Graph({"a": fmu.component, "b": source.component}, {"a.u": "b.y", "b.u": "a.y"})
            pool.submit(run_graph, graph, Clock(0.05, 0.01), memory).result()
    assert memory.status == "complete"


class Rounding:
    """A component that changes the rounding mode where its state is saved or restored."""

    def __init__(self, change):
        self.save = change

    def restore(self, state):
        self.save()


class Moving:
    """A component whose every call changes the working directory, and then fails."""

    interface = Interface()
    notes = ()

    def initialize(self, t, u):
        os.chdir("/")
        raise RunError("mine")

    outputs = initialize

    def advance(self, t, h, u):
        self.initialize(t, u)

    def drain(self):
        return []


@pytest.mark.parametrize("call", ["initialize", "outputs", "advance"])
def test_a_change_in_a_call_that_fails_is_undone_too(call):
    """The error is the component's, the change is reported beside it."""
    home = os.getcwd()
    guarded = Guarded(Moving(), "mover", "")
    arguments = {"advance": (np.zeros(2), 1.0, np.zeros((2, 0)))}.get(call, (0.0, np.zeros(0)))
    with pytest.raises(RunError, match="mine"):
        getattr(guarded, call)(*arguments)
    assert os.getcwd() == home
    assert [message.text for message in guarded.drain()] == [
        "mover: changed the working directory; it is as before again"
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "code", "words"),
    [
        ("CRASHES_LATER", -signal.SIGSEGV, "crashes: SIGSEGV"),
        ("EXITS_LATER", 3, "ends the process with exit code 3"),
    ],
)
def test_where_the_process_dies_is_said(rogue, tmp_path, what, code, words):
    """The component, the time, what happened, the log of the run and the function of the FMU."""
    scenario = rogue(what)
    command = [sys.executable, "-m", "cosim", "run", str(scenario), "--out", "x.mcap"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == code
    said = f"cosim: plant, at t = 0.02 s: {words}; its log is x.mcap; in fmi2DoStep"
    assert said in done.stderr.splitlines()
    assert cosim.open_log(tmp_path / "x.mcap").status == "unfinished"


VIRTUAL_MACHINE = """
#define _GNU_SOURCE
#include <signal.h>
#include <sys/mman.h>
#include <unistd.h>
static char *page;
static void give(int number, siginfo_t *info, void *context)
{
    if (info->si_addr != page || mprotect(page, 4096, PROT_READ))
        _exit(3);
}
void begin(void)
{
    struct sigaction action = {.sa_sigaction = give, .sa_flags = SA_SIGINFO};
    page = mmap(0, 4096, PROT_NONE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    sigaction(SIGSEGV, &action, 0);
}
int read_page(void) { return *(volatile char *)page; }
"""


@pytest.mark.slow
def test_who_lives_by_faults_gets_them_as_they_are(tmp_path):
    """A virtual machine that was there before needs the address, and goes on."""
    (tmp_path / "vm.c").write_text(VIRTUAL_MACHINE)
    binary = tmp_path / "vm.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-o", binary, tmp_path / "vm.c"], check=True)
    program = (
        "import ctypes; from cosim.native.fmi.process import report_deaths; "
        f"vm = ctypes.CDLL({str(binary)!r}); vm.begin(); report_deaths(); "
        "print(vm.read_page())"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "0\n", "")
