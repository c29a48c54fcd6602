"""What a communication step costs: cosim, other masters, and a C program of the same arithmetic.

Run with ``python tests/bench/bench_masters.py``; ``--help`` shows how to make it shorter. Every
process runs one system for one number of steps; the time of a step is the slope between two
numbers, so that start-up drops out. It is the processor time of all threads. Each contender is
measured beside a floor, both in shuffled order: the ratio is the median of those of the pairs. The
floor of FMUs is a loop in C over their functions, that of other cases the same arithmetic without a
master; the table names it. It keeps the inputs u and the outputs y of every step in memory, as the
others do unless the table says otherwise. The error is the largest distance of the outputs from the
closed form in the first 20 s.

All run on one core: the threads of some masters would wait for each other, and waiting takes
processor time, too.
"""

from __future__ import annotations

import argparse
import math
import os
import random
import statistics
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from rich.box import SIMPLE
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cosim.log.metadata import environment
from tests.bench.masters.cases import CONTENDERS, FLOOR, Case, FmuCase
from tests.bench.masters.core_cases import core_cases
from tests.bench.masters.environments import Result, Unavailable, run
from tests.bench.masters.systems import chain, ring

STEPS = 500_000  # of the longer run
SHORTER = 5  # times shorter is the other run
SECONDS = 3.0  # that the longer run of a slow master takes, about
CALIBRATION = (200, 1000)  # steps of two runs
FEWEST = 1000  # steps of the longer run
ROUNDS = 9
PEER_ROUNDS = 5
SEED = 1
WIDTH = 120  # of the table where there is no terminal


@dataclass
class Pairing:
    """A contender in a case, and what was measured of it so far."""

    case: Case
    contender: str
    steps: int = STEPS
    times: list[float] = field(default_factory=list)  # of a step [s]
    floors: list[float] = field(default_factory=list)  # of the floor beside it [s]
    error: float = 0.0
    same_bits: bool = False  # as the floor, at every sample
    reason: str = ""  # why it was not measured
    floor_reason: str = ""  # why the floor was not

    def calibrate(self, most: int, seconds: float) -> None:
        """Choose the number of steps; find out whether the contender can run the case at all."""
        if self.case.fixed_steps:
            self.steps = self.case.fixed_steps
            return
        try:
            times = []
            for steps in CALIBRATION:
                times.append(run(self.case.command(self.contender, steps)).seconds)
        except Unavailable as error:
            self.reason = str(error)
            return
        short, long = times
        step = max(long - short, 0.1 * long) / (CALIBRATION[1] - CALIBRATION[0])
        self.steps = min(most, max(FEWEST, int(seconds / max(step, 1e-9))))

    def measure(self, steps: int) -> None:
        """Measure the contender and the floor, which gets ``steps``, side by side."""
        sides = {self.contender: self.steps, FLOOR: self.case.fixed_steps or steps}
        measured: dict[str, tuple[float, Result]] = {}
        for contender in random.sample(list(sides), len(sides)):
            try:
                measured[contender] = self._slope(contender, sides[contender])
            except Unavailable as error:
                if contender == self.contender:
                    self.reason = str(error)
                    return
                self.floor_reason = str(error)
        time, result = measured[self.contender]
        self.times.append(time)
        self.error = self.case.error(result)
        if FLOOR in measured:
            floor_time, floor_result = measured[FLOOR]
            self.floors.append(floor_time)
            self.same_bits = _agree(result, floor_result)

    def _slope(self, contender: str, most: int) -> tuple[float, Result]:
        """Return the time of a step [s], and the result of the longer run."""
        least = most // SHORTER
        lengths = [least, most]
        random.shuffle(lengths)
        results = {}
        for steps in lengths:
            results[steps] = run(self.case.command(contender, steps))
        slope = (results[most].seconds - results[least].seconds) / (most - least)
        return slope, results[most]

    @property
    def ratio(self) -> float:
        """The median of the ratios of the pairs."""
        return statistics.median(
            time / floor for time, floor in zip(self.times, self.floors, strict=True)
        )


def _agree(result: Result, floor: Result) -> bool:
    """Return whether the outputs of both are the same at all steps that both show."""
    outputs = dict(floor.samples)
    common = [(row, outputs[step]) for step, row in result.samples if step in outputs]
    return bool(common) and all(row == expected for row, expected in common)


def cases() -> list[Case]:
    """Return all cases."""
    every: list[Case] = []
    for system in (ring(3), chain(20)):
        every += [
            FmuCase(system, "2", "cs"),
            FmuCase(system, "3", "cs"),
            FmuCase(system, "2", "rk4"),
            FmuCase(system, "2", "RK45"),
        ]
    return every + core_cases()


def table(pairings: Iterable[Pairing]) -> Table:
    """Return the result."""
    shown = Table("case", "contender", "keeps", box=SIMPLE)
    shown.title = f"time of a communication step, {environment()['processor']}"
    for heading in ("us a step", "beside", "us a step", "ratio", "error", "bits", "steps"):
        shown.add_column(heading, justify="right")
    last = ""
    for pairing in pairings:
        if pairing.reason:
            continue
        name = pairing.case.name
        floors = pairing.floors
        cells = (
            f"{1e6 * statistics.median(pairing.times):.3f}",
            pairing.case.floor_name,
            f"{1e6 * statistics.median(floors):.3f}" if floors else "-",
            f"{pairing.ratio:.2f}" if floors else "-",
            "-" if math.isnan(pairing.error) else f"{pairing.error:.1e}",
            "same" if pairing.same_bits else "",
            str(pairing.steps),
        )
        keeps = pairing.case.keeps(pairing.contender)
        shown.add_row("" if name == last else name, pairing.contender, keeps, *cells)
        last = name
    return shown


def not_measured(pairings: Iterable[Pairing]) -> Table:
    """Return who could not run which cases, and why."""
    cases_by_reason: dict[tuple[str, str], list[str]] = {}
    for pairing in pairings:
        for contender, reason in (
            (pairing.contender, pairing.reason),
            (FLOOR, pairing.floor_reason),
        ):
            if reason:
                cases_by_reason.setdefault((contender, reason), []).append(pairing.case.name)
    shown = Table("contender", "reason", "cases", title="not measured", box=SIMPLE)
    for (contender, reason), names in cases_by_reason.items():
        shown.add_row(contender, escape(reason), ", ".join(names))
    return shown


def arguments(given: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the options."""
    names = [case.name for case in cases()]
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0] if __doc__ else None,
        epilog=f"contenders: {', '.join(CONTENDERS)}; cases: {', '.join(names)}",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--steps", type=_steps, default=STEPS, help="of the longer of two runs")
    parser.add_argument("--rounds", type=_positive, default=ROUNDS, help="pairs of cosim and C")
    parser.add_argument(
        "--peer-rounds",
        type=_positive,
        default=PEER_ROUNDS,
        help="pairs of others and C, no more than those of cosim",
    )
    parser.add_argument("--seconds", type=float, default=SECONDS, help="of a slow master's run")
    parser.add_argument("--seed", type=int, default=SEED, help="of the order of the pairs")
    parser.add_argument("--peers", default=",".join(CONTENDERS), help="contenders, with commas")
    parser.add_argument("--cases", default="", help="parts of names of cases, with commas")
    options = parser.parse_args(given)
    options.peers = options.peers.split(",")
    for name in options.peers:
        if name not in CONTENDERS:
            parser.error(f"--peers: found {name!r}; there is: {', '.join(CONTENDERS)}")
    options.cases = options.cases.split(",")
    for part in options.cases:
        if not any(part in name for name in names):
            parser.error(
                f"--cases: found {part!r}, which is in no name; there is: {', '.join(names)}"
            )
    return options


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"found {number}; needed a whole number from 1 on")
    return number


def _steps(text: str) -> int:
    number = int(text)
    if number < FEWEST:
        raise argparse.ArgumentTypeError(f"found {number}; needed at least {FEWEST}")
    return number


def pairings_of(selected: Iterable[Case], contenders: list[str]) -> list[Pairing]:
    """Return what is to be measured, in the order of the table."""
    pairings = []
    for case in selected:
        for contender in case.contenders:
            if contender in contenders:
                pairings.append(Pairing(case, contender))
    return pairings


def measure(pairings: Sequence[Pairing], options: argparse.Namespace, console: Console) -> None:
    """Measure all pairings, the rounds of each in turn with those of the others."""
    peer_rounds = min(options.peer_rounds, options.rounds)
    for pairing in pairings:
        console.print(f"calibrating {pairing.case.name}: {pairing.contender}", style="dim")
        pairing.calibrate(options.steps, options.seconds)
    for number in range(options.rounds):
        console.print(f"round {number + 1} of {options.rounds}", style="dim")
        for pairing in random.sample(pairings, len(pairings)):
            takes_part = number < peer_rounds or pairing.contender == "cosim"
            if takes_part and not pairing.reason:
                pairing.measure(options.steps)


def main() -> None:
    """Measure, and print the table."""
    options = arguments()
    random.seed(options.seed)
    if sys.platform == "linux":  # the processes inherit it
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    selected = [case for case in cases() if any(part in case.name for part in options.cases)]
    with tempfile.TemporaryDirectory() as folder:
        for case in selected:
            case.build(Path(folder))
        pairings = pairings_of(selected, options.peers)
        measure(pairings, options, Console(stderr=True))
    console = Console(width=None if sys.stdout.isatty() else WIDTH)
    console.print(table(pairings))
    missing = not_measured(pairings)
    if missing.row_count:
        console.print(missing)


if __name__ == "__main__":
    main()
