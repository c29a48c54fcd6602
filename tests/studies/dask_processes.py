"""A scheduler of dask and its workers, as processes of their own on loopback."""

import json
import os
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[2]
LIMIT = 60.0  # s


class ClusterProcesses:
    """A scheduler and the workers that were started; all are ended by :meth:`end`."""

    def __init__(self, folder, changes):
        self.folder = folder
        self._changes = changes
        self.workers = []
        self._file = folder / "scheduler.json"
        self.scheduler = self._start(
            "dask_scheduler",
            "--host",
            "127.0.0.1",
            "--port",
            "0",
            "--no-dashboard",
            "--dashboard-address",  # for others: by itself it listens to all, on one port
            "127.0.0.1:0",
            "--scheduler-file",
            self._file,
            "--no-jupyter",
        )
        self.address = self._address()

    def start_worker(self, **changes):
        """Start a worker of one thread; changes are of its environment, over those of all."""
        number = len(self.workers)
        folder = self.folder / f"worker-{number}"
        folder.mkdir()
        self.workers.append(
            self._start(
                "dask_worker",
                self.address,
                "--no-nanny",
                "--nthreads",
                "1",
                "--no-dashboard",
                "--host",
                "127.0.0.1",
                "--local-directory",
                folder,
                folder=folder,
                changes=changes,
            )
        )
        return self.workers[-1]

    def end(self):
        """End all, by their pids."""
        for process in [*self.workers, self.scheduler]:
            process.kill()
            process.wait(LIMIT)

    def _start(self, program, *options, folder=None, changes=None):
        own = {"PYTHONPATH": str(ROOT), **self._changes, **(changes or {})}
        with (self.folder / f"{program}.txt").open("ab") as output:
            return subprocess.Popen(
                [sys.executable, "-m", f"distributed.cli.{program}", *map(str, options)],
                cwd=folder or self.folder,
                env={**os.environ, **own},
                stdout=output,
                stderr=output,
                stdin=subprocess.DEVNULL,
            )

    def _address(self):
        until = time.monotonic() + LIMIT
        while time.monotonic() < until:
            try:
                return json.loads(self._file.read_text())["address"]
            except (OSError, ValueError):
                time.sleep(0.05)
        raise AssertionError("the scheduler did not start")


@contextmanager
def cluster(folder, workers=2, **changes):
    """Yield a scheduler with workers that are there; changes are of their environment."""
    from distributed import Client

    processes = ClusterProcesses(folder, changes)
    try:
        for _ in range(workers):
            processes.start_worker()
        if workers:
            with Client(processes.address, timeout=LIMIT, set_as_default=False) as client:
                client.wait_for_workers(workers, timeout=LIMIT)
        yield processes
    finally:
        processes.end()
