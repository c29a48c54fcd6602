"""What a study's dataset costs: a million members, added one by one, with synthetic outcomes.

Processor time of ``add`` beside that of the least that keeps an outcome at all (its JSON, written
to a file in one call), both in one process and in turn; the resident memory while members are
added, after the first tenth and at the end; the number and size of the parts; opening it again,
checking it against its design, and reading all of it. Run with
``python tests/bench/bench_study_dataset.py [MEMBERS [PART_SIZE]]``.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

import cosim
from cosim.studies.contracts import MemberOutcome, StudyMember
from cosim.studies.dataset.columns import metric_column, parameter_column
from cosim.studies.dataset.identity import PART_SIZE, StudyIdentity
from cosim.studies.dataset.study_dataset import StudyDataset

MEMBERS = 1_000_000
CHUNK = 10_000  # members that are made, and added, at a time
PARAMETERS = ["observer.filter_rate", "plant.x_a0[0]", "delta.terms[0].theta"]
METRICS = ["error", "largest", "theta", "settling", "late"]


class Drawn:
    """A design of random numbers, the same for every part of it that is asked for."""

    def column(self, name: str, begin: int = 0, end: int = 0) -> np.ndarray:
        """Return the values of members."""
        place = PARAMETERS.index(name)
        stream = np.random.PCG64(place)
        stream.advance(begin)
        return np.random.Generator(stream).random(end - begin)


def members_of(begin: int, end: int) -> list[tuple[StudyMember, MemberOutcome]]:
    """Return members and their outcomes; every tenth has failed."""
    values = np.column_stack([Drawn().column(name, begin, end) for name in PARAMETERS]).tolist()
    pairs = []
    for number, row in enumerate(values, begin):
        member = StudyMember(number, dict(zip(PARAMETERS, row, strict=True)))
        if number % 10 == 7:
            outcome = MemberOutcome(number, "failed", "plant.y became NaN at 1.5 s", 1500)
        else:
            metrics = {name: row[0] * place for place, name in enumerate(METRICS, 1)}
            outcome = MemberOutcome(number, "complete", "", 4000, metrics, row[1], "", "1234@host")
        pairs.append((member, outcome))
    return pairs


def resident() -> float:
    """Return the memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


@contextmanager
def timed(name: str) -> Iterator[None]:
    """Print wall and processor time of what is inside."""
    wall = time.perf_counter()
    cpu = time.process_time()
    yield
    spent = time.process_time() - cpu
    print(f"{name:42} {time.perf_counter() - wall:8.2f} s, {spent:8.2f} s of processors")


def added(place: Path, count: int, identity: StudyIdentity) -> None:
    """Add all members; print time and memory."""
    spent = 0.0
    baseline = 0.0
    memory = []
    least = os.open(place.parent / "least.jsonl", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    with StudyDataset.open_or_create(place, identity) as dataset:
        for begin in range(0, count, CHUNK):
            pairs = members_of(begin, min(begin + CHUNK, count))
            began = time.process_time()
            for member, outcome in pairs:
                dataset.add(member, outcome)
            between = time.process_time()
            for member, outcome in pairs:
                text = json.dumps([member.number, *member.set.values(), *outcome.metrics.values()])
                os.write(least, text.encode())
            baseline += time.process_time() - between
            spent += between - began
            memory.append(resident())
    os.close(least)
    print(f"{'add, of a member':42} {spent / count * 1e6:8.2f} us of processors")
    print(f"{'JSON and one write, of a member':42} {baseline / count * 1e6:8.2f} us of processors")
    tenth = memory[len(memory) // 10]
    print(f"{'memory after a tenth, at the end':42} {tenth:8.1f} MB, {memory[-1]:.1f} MB")


def main() -> None:
    """Write, check and read a dataset."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else MEMBERS
    size = int(sys.argv[2]) if len(sys.argv) > 2 else PART_SIZE
    columns = [parameter_column(name, np.empty(0)) for name in PARAMETERS]
    columns += [metric_column(name) for name in METRICS]
    identity = StudyIdentity("bench", "", {}, tuple(columns), count, size)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "x"
        with timed(f"{count} members, parts of {size}"):
            added(place, count, identity)
        files = [path.stat().st_size for path in (place / "parts").iterdir()]
        print(f"{'parts':42} {len(files):8} files, {sum(files) / 1e6:.1f} MB")
        with timed("open for writing, with its design"):
            StudyDataset.open_or_create(place, identity, design=Drawn()).close()
        with timed("open for reading"):
            study = cosim.open_study(place)
        with timed("one column"):
            study.table(["error"])
        with timed("all columns"):
            study.table()
        with timed("failures"):
            study.failures  # noqa: B018


if __name__ == "__main__":
    main()
