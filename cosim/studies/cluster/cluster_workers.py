"""The workers of a cluster that a study uses: those that were admitted.

Workers may come and go at any time, and are admitted while the others run members. One that was
started again is another one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future
from time import monotonic
from typing import TYPE_CHECKING, Final, final

from cosim.errors import CosimError, RunError, UsageError, listing
from cosim.studies.cluster.admission import Admission, Admitted
from cosim.studies.cluster.cluster_study import ClusterStudy
from cosim.studies.cluster.worker_functions import close_study

if TYPE_CHECKING:
    from distributed import Client

SHOWN: Final = 3  # workers that a message names
PATIENCE: Final = 60.0  # [s] without any worker


@final
class ClusterWorkers:
    """The workers that a study uses.

    Parameters
    ----------
    client : Client
    study : ClusterStudy
    notice : callable
        Takes a sentence for each worker that is not used or has gone, and where there is none.
    admitted : callable
        Called when it is known of a worker whether it is used, in any thread.

    Attributes
    ----------
    threads : dict of address to int
        Of the workers that are used.
    writes : bool
        Whether one of them writes the dataset.
    """

    def __init__(
        self,
        client: Client,
        study: ClusterStudy,
        *,
        notice: Callable[[str], None],
        admitted: Callable[[], None],
    ) -> None:
        self._client = client
        self._name = study.name
        self._admission = Admission(client, study)
        self._notice = notice
        self._admitted = admitted
        self._admissions: dict[str, Future[Admitted]] = {}
        self._excluded: dict[str, str] = {}
        self._waits_since: float | None = None  # None: there is a worker, or one that might be
        self.threads: dict[str, int] = {}
        self.writes = False

    def refresh(self) -> None:
        """Take notice of workers that came, went, or were admitted.

        Raises
        ------
        UsageError, RunError
            If there was none to use for some time.
        """
        present: dict[str, int] = dict(self._client.nthreads())
        self._forget_others(present)
        known = self.threads.keys() | self._excluded.keys() | self._admissions.keys()
        for address in sorted(present.keys() - known):
            self._admissions[address] = self._admission.submit(address)
            self._admissions[address].add_done_callback(lambda _: self._admitted())
        for address, future in list(self._admissions.items()):
            if future.done():
                del self._admissions[address]
                self._take(address, future.result(), present[address])
        self._check_patience()

    def forget(self, address: str) -> None:
        """Have a worker admitted as a new one."""
        self.threads.pop(address, None)

    def close(self) -> None:
        """End the study on its workers."""
        for future in self._admissions.values():
            future.cancel()
        addresses = [*self.threads, *self._admissions]
        if addresses:
            self._client.run(close_study, self._name, workers=addresses, on_error="return")

    def _forget_others(self, present: Mapping[str, int]) -> None:
        """Forget the workers that are not there any more."""
        for address in self._admissions.keys() - present.keys():
            self._admissions.pop(address).cancel()
        for address in sorted(self.threads.keys() - present.keys()):
            del self.threads[address]
            left = len(self.threads)
            self._notice(f"worker {address} is gone; {left} {'is' if left == 1 else 'are'} left")
        for address in self._excluded.keys() - present.keys():
            del self._excluded[address]

    def _take(self, address: str, admitted: Admitted, threads: int) -> None:
        if admitted.problem:
            self._excluded[address] = admitted.problem
            self._notice(f"worker {address} is not used: {admitted.problem}")
            return
        self.threads[address] = threads
        self.writes |= admitted.writes

    def _check_patience(self) -> None:
        if self.threads or self._admissions:
            self._waits_since = None
            return
        if self._waits_since is None:
            self._waits_since = monotonic()
            self._notice(f"{self._lack()}; waiting {PATIENCE:g} s for a suitable worker")
        if monotonic() >= self._waits_since + PATIENCE:
            raise self._none_left()

    def _lack(self) -> str:
        if not self._excluded:
            return "the scheduler has no workers for the study"
        reasons = [f"{address}: {reason}" for address, reason in self._excluded.items()]
        return f"no worker can run the study: {listing(reasons, SHOWN)}"

    def _none_left(self) -> CosimError:
        """Return the error where no worker can be used."""
        if self._excluded:
            return UsageError(f"{self._lack()}; no other worker joined within {PATIENCE:g} s")
        return RunError(
            f"the scheduler had no workers for {PATIENCE:g} s; start some ('dask worker ADDRESS') "
            "and run the study again: it continues from its dataset"
        )
