"""The workers of a cluster that a study uses: those that were checked, and have its files.

Workers may come and go at any time. One that comes is checked before it gets tasks, as the first
ones are; one that was started again is another one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, final

from cosim.errors import CosimError, RunError, UsageError, listing
from cosim.studies.cluster.environment import (
    binary_folders,
    describe_environment,
    lacks,
    without_binary,
)
from cosim.studies.cluster.opening import TRIAL
from cosim.studies.cluster.station import MemberStation
from cosim.studies.cluster.worker_side import (
    close_study,
    describe,
    find_missing,
    open_study,
    take_file,
)
from cosim.studies.contracts import StudyMember, StudySubject

if TYPE_CHECKING:
    from distributed import Client

SHOWN: Final = 3  # workers that a message names


@final
class Workforce:
    """The workers that a study uses.

    Parameters
    ----------
    client : Client
    settings : mapping
        As of :class:`WorkerStudy`.
    notice : callable
        Takes a sentence for each worker that is not used.
    """

    def __init__(
        self, client: Client, settings: Mapping[str, Any], notice: Callable[[str], None]
    ) -> None:
        self._client = client
        self._settings = settings
        self._files: Mapping[str, str] = settings["files"]
        self._notice = notice
        self._own = describe_environment()
        self._folders = binary_folders(self._files)
        self._own_problem: str | None = None
        self._excluded: dict[str, str] = {}
        self.threads: dict[str, int] = {}
        self.writes = False  # whether a worker writes the dataset

    def refresh(self) -> None:
        """Take notice of workers that came and went."""
        present: dict[str, int] = dict(self._client.nthreads())
        for address in self.threads.keys() - present.keys():
            del self.threads[address]
        for address in self._excluded.keys() - present.keys():
            del self._excluded[address]
        new = present.keys() - self.threads.keys() - self._excluded.keys()
        for address in self._admit(sorted(new)):
            self.threads[address] = present[address]

    def forget(self, address: str) -> None:
        """Have a worker checked as a new one."""
        self.threads.pop(address, None)

    def close(self) -> None:
        """End the study on its workers."""
        if self.threads:
            self._ask(close_study, self._settings["name"], workers=self.threads)

    def none_left(self) -> CosimError:
        """Return the error where no worker can be used."""
        if not self._excluded:
            return RunError(
                "the scheduler has no workers; start some, as with 'dask worker ADDRESS', and run "
                "the study again: it goes on where it was"
            )
        reasons = [f"{address}: {reason}" for address, reason in self._excluded.items()]
        return UsageError(f"no worker can run the study: {listing(reasons, SHOWN)}")

    @property
    def has_excluded(self) -> bool:
        """Whether there are workers that are not used."""
        return bool(self._excluded)

    def _admit(self, new: list[str]) -> list[str]:
        """Return those of some workers that can be used; they have all that they need."""
        answers = self._without_errors(self._ask(describe, workers=new))
        fit = [address for address, found in answers.items() if self._is_fit(address, found)]
        missing = self._without_errors(self._ask(find_missing, self._files, workers=fit))
        self._send(missing)
        opened = self._ask(open_study, self._settings, workers=missing)
        usable = []
        for address, answer in self._without_errors(opened).items():
            if answer["problem"] and answer["problem"] != self._problem_here():
                self._exclude(address, answer["problem"])
                continue
            if answer["problem"]:
                self._ask(open_study, {**self._settings, "first": None}, workers=[address])
            self.writes |= answer["writes"]
            usable.append(address)
        return usable

    def _is_fit(self, address: str, found: Mapping[str, str]) -> bool:
        reason = lacks(self._own, found)
        if not reason:
            missing = without_binary(self._folders, found["system"], found["architecture"])
            needed = f"{found['architecture']}-{found['system']}"
            for path, folders in missing.items():
                reason = f"{Path(path).name} has no binary for {needed}; it has {listing(folders)}"
                break
        if reason:
            self._exclude(address, reason)
        return not reason

    def _send(self, missing: Mapping[str, Iterable[str]]) -> None:
        """Send every file once to each worker that has to be sent it."""
        paths = {digest: path for path, digest in self._files.items()}
        for digest in sorted(set().union(*missing.values())):
            addresses = [address for address, wanted in missing.items() if digest in wanted]
            self._ask(take_file, Path(paths[digest]).read_bytes(), workers=addresses)

    def _problem_here(self) -> str:
        """Return what is wrong with the first member where the study is planned."""
        if self._own_problem is None:
            settings = self._settings
            subject = StudySubject(**settings["subject"])
            station = MemberStation(settings["opener"], subject, timeout=settings["timeout"])
            try:
                (outcome,) = station.run([StudyMember(*settings["first"])])
                self._own_problem = outcome.reason
            except CosimError as error:
                self._own_problem = str(error)
            finally:
                station.close()
        return self._own_problem

    def _ask(self, function: Callable[..., Any], *values: Any, workers: Iterable[str]) -> Any:
        """Return the answers of workers by address; an answer may be an error."""
        addresses = list(workers)
        if not addresses:
            return {}
        return self._client.run(function, *values, workers=addresses, on_error="return")

    def _without_errors(self, answers: Mapping[str, Any]) -> dict[str, Any]:
        """Return the answers that are none; exclude the workers that gave one."""
        found = {}
        for address, answer in answers.items():
            if isinstance(answer, BaseException):
                self._exclude(address, f"{type(answer).__name__}: {answer}")
            else:
                found[address] = answer
        return found

    def _exclude(self, address: str, reason: str) -> None:
        self._excluded[address] = reason
        self._notice(f"worker {address} is not used: {reason}")


def first_member(member: StudyMember) -> tuple[Any, ...]:
    """Return the values of a member that is tried."""
    return TRIAL, dict(member.set), dict(member.swap), member.recording
