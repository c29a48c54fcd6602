"""The kernels of a scenario in the plain loop of ``kernels.c``, prepared by cosim."""

import ctypes
import time
from contextlib import ExitStack

import numpy as np
import protocol

from cosim.core.clock import seconds as seconds_of
from cosim.core.recorders import untouched_rows
from tests.bench.masters.core_systems import graph_of


class Kernel(ctypes.Structure):
    """The struct of ``kernels.c``."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("advance", "refresh", "self")),
        *((name, ctypes.c_int64) for name in ("u", "y", "first", "count")),
    )


def operations_of(stage):
    """Return what a stage does in a step, as pairs of a kind and a member."""
    if stage.is_loop:
        return stage.operations
    return [("advance", stage.member)]


def copies_of(member):
    """Return the columns of its inputs and of their sources."""
    copies = []
    for wire in member.wires:
        if wire.gain is not None or not wire.conversion.copies:
            protocol.refuse(f"'{member.name}': the plain loop only copies")
        copies += zip(range(wire.to.start, wire.to.stop), wire.source_columns, strict=True)
    return copies


class Pass:
    """Some stages in one call of the plain loop."""

    def __init__(self, library, width):
        self._library = library
        self._width = width
        self._kernels = []
        self._wires = []
        self._last_wires = []
        self._steps = []  # C has their addresses

    def add(self, stage):
        """Add the kernels of a stage, and its wires."""
        done = set()  # columns that the step has filled already
        own = set()
        for member in stage.members:
            own.update(columns_of(member))
        for kind, member in operations_of(stage):
            first = len(self._wires)
            for to, source in copies_of(member):
                late = source in own and source not in done
                self._wires.append((to, source - self._width if late else source))
                if late:
                    self._last_wires.append((to, source))
            step = member.component.native()
            self._steps.append(step)
            refresh = step.outputs if kind == "refresh" else 0
            columns = (member.inputs.start, member.outputs.start)
            count = len(self._wires) - first
            kernel = Kernel(step.function, refresh, step.address, *columns, first, count)
            self._kernels.append(kernel)
            done.update(columns_of(member))

    def prepare(self):
        """Make the arrays that C reads."""
        self._kernel_array = (Kernel * len(self._kernels))(*self._kernels)
        self._wire_array = np.array(self._wires, np.int64).reshape(-1, 2)
        self._last_array = np.array(self._last_wires, np.int64).reshape(-1, 2)

    def run(self, t, h, rows):
        """Fill all rows but the first."""
        steps = len(t) - 1
        done = self._library.kernels_run(ctypes.c_int64(steps), *self._arguments(t, h, rows))
        check(done, steps)

    def sum(self, t, h, rows, totals):
        """Fill row 0 with the last one; add up all rows behind the first in ``totals``."""
        steps = len(t) - 1
        done = self._library.kernels_sum(
            ctypes.c_int64(steps),
            ctypes.c_int64(len(rows) - 1),
            *self._arguments(t, h, rows),
            *(ctypes.c_void_p(total.ctypes.data) for total in totals),
        )
        check(done, steps)

    def _arguments(self, t, h, rows):
        return (
            ctypes.c_void_p(t.ctypes.data),
            ctypes.c_double(h),
            ctypes.c_void_p(rows.ctypes.data),
            ctypes.c_int64(self._width),
            self._kernel_array,
            ctypes.c_int64(len(self._kernels)),
            ctypes.c_void_p(self._wire_array.ctypes.data),
            ctypes.c_void_p(self._last_array.ctypes.data),
            ctypes.c_int64(len(self._last_wires)),
        )


class Whole:
    """A component outside every loop without a native step: one call for the whole run."""

    def __init__(self, member):
        self._member = member

    def prepare(self):
        """Do nothing."""

    def run(self, t, h, rows):
        """Fill all rows but the first."""
        member = self._member
        member.gather(rows, slice(1, None))
        rows[1:, member.outputs] = member.advance(t, h, rows[:, member.inputs])


def check(done, steps):
    """Refuse a run in which a kernel left a step to its component."""
    if done < steps:
        protocol.refuse(f"a kernel declined in step {done + 1}")


def load_library(task):
    """Load the loop."""
    library = ctypes.CDLL(task["library"])
    library.kernels_run.restype = ctypes.c_int64
    library.kernels_sum.restype = ctypes.c_int64
    return library


def columns_of(member):
    """Return the columns of its outputs."""
    return range(member.outputs.start, member.outputs.stop)


def passes_of(stages, library, width):
    """Return what fills the rows: stages with native steps together, others alone."""
    passes = []
    for stage in stages:
        missing = [member.name for member in stage.members if member.component.native() is None]
        if missing and stage.is_loop:
            protocol.refuse(f"no native step: {', '.join(missing)}")
        if missing:
            passes.append(Whole(stage.member))
            continue
        if not passes or not isinstance(passes[-1], Pass):
            passes.append(Pass(library, width))
        passes[-1].add(stage)
    for one in passes:
        one.prepare()
    return passes


def main():
    """Run."""
    task = protocol.task()
    steps = task["steps"]
    h = task["step_ns"] / 1e9
    library = load_library(task)
    with ExitStack() as resources:
        graph = graph_of(task["system"], steps * task["step_ns"] / 1e9, resources)
        graph.prepare(task["step_ns"])
        width = graph.layout.width
        first_row = np.zeros(width)
        graph.initialize(0.0, first_row)
        passes = passes_of(graph.stages, library, width)
        t = seconds_of(np.arange(steps + 1) * task["step_ns"])
        began = time.process_time()
        rows = untouched_rows(steps + 1, width)
        rows[0] = first_row
        for one in passes:
            one.run(t, h, rows)
        seconds = time.process_time() - began
        labels = graph.labels()
        columns = [rows[:, labels.index(signal)] for signal in task["watched"]]
    samples = []
    for sample in task["samples"]:
        samples.append((sample, [column[sample] for column in columns]))
    protocol.report(seconds, samples)


if __name__ == "__main__":
    main()
