"""A log of a day with a flush a second: what the first flushes cost, and what the last ones do.

Run with ``python -m tests.bench.bench_day``, or with the number of seconds. 20 components of four
signals have 10 rows a second; nothing waits. The size is that of the same rows written at once.
"""

from __future__ import annotations

import io
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

import numpy as np

from cosim.core.recorders import EndOfRun
from cosim.core.recording import Plan
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.log.background import RunContent
from cosim.log.store import LogStore
from tests.log.direct import open_store

DAY = 86_400  # s
RATE = 10  # rows a second
COMPARED = 1000  # flushes
COMPONENTS = 20
SIZE = 4


def plan() -> Plan:
    """Return the plan of the run."""
    channels = []
    for number in range(COMPONENTS):
        interface = Interface((), (Signal("y", SIZE),))
        channels.append(Channel(f"c{number}", interface, number * SIZE))
    return Plan(Layout(tuple(channels)), 10**9 // RATE, {}, {}, ())


def rows(start: int, stop: int) -> RunContent:
    """Return smooth rows with a little noise."""
    steps = np.arange(start, stop)
    noise = np.random.default_rng(start).normal(size=(stop - start, COMPONENTS * SIZE))
    values = np.sin(steps[:, None] * 1e-3 * np.arange(1, COMPONENTS * SIZE + 1)) + 1e-9 * noise
    return RunContent(steps, steps * (10**9 // RATE), values)


def write(path: Path, seconds: int, *, per_flush: int) -> list[float]:
    """Write a log of some rows a flush; return the times that the flushes took [s]."""
    store: LogStore = open_store(io.FileIO(path, "x+"), plan(), compression="zstd")
    durations = []
    for start in range(0, seconds * RATE, per_flush):
        content = rows(start, min(start + per_flush, seconds * RATE))
        begun = time.perf_counter()
        store.add(content)
        durations.append(time.perf_counter() - begun)
    store.close(EndOfRun("complete", ""), {})
    return durations


def main() -> None:
    """Print the figures."""
    seconds = int(sys.argv[1]) if len(sys.argv) > 1 else DAY
    with tempfile.TemporaryDirectory() as folder:
        durations = write(Path(folder, "live.mcap"), seconds, per_flush=RATE)
        write(Path(folder, "whole.mcap"), seconds, per_flush=1000 * RATE)
        live = Path(folder, "live.mcap").stat().st_size
        whole = Path(folder, "whole.mcap").stat().st_size
    first = median(durations[:COMPARED])
    last = median(durations[-COMPARED:])
    print(f"first flushes {1e3 * first:.2f} ms, last {1e3 * last:.2f} ms: {last / first:.2f}")
    print(f"file {live / 1e6:.1f} MB, written at once {whole / 1e6:.1f} MB: {live / whole:.3f}")


if __name__ == "__main__":
    main()
