"""Members on the workers of dask.distributed, each in a process beside its worker.

A worker is admitted when it computes with what this machine does and builds a member. Files that it
misses are sent to it, in one archive. A task is a second of members; two for each thread are on
their way, so that the scheduler holds as much for a million members as for a thousand.
"""

from __future__ import annotations

import io
import platform
import re
import secrets
import shutil
import threading
import zipfile
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from importlib import import_module
from itertools import islice
from pathlib import Path
from queue import Empty, SimpleQueue
from time import monotonic
from typing import TYPE_CHECKING, Any, Final, Self, final

from cosim.digests import sha256_of, source_digest
from cosim.errors import CosimError, RunError, UsageError, listing, option, quoted, shortened
from cosim.filters import ignored_warnings
from cosim.fmi import platforms
from cosim.interrupts import uninterrupted
from cosim.studies.contracts import MemberOutcome, StudyMember, StudySubject
from cosim.studies.members import CODE, inspect_member
from cosim.studies.workers import LocalExecutor
from cosim.version import __version__

if TYPE_CHECKING:
    from distributed import Client, Future

PATIENCE: Final = 60.0  # [s] without any worker
MOST: Final = 1000  # members of a task
_SECONDS: Final = 1.0  # of members in a task: at the end others wait for the last
_PER_THREAD: Final = 2  # tasks: the one that runs, and the next
_CONNECTING: Final = 5.0  # [s]
_FETCHING: Final = 5.0  # [s] for a result; its worker may have died with it
_LOOK: Final = 1.0  # [s] between looks at the workers


@dataclass(frozen=True)
class ClusterStudy:
    """What a worker has to know of a study: a member that can be built, files by SHA-256, ..."""

    subject: StudySubject
    trial: StudyMember
    files: Mapping[str, str]
    timeout: float | None
    environment: Mapping[str, str]  # where it was planned
    name: str = field(default_factory=lambda: secrets.token_hex(6))


@final
class ClusterExecutor:
    """Runs members of one study on a cluster; a context manager that ends what it began there.

    Parameters
    ----------
    scheduler : str or distributed.Client
    subject : StudySubject
    trial : StudyMember
        One that can be built.
    files : mapping of absolute path to SHA-256
    timeout : float or None
        Wall time that a member may take [s].
    notice : callable
        Takes a sentence for each worker that is not used.
    """

    def __init__(
        self,
        scheduler: str | Client,
        subject: StudySubject,
        trial: StudyMember,
        files: Mapping[str, str],
        *,
        timeout: float | None,
        notice: Callable[[str], None],
    ) -> None:
        self._scheduler = scheduler
        codes = {name: digest for name, digest in subject.digests.items() if CODE in name}
        own = replace(subject, digests={**files, **codes})
        self._study = ClusterStudy(own, trial, files, timeout, environment())
        self._notice = notice
        self._resources = ExitStack()
        self._threads: dict[str, int] = {}  # of the workers that are used
        self._asked: dict[str, Future] = {}  # of those that may be
        self._excluded: dict[str, str] = {}  # why others are not
        self._waits_since: float | None = None
        self._next_look = 0.0
        self._seconds = 0.0  # of a member

    def __enter__(self) -> Self:
        self._client = self._resources.enter_context(connected(self._scheduler))
        try:
            _check_scheduler(self._client, self._study.environment)
        except BaseException:
            self._resources.close()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        with uninterrupted(), self._resources, suppress(OSError, RuntimeError):
            if self._threads:
                workers = list(self._threads)
                self._client.run(_close, self._study.name, workers=workers, on_error="ignore")

    def run(self, members: Iterable[StudyMember]) -> Iterator[tuple[StudyMember, MemberOutcome]]:
        """Yield members with their outcomes, as they come.

        Raises
        ------
        UsageError
            If no worker can run them.
        RunError
            If workers or the scheduler are lost, or dask gives tasks up.
        """
        waiting = iter(members)
        again: deque[list[StudyMember]] = deque()
        running: dict[Future, tuple[list[StudyMember], set[str]]] = {}
        done: SimpleQueue[Future] = SimpleQueue()
        given_up: list[StudyMember] = []
        try:
            while True:
                self._look(wait=not running)
                while len(running) < _PER_THREAD * sum(self._threads.values()):
                    part = again.popleft() if again else list(islice(waiting, self._size))
                    if not part:
                        break
                    future = self._submit(_run_part, self._study, part, workers=[*self._threads])
                    running[future] = part, set(self._threads)
                    future.add_done_callback(done.put)
                if not running and self._threads:
                    break
                try:
                    future = done.get(timeout=_LOOK)
                    part, _ = running.pop(future)
                except (Empty, KeyError):
                    again += self._stranded(running)
                    continue
                outcomes = self._outcomes(future, part)
                if outcomes:
                    yield from zip(part, outcomes, strict=True)
                elif future.status == "error":
                    given_up += part
                else:  # its worker died with the result
                    again.append(part)
        finally:
            if running:
                with uninterrupted(), suppress(OSError, RuntimeError):
                    self._client.cancel(list(running), force=True)
        if given_up:
            numbers = listing(list(map(str, sorted(member.number for member in given_up))), 10)
            raise RunError(
                f"dask gave up members {numbers}: every worker that ran them died; run the same "
                "study again to continue from its dataset"
            )

    def _outcomes(self, future: Future, part: Sequence[StudyMember]) -> list[MemberOutcome]:
        """Return the outcomes of a task; none: its workers died."""
        library = distributed()
        outcomes: list[MemberOutcome] = []
        try:
            seconds, outcomes = future.result(timeout=_FETCHING)
            self._seconds = max(seconds / len(part), 1e-6)
        except (library.CancelledError, TimeoutError, OSError) as error:
            if self._client.status != "running":
                raise self._lost() from error
        except library.KilledWorker:
            pass
        except CosimError:
            raise
        except Exception as error:
            numbers = f"{part[0].number} to {part[-1].number}"
            raise RunError(f"members {numbers}: {type(error).__name__}: {error}") from error
        return outcomes

    @property
    def _size(self) -> int:
        """How many members the next task has: the first ones tell how long they take."""
        return min(MOST, max(1, int(_SECONDS / self._seconds))) if self._seconds else 1

    def _submit(self, function: Callable[..., Any], *values: Any, workers: list[str]) -> Future:
        try:
            return self._client.submit(function, *values, workers=workers, pure=False)
        except (OSError, RuntimeError) as error:
            raise self._lost() from error

    def _stranded(
        self, running: dict[Future, tuple[list[StudyMember], set[str]]]
    ) -> Iterator[list[StudyMember]]:
        """Yield the members of tasks that no worker is left for."""
        for future, (part, workers) in list(running.items()):
            if not workers & self._threads.keys() and future.status != "error":
                del running[future]
                self._client.cancel([future], force=True)
                yield part

    def _look(self, *, wait: bool) -> None:
        """Take notice of workers that came and went; wait for one if none is left."""
        while monotonic() >= self._next_look or (wait and not self._threads):
            try:
                present: dict[str, int] = dict(self._client.nthreads())
                known = self._threads.keys() | self._excluded.keys() | self._asked.keys()
                self._ask(sorted(present.keys() - known))
            except (OSError, RuntimeError) as error:
                raise self._lost() from error
            for address in sorted(self._threads.keys() - present.keys()):
                del self._threads[address]
                self._notice(f"worker {address} is gone; {len(self._threads)} left")
            self._excluded = {a: why for a, why in self._excluded.items() if a in present}
            self._asked = {a: future for a, future in self._asked.items() if a in present}
            for address, future in [*self._asked.items()]:
                if future.status != "pending":
                    del self._asked[address]
                    self._take(address, present[address], _problem(future))
            self._next_look = monotonic() + _LOOK
            if self._threads:
                self._waits_since = None
                return
            if not self._asked:
                self._be_patient()
            threading.Event().wait(0.1)

    def _ask(self, addresses: Sequence[str]) -> None:
        """Ask workers whether they can run the study, while others run it."""
        if not addresses:
            return
        # not by a task, which a worker without cosim cannot read, and never answers
        found = self._client.run(environment, workers=list(addresses), on_error="return")
        for address, own in found.items():
            problem = f"{type(own).__name__}: {own}"
            if isinstance(own, dict):
                problem = _differences(self._study.environment, own)
            if problem:
                self._take(address, 0, problem)
            else:
                self._asked[address] = self._submit(_admit, self._study, None, workers=[address])

    def _take(self, address: str, threads: int, problem: str) -> None:
        """Use a worker, or exclude it, or send it the files that it lacks."""
        if problem == _LACKS_FILES:
            try:  # not as an argument: the scheduler would keep it with the task
                files = self._client.scatter(self._archive, workers=[address])
            except (OSError, RuntimeError) as error:
                raise self._lost() from error
            self._asked[address] = self._submit(_admit, self._study, files, workers=[address])
        elif problem:
            self._excluded[address] = problem
            self._notice(f"worker {address} is not used: {problem}")
        else:
            self._threads[address] = threads

    @cached_property
    def _archive(self) -> bytes:
        content = io.BytesIO()
        with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
            for file in self._study.files:
                archive.write(file, file.lstrip("/"))
        return content.getvalue()

    def _be_patient(self) -> None:
        reasons = [f"{address}: {reason}" for address, reason in self._excluded.items()]
        lack = "the scheduler has no workers"
        if reasons:
            lack = f"no worker can run the study: {listing(reasons, 3)}"
        if self._waits_since is None:
            self._waits_since = monotonic()
            self._notice(f"{lack}; waiting {PATIENCE:g} s for a suitable worker")
        if monotonic() >= self._waits_since + PATIENCE:
            kind = UsageError if reasons else RunError
            raise kind(
                f"{lack}; none joined within {PATIENCE:g} s: start some ('dask worker ADDRESS') "
                "and run the study again"
            )

    def _lost(self) -> RunError:
        return RunError(
            "the connection to the scheduler of dask was lost; run the same study again to "
            "continue from its dataset"
        )


def _problem(admission: Future) -> str:
    try:
        return str(admission.result(timeout=_FETCHING))
    except Exception as error:  # whatever a worker raises
        return f"{type(error).__name__}: {error}"


# --- the connection ---


def distributed() -> Any:
    """Return the library; UsageError: it is not installed."""
    try:
        return import_module("distributed")
    except ImportError as error:
        raise UsageError(
            "studies on a cluster need dask.distributed, which is not installed: pip install "
            "distributed, or, in a clone of cosim, pip install -e '.[dask]'"
        ) from error


@contextmanager
def connected(scheduler: str | Client) -> Iterator[Client]:
    """Connect to a scheduler; a client that is given is not closed.

    Raises
    ------
    UsageError
        If there is none.
    """
    library = distributed()
    if isinstance(scheduler, library.Client):
        if scheduler.asynchronous or scheduler.status != "running":
            kind = "asynchronous" if scheduler.asynchronous else scheduler.status
            raise UsageError(
                f"{option('scheduler')}: expected a connected synchronous client, such as "
                f"distributed.Client(address), got one that is {kind}"
            )
        yield scheduler
        return
    try:
        with ignored_warnings(r"\s*Mismatched versions"):
            client = library.Client(scheduler, timeout=_CONNECTING, set_as_default=False)
    except (OSError, TypeError, ValueError) as error:  # TypeError: of TLS without certificates
        cause = shortened(" ".join(f"{type(error).__name__}: {error}".split()))
        raise UsageError(
            f"{option('scheduler')}: cannot connect to a dask scheduler at {quoted(scheduler)} "
            f"({cause}); expected the address printed by 'dask scheduler', such as tcp://host:8786"
        ) from error
    try:
        yield client
    finally:
        with uninterrupted(), suppress(Exception):  # what is not there cannot be closed
            client.close(timeout=2.0)


def environment() -> dict[str, str]:
    """Return what a process computes with."""
    from numpy import __version__ as numpy_version
    from scipy import __version__ as scipy_version

    return {
        "Python": ".".join(platform.python_version_tuple()[:2]),
        "cosim": f"{__version__} {source_digest()}",
        "numpy": numpy_version,
        "scipy": scipy_version,
        "system": f"{platforms.SYSTEM} {platforms.ARCHITECTURE}",
    }


def _differences(expected: Mapping[str, str], found: Mapping[str, str]) -> str:
    names = [name for name in expected if expected[name] != found[name]]
    return "; ".join(f"expected {n} {expected[n]}, got {found[n]}" for n in names)


def _check_scheduler(client: Client, own: Mapping[str, str]) -> None:
    """Check that a scheduler can read the tasks of a study."""
    names = ("Python", "cosim")
    try:
        found = client.run_on_scheduler(environment)
        problem = _differences({name: own[name] for name in names}, found)
    except Exception as error:  # whatever its Python raises, such as an ImportError
        problem = f"{type(error).__name__}: {error}"
    if problem:
        raise UsageError(
            f"the scheduler cannot read the tasks of a study: {problem}; start it with Python "
            f"{own['Python']} and cosim {own['cosim']}"
        )


# --- in a worker of dask ---

_LACKS_FILES: Final = "files are missing"
_roots: dict[str, str] = {}  # by study: where copies of its files are; empty: as planned
_executors: dict[tuple[str, int], tuple[LocalExecutor, threading.Lock]] = {}  # by thread, too


def _admit(study: ClusterStudy, files: bytes | None) -> str:
    """Return why this worker cannot run a study; empty: it can."""
    root = ""
    if not all(_has(path, digest) for path, digest in study.files.items()):
        if files is None:
            return _LACKS_FILES
        folder = Path(distributed().get_worker().local_directory)
        root = str(folder.absolute() / f"cosim-{study.name}")
        with zipfile.ZipFile(io.BytesIO(files)) as archive:
            archive.extractall(root)
        _name_copies(study, root)
    _roots[study.name] = root
    with _executor(study) as executor:
        trial = _moved_member(study, study.trial)
        ((_, found),) = executor.run([trial], inspect_member)
    problem = found.reason if isinstance(found, MemberOutcome) else found.refused
    return problem.replace(root, "") if root else problem


def _run_part(
    study: ClusterStudy, members: Sequence[StudyMember]
) -> tuple[float, list[MemberOutcome]]:
    """Run members; return the wall time that they took together [s], and their outcomes."""
    began = monotonic()
    with _executor(study) as executor:
        moved = (_moved_member(study, member) for member in members)
        outcomes: dict[int, MemberOutcome] = {m.number: o for m, o in executor.run(moved)}
    root = _roots[study.name]
    if root:
        for number, outcome in outcomes.items():
            warnings = [text.replace(root, "") for text in outcome.warnings]
            reason = outcome.reason.replace(root, "")
            outcomes[number] = replace(outcome, reason=reason, warnings=warnings)
    return monotonic() - began, [outcomes[member.number] for member in members]


def _close(name: str) -> None:
    """End the children of a study, and remove the copies of its files."""
    executors = [_executors.pop(key) for key in [*_executors] if key[0] == name]
    root = _roots.pop(name, "")

    def end() -> None:
        for executor, lock in executors:
            executor.stop()
            with lock:
                executor.__exit__(None)
        if root:
            shutil.rmtree(root, ignore_errors=True)

    threading.Thread(target=end).start()  # as the worker answers its scheduler meanwhile


@contextmanager
def _executor(study: ClusterStudy) -> Iterator[LocalExecutor]:
    """Have what runs the members of a study beside this thread, which nobody closes meanwhile."""
    key = study.name, threading.get_ident()
    if key not in _executors:
        subject = study.subject
        root = _roots[study.name]
        if root:
            subject = StudySubject(**_moved(asdict(subject), study.files, root))
            if subject.scenario in subject.digests:
                digests = {**subject.digests, subject.scenario: sha256_of(subject.scenario)}
                subject = replace(subject, digests=digests)
        executor = LocalExecutor(subject, 1, timeout=study.timeout)
        _executors[key] = executor.__enter__(), threading.Lock()
    executor, lock = _executors[key]
    with lock:
        yield executor


def _has(path: str, digest: str) -> bool:
    try:
        return sha256_of(path) == digest
    except OSError:
        return False


def _moved_member(study: ClusterStudy, member: StudyMember) -> StudyMember:
    root = _roots[study.name]
    return StudyMember(**_moved(asdict(member), study.files, root)) if root else member


def _moved(value: Any, files: Mapping[str, str], root: str) -> Any:
    """Return a value with the paths of copies instead of those of the files."""
    match value:
        case str():
            path, mark, rest = value.partition("#")
            return root + path + mark + rest if path in files else value
        case Mapping():
            return {
                _moved(key, files, root): _moved(item, files, root) for key, item in value.items()
            }
        case list() | tuple():
            return [_moved(item, files, root) for item in value]
    return value


def _name_copies(study: ClusterStudy, root: str) -> None:
    """Let the copy of a scenario name the copies of files that it names by absolute paths."""
    if study.subject.scenario not in study.files:
        return
    scenario = Path(_moved(study.subject.scenario, study.files, root))
    text = scenario.read_text(encoding="utf-8")
    for path in study.files:
        copy = root + path
        text = re.sub(f"(?<=[\"']){re.escape(path)}(?=[\"'#])", copy, text)
    scenario.write_text(text, encoding="utf-8")
