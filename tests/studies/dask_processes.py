"""A scheduler of dask and its workers, as processes of their own on loopback."""

import json
import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

from tests.studies.deeds import wait_until

ROOT = Path(__file__).parents[2]
LIMIT = 60.0  # s


class ClusterProcesses:
    """A scheduler and the workers that were started; changes are of the environment of all."""

    def __init__(self, folder, changes):
        self.folder = folder
        self._changes = changes
        self.workers = []
        file = folder / "scheduler.json"
        # by itself its dashboard listens to all, on one port
        options = ["--no-jupyter", "--dashboard-address", "127.0.0.1:0", "--port", "0"]
        self.scheduler = self._start("scheduler", folder, {}, "--scheduler-file", file, *options)
        wait_until(lambda: file.exists() and file.read_text().endswith("}"))
        self.address = json.loads(file.read_text())["address"]

    def start_worker(self, **changes):
        """Start a worker of one thread; changes are of its environment, over those of all."""
        folder = self.folder / f"worker-{len(self.workers)}"
        folder.mkdir()
        options = ["--no-nanny", "--nthreads", "1", "--local-directory", folder]
        self.workers.append(self._start("worker", folder, changes, self.address, *options))

    def _start(self, program, folder, changes, *options):
        arguments = ["--host", "127.0.0.1", "--no-dashboard", *map(str, options)]
        return subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.dask_{program}", *arguments],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(ROOT), **self._changes, **changes},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )


@contextmanager
def cluster(folder, workers=2, **changes):
    """Yield a scheduler with workers that are there; changes are of their environment."""
    from distributed import Client

    folder.mkdir(exist_ok=True)
    processes = ClusterProcesses(folder, changes)
    try:
        for _ in range(workers):
            processes.start_worker()
        with Client(processes.address, timeout=LIMIT, set_as_default=False) as client:
            client.wait_for_workers(workers, timeout=LIMIT)
        yield processes
    finally:
        for process in [*processes.workers, processes.scheduler]:
            process.kill()
            process.wait(LIMIT)
