"""What reading a large log costs: to open it, to read a signal, a window, all of it.

Logs of 20 components with two signals of two doubles each, uncompressed: 2 GB, 1 GB and 2 MB. Bytes
are counted by the file object. Run with ``python tests/bench/bench_log_reading.py [FOLDER]``.
"""

from __future__ import annotations

import io
import resource
import subprocess
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np
from mcap.reader import make_reader

from cosim.core.contracts import Block
from cosim.core.recording import Plan
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.log import McapRecorder, container, open_log

COMPONENTS = 20
WIDTH = 4
STEP_NS = 1_000_000
BLOCK = 2000
STEP_BYTES = COMPONENTS * (31 + 9 * WIDTH + 16)  # of messages and their index
REPEAT = 7
WINDOW = 10_000  # rows


class CountedFile(io.FileIO):
    """A file that counts the bytes that are read from it."""

    count = 0

    def readinto(self, buffer: object) -> int:
        """Read, and count."""
        number = super().readinto(buffer)
        CountedFile.count += number
        return number


def layout() -> Layout:
    """Lay out the components."""
    interface = Interface((), (Signal("y", 2), Signal("z", 2)))
    channels = [Channel(f"c{i}", interface, WIDTH * i) for i in range(COMPONENTS)]
    return Layout(tuple(channels))


def write(path: Path, size: int) -> int:
    """Write a log of about ``size`` bytes; return the number of its steps."""
    steps = size // STEP_BYTES
    values = np.random.default_rng(1).normal(size=(BLOCK + 1, layout().width))
    with McapRecorder(path, force=True, compression="none") as recorder:
        recorder.begin(Plan(layout(), STEP_NS, {}, {}, ()))
        for start in range(0, steps, BLOCK):
            time_ns = np.arange(start, start + BLOCK + 1) * STEP_NS
            values[:, ::WIDTH] = time_ns[:, None] / 1e9
            recorder.write(Block(start, time_ns, time_ns / 1e9, 1e-3), values)
    return -(-steps // BLOCK) * BLOCK


def timed(task: Callable[[], object], repeat: int = REPEAT) -> float:
    """Return the median wall time of a task [s]."""
    seconds = []
    for _ in range(repeat):
        began = time.perf_counter()
        task()
        seconds.append(time.perf_counter() - began)
    return median(seconds)


def info(path: Path) -> None:
    """Run the whole command."""
    command = [sys.executable, "-m", "cosim", "info", str(path)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def chunks_of(path: Path, component: int) -> list:
    """Return the chunk indexes of a component, by mcap's reader."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    return [i for i in summary.chunk_indexes if component + 1 in i.message_index_offsets]


def counted(task: Callable[[], object]) -> tuple[int, object]:
    """Return how many bytes a task reads, and its result."""
    CountedFile.count = 0
    result = task()
    return CountedFile.count, result


def report_opening(large: Path, small: Path) -> None:
    """Print what it takes to open the logs, and to describe them."""
    taken, log = counted(lambda: open_log(large))
    with large.open("rb") as stream:
        stream.seek(-28, io.SEEK_END)
        summary = large.stat().st_size - int.from_bytes(stream.read(8), "little")
    print(f"opening 2 GB: {taken} bytes read, its summary has {summary}")
    ratios = []
    for _ in range(REPEAT):
        ratios.append(timed(lambda: info(large), 1) / timed(lambda: info(small), 1))
    print(f"cosim info of 2 GB: {median(ratios):.2f} x that of 2 MB")
    assert log.steps


def report_signal(large: Path, steps: int) -> None:
    """Print what it takes to read one element of one signal."""
    own = sum(index.chunk_length for index in chunks_of(large, 7))
    log = open_log(large)
    tracemalloc.start()
    taken, values = counted(lambda: log["c7.y[0]"])
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert np.array_equal(values, np.arange(steps + 1) * STEP_NS / 1e9)
    seconds = timed(lambda: open_log(large)["c7.y[0]"], 3)
    print(
        f"one signal of 2 GB: {taken / own:.3f} x the chunks of its component, "
        f"{peak / values.nbytes:.2f} x the memory of the array; {seconds:.2f} s"
    )


def report_window(path: Path, steps: int) -> None:
    """Print what it takes to read a window of one component."""
    first = steps // 2
    begin = first * STEP_NS
    end = (first + WINDOW - 1) * STEP_NS
    overlapping = 0
    for index in chunks_of(path, 7):
        if index.message_start_time <= end and index.message_end_time >= begin:
            overlapping += index.chunk_length
    log = open_log(path)
    taken, values = counted(lambda: log.window(begin / 1e9, end / 1e9)["c7.y[0]"])
    assert np.array_equal(values, np.arange(first, first + WINDOW) * STEP_NS / 1e9)
    seconds = timed(lambda: open_log(path).window(begin / 1e9, end / 1e9)["c7.y[0]"], 3)
    print(
        f"a window of {WINDOW} messages of 1 GB: {taken} bytes read, the chunks that overlap it "
        f"have {overlapping}; {seconds * 1e3:.0f} ms"
    )


def report_all(path: Path) -> None:
    """Print how fast all is read, and hashed."""
    size = path.stat().st_size
    seconds = timed(lambda: open_log(path).content_hash(), 1)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"content hash of 1 GB: {size / seconds / 1e6:.0f} MB/s, {peak:.0f} MB of memory at most")


def main() -> None:
    """Print all figures."""
    container.open_file = lambda path: io.BufferedReader(CountedFile(path))
    with tempfile.TemporaryDirectory(dir=sys.argv[1] if len(sys.argv) > 1 else None) as folder:
        large = Path(folder) / "large.mcap"
        small = Path(folder) / "small.mcap"
        steps = write(large, 2 * 10**9)
        write(small, 2 * 10**6)
        report_opening(large, small)
        report_signal(large, steps)
        steps = write(large, 10**9)
        report_window(large, steps)
        report_all(large)


if __name__ == "__main__":
    main()
