"""Fixtures that every part of the suite may use."""

from __future__ import annotations

import gc
import json
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

# As on the command line, and before numpy is imported: the suite has a process for each core.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Or each process that tests start would compile what it imports.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# The same examples every time, and no deadline: machines are slow now and then.
# HYPOTHESIS_PROFILE=search looks for new ones.
settings.register_profile("repeat", max_examples=50, derandomize=True, deadline=None)
settings.register_profile("search", max_examples=1000, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeat"))

HERE = Path(__file__).parent
REFERENCE = HERE / "reference" / "cases.json"


def pytest_collection(session: pytest.Session) -> None:
    """Import one share of the whole suite first, so that its workers compile each module once.

    Every worker collects all tests; side by side in one order, each would compile every module.
    """
    is_whole = HERE.resolve() in {Path(given).resolve() for given in session.config.args}
    if not is_whole or "PYTEST_XDIST_WORKER" not in os.environ:
        return
    gc.disable()  # what is collected stays
    number = int(os.environ["PYTEST_XDIST_WORKER"].removeprefix("gw"))
    workers = int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
    for path in sorted(HERE.rglob("test_*.py"))[number::workers]:
        module = path.relative_to(HERE.parent).with_suffix("")
        with suppress(Exception, pytest.skip.Exception):  # reported when it is collected
            import_module(".".join(module.parts))


def pytest_collection_finish() -> None:
    """Keep the tests out of garbage collections: each looked through half a million objects."""
    gc.enable()
    gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_pycollect_makeitem() -> Generator[None, Any, Any]:
    """Mark as slow the cases of a test that its mark ``fast`` does not name."""
    made = yield
    if not isinstance(made, list):
        return made
    cases = {case.callspec.id: case for case in made if case.get_closest_marker("fast")}
    for name, case in cases.items():
        named = case.get_closest_marker("fast").args
        if not cases.keys() >= set(named):
            raise pytest.UsageError(f"{case.nodeid}: fast: expected among {list(cases)}")
        if name not in named:
            case.add_marker(pytest.mark.slow)
    return made


SECONDS_OF_A_FAST_TEST = 1.0
STARTED = pytest.StashKey[float]()


def processor_time() -> float:
    """Return the time that this process and its ended children computed [s]."""
    return sum(os.times()[:4])


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Note when a test begins; its fixtures count."""
    item.stash[STARTED] = processor_time()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, Any]:
    """Note what a test took that is not marked as one of the slow ones."""
    report = yield
    marks = {mark.name for mark in item.iter_markers()}
    if report.when == "call" and not marks & {"slow", "external", "campaign"}:
        taken = processor_time() - item.stash[STARTED]
        report.user_properties.append(("processor_time", taken))
    return report


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Name the tests that should be marked as slow, or be shorter."""
    lines = []
    for report in terminalreporter.getreports("passed"):
        taken = dict(report.user_properties).get("processor_time", 0.0)
        if report.when == "call" and taken > SECONDS_OF_A_FAST_TEST:
            lines.append(f"{taken:5.1f} s  {report.nodeid}")
    if lines:
        terminalreporter.section(f"not marked slow, over {SECONDS_OF_A_FAST_TEST:g} s of CPU time")
        terminalreporter.write_line("\n".join(sorted(lines, reverse=True)))


def folder_of_the_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder that all workers of a run of the suite share."""
    own = tmp_path_factory.getbasetemp()
    return own.parent if "PYTEST_XDIST_WORKER" in os.environ else own


@pytest.fixture(scope="session", autouse=True)
def cache_of_the_suite(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep trials of FMUs and compiled files in a folder of this run, for all its workers.

    So an FMU is tried, and a C source compiled, once for each content, however many tests need it.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COSIM_CACHE", str(folder_of_the_run(tmp_path_factory) / "cache"))
        yield


@pytest.fixture(scope="session", autouse=True)
def trials_in_this_process() -> Iterator[None]:
    """Try FMUs where the test runs, unless it asks for ``trials_in_children``."""
    from cosim.fmi import child_process
    from tests.fmi.in_process import attempt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(child_process, "attempt", attempt)
        yield


@pytest.fixture
def trials_in_children(monkeypatch: pytest.MonkeyPatch) -> None:
    """Try FMUs in children, as users do: for tests of trials, crashes and hangs."""
    from cosim.fmi import child_process
    from tests.fmi.in_process import IN_A_CHILD

    monkeypatch.setattr(child_process, "attempt", IN_A_CHILD)


@pytest.fixture(scope="session", autouse=True)
def signals_of_a_terminal() -> Iterator[None]:
    """Let processes of tests be interrupted, also where the suite runs in the background.

    There a shell ignores SIGINT, and ``nohup`` SIGHUP; what is ignored is ignored in children too.
    """
    ignored = {}
    for number in (signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)):
        if signal.getsignal(number) is signal.SIG_IGN:
            default = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
            ignored[number] = signal.signal(number, default)
    yield
    for number, handler in ignored.items():
        signal.signal(number, handler)


@pytest.fixture
def frozen_heap() -> None:
    """Keep what other tests left out of garbage collections: for tests that compare costs.

    A collection takes as long as there are objects, and who makes many objects causes many. Nothing
    is collected before: what is garbage already is kept as well, which takes no time.
    """
    gc.freeze()


@pytest.fixture
def without_verdicts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the verdicts of all runs, as ``scenario.verdicts = false`` does of one."""
    from cosim.scenario.recordings.verdicts import Assessor

    monkeypatch.setattr(Assessor, "results", lambda assessor: {})


ASSESSED: dict[bytes, Any] = {}  # by the problem and the start of the fit, as pickle writes them


# Folders and modules whose tests run one scenario over and over.
OF_EQUAL_RUNS = frozenset({"cli", "log", "report", "studies", "test_ending.py", "test_terminal.py"})


@pytest.fixture(scope="module", autouse=True)
def verdicts_once(request: pytest.FixtureRequest) -> Iterator[None]:
    """Assess the same data of the same run once where many runs are equal.

    A run of another bit of its data, of its scenario or of its last estimate is assessed anew.
    """
    if request.path.relative_to(HERE).parts[0] not in OF_EQUAL_RUNS:
        yield
        return
    from cosim.scenario.recordings import verdicts

    assess = verdicts.assess

    def assess_once(problem: Any, start: Any) -> Any:
        given = pickle.dumps((problem, start))
        if given not in ASSESSED:
            ASSESSED[given] = assess(problem, start)
        return ASSESSED[given]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(verdicts, "assess", assess_once)
        yield


@pytest.fixture(scope="session")
def case() -> Callable[[str], dict[str, Any]]:
    """Look up a case of `tests/reference/cases.json` by its id: `case("C01")`."""
    cases = {
        entry["id"]: entry for entry in json.loads(REFERENCE.read_text(encoding="utf-8"))["cases"]
    }
    return cases.__getitem__


def _build(tool: str, script: str, folder: Path) -> Path:
    subprocess.run(
        [sys.executable, "-m", tool, "build", "-f", str(HERE / "fmi" / script), "-d", str(folder)],
        check=True,
        capture_output=True,
    )
    return next(folder.glob("*.fmu"))


@pytest.fixture(scope="session")
def foreign2(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """FMI 2, co-simulation, by pythonfmu."""
    return _build("pythonfmu", "foreign2.py", tmp_path_factory.mktemp("foreign2"))


@pytest.fixture(scope="session")
def foreign3(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """FMI 3, model exchange and co-simulation, by pythonfmu3."""
    return _build("pythonfmu3", "foreign3.py", tmp_path_factory.mktemp("foreign3"))


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let commands that do their work in a child do it here: this one has no terminal either."""
    from cosim.processes import COMMAND_VARIABLE

    monkeypatch.setenv(COMMAND_VARIABLE, "0")


@pytest.fixture
def call(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """Run a command in a fresh folder; give exit code, stdout and stderr."""
    from cosim.cli import main

    monkeypatch.chdir(tmp_path)

    def run(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as left:
            main([str(argument) for argument in arguments])
        output = capsys.readouterr()
        code = left.value.code
        assert code is None or isinstance(code, int)
        return code or 0, output.out, output.err

    return run
