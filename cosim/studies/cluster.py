"""Members on the workers of dask.distributed, each in a process beside its worker.

A worker is used when it computes with what this machine does and builds a member. Files that it
misses are sent to it, in one archive. A task is a second of members; two for each thread are on
their way, so that the scheduler holds as much for a million members as for a thousand.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import platform
import re
import secrets
import shutil
import zipfile
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from importlib import import_module
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from queue import Empty, SimpleQueue
from time import monotonic
from typing import TYPE_CHECKING, Any, Final, Self, TypeVar, final

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

_Plain = TypeVar("_Plain", StudyMember, StudySubject)


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
        self._study = _Site(own, trial, files, timeout)
        self._environment = environment()
        self._notice = notice
        self._resources = ExitStack()
        self._threads: dict[str, int] = {}  # of the workers that are used
        self._excluded: dict[str, str] = {}  # why others are not
        self._next_look = 0.0
        self._seconds = 0.0  # of a member

    def __enter__(self) -> Self:
        self._client = self._resources.enter_context(connected(self._scheduler))
        try:
            _check_scheduler(self._client, self._environment)
        except BaseException:
            self._resources.close()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        with uninterrupted(), self._resources, suppress(OSError, RuntimeError):
            self._client.run(_close, self._study.name, on_error="ignore")

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
        again: deque[Sequence[StudyMember]] = deque()
        running: dict[Future, tuple[Sequence[StudyMember], set[str]]] = {}  # on one of the workers
        done: SimpleQueue[Future] = SimpleQueue()
        given_up: list[int] = []
        try:
            while True:
                self._look()
                again += self._stranded(running)
                while len(running) < _PER_THREAD * sum(self._threads.values()):
                    part = again.popleft() if again else list(islice(waiting, self._size))
                    if not part:
                        break
                    workers = set(self._threads)
                    future = self._call(
                        "submit", _run_part, self._study.name, part, workers=workers, pure=False
                    )
                    running[future] = part, workers
                    future.add_done_callback(done.put)
                if not running:
                    break
                try:
                    future = done.get(timeout=_LOOK)
                    part, _ = running.pop(future)
                except (Empty, KeyError):
                    continue
                outcomes = self._outcomes(future, part)
                yield from zip(part, outcomes, strict=bool(outcomes))
                if future.status == "error":
                    given_up += [member.number for member in part]
                elif not outcomes:
                    again.append(part)
        finally:
            running.clear()  # dask cancels what nobody waits for
        if given_up:
            numbers = listing(list(map(str, sorted(given_up))), 10)
            raise RunError(
                f"dask gave up members {numbers}: every worker that ran them died; run the same "
                "study again to continue from its dataset"
            )

    def _stranded(
        self, running: dict[Future, tuple[Sequence[StudyMember], set[str]]]
    ) -> Iterator[Sequence[StudyMember]]:
        """Take back tasks that no worker is left for; yield their members."""
        for future, (part, workers) in [*running.items()]:
            if not workers & self._threads.keys() and future.status == "pending":
                del running[future]
                yield part

    @property
    def _size(self) -> int:
        """How many members the next task has: the first ones tell how long they take."""
        return min(MOST, max(1, int(_SECONDS / self._seconds))) if self._seconds else 1

    def _outcomes(self, future: Future, part: Sequence[StudyMember]) -> list[MemberOutcome]:
        """Return the outcomes of a task; none: its worker died with them, or cannot run it."""
        library = distributed()
        try:
            result = future.result(timeout=_FETCHING)
        except (TimeoutError, OSError, library.CancelledError, library.KilledWorker):
            return []
        except CosimError:
            raise
        except Exception as error:
            numbers = f"{part[0].number} to {part[-1].number}"
            raise RunError(f"members {numbers}: {type(error).__name__}: {error}") from error
        if isinstance(result, str):
            for address in self._call("who_has", [future])[future.key]:
                self._exclude({address: result})
            return []
        seconds, outcomes = result
        self._seconds = max(seconds / len(part), 1e-6)
        return list(outcomes)

    def _look(self) -> None:
        """Take notice of workers that came and went; wait for one if there is none to use."""
        while not self._threads or monotonic() >= self._next_look:
            present: dict[str, int] = dict(self._call("nthreads"))
            for address in sorted(self._threads.keys() - present.keys()):
                del self._threads[address]
                self._notice(f"worker {address} is gone; {len(self._threads)} left")
            self._excluded = {a: why for a, why in self._excluded.items() if a in present}
            new = sorted(present.keys() - self._threads.keys() - self._excluded.keys())
            if new:
                self._exclude(self._problems(new))
                self._threads |= {a: present[a] for a in new if a not in self._excluded}
            if not self._threads:
                self._wait(len(present))
            self._next_look = monotonic() + _LOOK

    def _problems(self, workers: Sequence[str], archive: bytes | None = None) -> dict[str, str]:
        """Let workers prepare for the study; return why they cannot by address, or nothing."""
        # not by tasks, which a worker without cosim cannot read, and never answers
        found = self._call(
            "run",
            _prepare,
            self._environment,
            pickle.dumps(self._study),
            archive,
            workers=workers,
            on_error="return",
        )
        problems = {
            a: p if isinstance(p, str) else f"{type(p).__name__}: {p}" for a, p in found.items()
        }
        lacking = [address for address, problem in problems.items() if problem == _LACKS_FILES]
        return problems | (self._problems(lacking, self._archive) if lacking else {})

    @cached_property
    def _archive(self) -> bytes:
        content = io.BytesIO()
        with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
            for file in self._study.files:
                archive.write(file, file.lstrip("/"))
        return content.getvalue()

    def _exclude(self, problems: Mapping[str, str]) -> None:
        """Use workers with a problem no more."""
        for address, problem in problems.items():
            self._threads.pop(address, None)
            if problem and address not in self._excluded:
                self._excluded[address] = problem
                self._notice(f"worker {address} is not used: {problem}")

    def _wait(self, present: int) -> None:
        """Wait for another worker than those that are there."""
        reasons = [f"{address}: {reason}" for address, reason in self._excluded.items()]
        lack = "the scheduler has no workers"
        if reasons:
            lack = f"no worker can run the study: {listing(reasons, 3)}"
        self._notice(f"{lack}; waiting {PATIENCE:g} s for a suitable worker")
        try:
            self._client.wait_for_workers(present + 1, timeout=PATIENCE)
        except TimeoutError as error:
            kind = UsageError if reasons else RunError
            raise kind(
                f"{lack}; none joined within {PATIENCE:g} s: start some ('dask worker ADDRESS') "
                "and run the study again"
            ) from error

    def _call(self, method: str, *values: Any, **options: Any) -> Any:
        """Call a method of the client."""
        try:
            return getattr(self._client, method)(*values, **options)
        except (OSError, RuntimeError) as error:
            raise RunError(
                "the connection to the scheduler of dask was lost; run the same study again to "
                "continue from its dataset"
            ) from error


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
            raise UsageError(
                f"{option('scheduler')}: expected a connected synchronous client, such as "
                f"distributed.Client(address), got {scheduler!r}"
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
    return {
        "Python": platform.python_version().rpartition(".")[0],
        "cosim": f"{__version__} {source_digest()}",
        **{name: version(name) for name in ("numpy", "scipy")},
        "system": f"{platforms.SYSTEM} {platforms.ARCHITECTURE}",
    }


def _differences(expected: Mapping[str, str]) -> str:
    """Return what this process computes with, and should not."""
    found = environment()
    names = [name for name in expected if expected[name] != found[name]]
    return "; ".join(f"expected {n} {expected[n]}, got {found[n]}" for n in names)


def _check_scheduler(client: Client, own: Mapping[str, str]) -> None:
    """Check that a scheduler can read the tasks of a study."""
    needed = {name: own[name] for name in ("Python", "cosim")}
    try:
        problem = client.run_on_scheduler(_differences, needed)
    except Exception as error:  # whatever its Python raises, such as an ImportError
        problem = f"{type(error).__name__}: {error}"
    if problem:
        raise UsageError(
            f"the scheduler cannot read the tasks of a study: {problem}; start it with Python "
            f"{own['Python']} and cosim {own['cosim']}"
        )


# --- in a worker of dask ---

_LACKS_FILES: Final = "files are missing"
_sites: dict[str, _Site] = {}  # by study


@dataclass
class _Site:
    """A study at a worker of dask: what it has to know of it, and what it has there."""

    subject: StudySubject
    trial: StudyMember
    files: Mapping[str, str]
    timeout: float | None
    name: str = field(default_factory=lambda: f"cosim-{secrets.token_hex(6)}")
    root: str = ""  # folder with copies of the files; empty: they are as planned
    problem: str | None = None  # None: nobody knows whether there is one
    parts: list[Sequence[StudyMember]] = field(default_factory=list)  # that are run

    def open(self) -> None:
        """Prepare to run members."""
        subject = self._moved(self.subject)
        if self.root and self.subject.scenario in self.files:  # it may name others absolutely
            path = Path(subject.scenario)
            path.write_text(self._with_copies(path.read_text("utf-8")), "utf-8")
            digests = {**subject.digests, subject.scenario: sha256_of(path)}
            subject = replace(subject, digests=digests)
        self._executor = LocalExecutor(subject, 1, timeout=self.timeout).__enter__()

    def run(self, part: Sequence[StudyMember]) -> str | tuple[float, list[MemberOutcome]]:
        """Return wall time [s] and outcomes of members; or why they cannot be built here."""
        self.parts.append(part)
        try:
            if self.problem is None:
                self.problem = self._try()
            if self.problem:
                return self.problem
            began = monotonic()
            outcomes = {}
            for member, one in self._executor.run(map(self._moved, part)):
                reason, *warnings = (t.replace(self.root, "") for t in (one.reason, *one.warnings))
                outcomes[member.number] = replace(one, reason=reason, warnings=warnings)
            return monotonic() - began, [outcomes[member.number] for member in part]
        finally:
            self.parts.pop()
            if self.name not in _sites:
                self.close()

    def _try(self) -> str:
        try:
            ((_, found),) = self._executor.run([self._moved(self.trial)], inspect_member)
        except CosimError as error:
            problem = str(error)
        else:
            problem = found.reason if isinstance(found, MemberOutcome) else found.refused
        return problem.replace(self.root, "")

    def close(self) -> None:
        """End the children, and remove the copies; the last part that is at work does so."""
        self._executor.stop()
        if not self.parts:
            self._executor.__exit__(None)
            if self.root:
                shutil.rmtree(self.root, ignore_errors=True)

    def _moved(self, value: _Plain) -> _Plain:
        """Return a subject or a member with the paths of copies."""
        if not self.root:
            return value
        text = json.dumps(asdict(value), ensure_ascii=False)
        return type(value)(**json.loads(self._with_copies(text)))

    def _with_copies(self, text: str) -> str:
        """Return JSON or TOML with the paths of copies instead of those of the files."""
        for quote in "\"'":
            text = re.sub(
                f"(?<={quote})[^{quote}#\n]+(?=[{quote}#])",
                lambda found: f"{self.root * (found[0] in self.files)}{found[0]}",
                text,
            )
        return text


def _prepare(
    expected: Mapping[str, str], content: bytes, archive: bytes | None, dask_worker: Any
) -> str:
    """Return why this worker cannot run a study, as far as is known without foreign code."""
    problem = _differences(expected)
    if problem:
        return problem
    site: _Site = pickle.loads(content)
    if site.name in _sites:
        return ""
    if archive is not None:
        site.root = os.path.abspath(os.path.join(dask_worker.local_directory, site.name))
        zipfile.ZipFile(io.BytesIO(archive)).extractall(site.root)
    elif not all(os.path.isfile(f) and sha256_of(f) == h for f, h in site.files.items()):
        return _LACKS_FILES
    site.open()
    _sites[site.name] = site
    return ""


def _run_part(name: str, members: Sequence[StudyMember]) -> str | tuple[float, list[MemberOutcome]]:
    """Run members; a worker that has been started anew has to be prepared again: nothing."""
    site = _sites.get(name)
    return "" if site is None else site.run(members)


def _close(name: str) -> None:
    """End the children of a study, and remove the copies of its files."""
    site = _sites.pop(name, None)
    if site is not None:
        site.close()
