"""What the coupling of two FMUs costs, beside a C loop over their functions (Jacobi).

Run with ``python tests/bench/bench_coupling.py [ROUNDS]``. Two lags that drive each other: x1' =
-0.9 x1 + 0.5 x2, x2' = -x2 - 10 x1, as FMUs that get the mean of their inputs, and as FMUs that
get their slopes. Each contender is measured beside the C loop, both in turns, in memory that is
touched first there; the ratio is the median of the pairs, the time of a step the slope between two
numbers of steps. The error is the largest one of the states after 1 s at 1 ms, against the matrix
exponential.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from ctypes import CDLL, c_char_p, c_double, c_long, c_void_p
from functools import partial
from pathlib import Path
from time import process_time

import numpy as np
import scipy.linalg

sys.path.insert(0, str(Path(__file__).parents[2]))

from cosim.core.clock import Clock
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.core.recorders import Memory, untouched_rows
from cosim.core.structure.order import Coupling
from cosim.fmi.component import Fmu, load
from cosim.fmi.options import FmuOptions
from cosim.fmi.platforms import SUFFIX
from cosim.native import build
from cosim.native.library import pointer
from tests.fmi import small
from tests.fmi.compiled import HEADERS

VALUES = (
    {"x": 1.0, "A": -0.9, "B": 0.5, "C": 0.0, "D": 0.0},
    {"x": 1.0, "A": -1.0, "B": -10.0, "C": 0.0, "D": 0.0},
)
CAN = {"means": ("state",), "slopes": ("state", "slopes")}
STEP = 1e-3
AFTER_1_S = round(1.0 / STEP)
STEPS = (100_000, 500_000)
HERE = Path(__file__).parent
COUPLINGS: tuple[Coupling, ...] = ("jacobi", "gauss-seidel", "newton")


def compiled_loop(folder: Path, fmu: Path) -> Callable[[int], np.ndarray]:
    """Return the C loop: from a number of steps to its rows, shape (steps + 1, 2, 3)."""
    library = folder / "jacobi.so"
    build.compile_library([HERE / "jacobi.c"], library, [f"-I{HEADERS}"])
    jacobi = CDLL(str(library)).jacobi
    jacobi.argtypes = (c_void_p, c_void_p, c_long, c_double, c_void_p)
    binary = str(fmu.with_suffix(SUFFIX)).encode()
    paths = (c_char_p * 2)(binary, binary)
    numbers = np.array([list(values.values()) for values in VALUES])

    def rows(steps: int) -> np.ndarray:
        result = untouched_rows(steps + 1, 6).reshape(-1, 2, 3)
        result[0, :, 0] = 1.0
        if jacobi(paths, pointer(numbers), steps, STEP, pointer(result)):
            raise SystemExit("the C loop failed")
        return result

    return rows


def solution() -> np.ndarray:
    """Return (x1, x2) after 1 s."""
    one, two = VALUES
    rows = [[one["A"], one["B"]], [two["B"], two["A"]]]
    return scipy.linalg.expm(np.array(rows)).sum(axis=1)


def run_cosim(fmus: list[Fmu], coupling: Coupling, steps: int) -> Memory:
    """Run the pair; return its rows."""
    components = {"one": fmus[0].component, "two": fmus[1].component}
    connections = {"one.u": "two.x", "two.u": "one.x"}
    memory = Memory()
    run(Graph(components, connections, coupling=coupling), Clock(steps * STEP, STEP), memory)
    return memory


def step_time(call: Callable[[int], object]) -> float:
    """Return the processor time of a step [s]."""
    times = []
    for steps in STEPS:
        began = process_time()
        call(steps)
        times.append(process_time() - began)
    short, long = times
    return (long - short) / (STEPS[1] - STEPS[0])


def main(rounds: int) -> None:
    """Measure and print."""
    with tempfile.TemporaryDirectory() as name, ExitStack() as opened:
        folder = Path(name)
        fmu = small.compiled(folder)
        loop = compiled_loop(folder, fmu)
        error = abs(loop(AFTER_1_S)[-1, :, 1] - solution()).max()
        print(f"{'C, jacobi':30} {step_time(loop) * 1e6:8.3f} us   error {error:.2e}")
        for able, can in CAN.items():
            path = small.able(fmu, folder / f"{able}.fmu", *can, D=0.0)
            for coupling in COUPLINGS:
                options = [FmuOptions(start=values) for values in VALUES]
                fmus = [opened.enter_context(load(path, option)) for option in options]
                stepped = partial(run_cosim, fmus, coupling)
                rows = stepped(AFTER_1_S)
                found = np.array([rows["one.x"][-1], rows["two.x"][-1]])
                error = abs(found - solution()).max()
                own, ratio = compared(stepped, loop, rounds)
                name = f"cosim, {coupling}, {able}"
                print(f"{name:30} {own * 1e6:8.3f} us   error {error:.2e}   {ratio:.2f} x C")


def compared(
    contender: Callable[[int], object], floor: Callable[[int], object], rounds: int
) -> tuple[float, float]:
    """Return the time of a step of the contender [s], and in units of the floor's."""
    pairs = [(step_time(contender), step_time(floor)) for _ in range(rounds)]
    own = statistics.median(time for time, _ in pairs)
    return own, statistics.median(time / beside for time, beside in pairs)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 5)
