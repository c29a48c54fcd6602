"""Compiled functions of users advance as components of the package do."""

from __future__ import annotations

import ctypes
import shutil

import numpy as np
import pytest

from cosim.blocks.compiled import CompiledFunction
from cosim.core.clock import Clock
from cosim.core.contracts import Stopped
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.core.signals import Interface, Signal
from cosim.errors import UsageError
from cosim.native.build import compile_library
from cosim.testing import check_component
from tests.core.parts import integrator

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler 'cc'")

SOURCE = """
#include <stdint.h>
int32_t outputs(double *x, double t, const double *u, double *y)
{
    y[0] = x[0];
    y[1] = x[0] * x[1] + u[0];
    return t < 0.0;
}
int32_t step(double *x, double t0, double t1, double h, const double *u0, const double *u1,
             double *y)
{
    if (u0[0] > 1000.0)
        return 7;
    x[0] += h * (0.5 * (u0[0] + u1[0]) - x[0]);
    x[1] += t1 - t0;
    return outputs(x, t1, u1, y);
}
"""
INTERFACE = Interface((Signal("u"),), (Signal("x"), Signal("y")), {"x": (), "y": ("u",)})


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compiled")
    source = folder / "lag.c"
    source.write_text(SOURCE)
    target = folder / "lag.so"
    compile_library([source], target)
    return ctypes.CDLL(str(target))


def address(function):
    return ctypes.cast(function, ctypes.c_void_p).value


def lag(library, memory=(0.3, 2.0)):
    return CompiledFunction(
        INTERFACE,
        step=address(library.step),
        outputs=address(library.outputs),
        memory=memory,
        keep=library,
    )


class InPython:
    """The same arithmetic in Python."""

    interface = INTERFACE

    def initialize(self, t, u):
        self.x = [0.3, 2.0]
        return self.outputs(t, u)

    def outputs(self, t, u):
        return np.array([self.x[0], self.x[0] * self.x[1] + u[0]])

    def advance(self, t, h, u):
        rows = []
        for k in range(len(t) - 1):
            self.x[0] += h * (0.5 * (u[k, 0] + u[k + 1, 0]) - self.x[0])
            self.x[1] += t[k + 1] - t[k]
            rows.append(self.outputs(t[k + 1], u[k + 1]))
        return np.array(rows)


def test_it_keeps_the_contract_of_a_component(library):
    check_component(lambda: lag(library))


@pytest.mark.parametrize("native", [True, False])
def test_it_has_the_bits_of_its_arithmetic_in_python(library, native):
    """In a loop, in compiled code and called from Python."""
    rows = []
    for part in (lag(library), InPython()):
        graph = Graph({"a": part, "b": integrator()}, {"a.u": "b.y", "b.u": "a.y"}, native=native)
        memory = Memory()
        run(graph, Clock(0.2, 1e-3, 17), memory)
        rows.append(memory.rows("a").tobytes())
    assert rows[0] == rows[1]


def test_an_error_that_it_returns_ends_the_run(library):
    """At the step that returned it, with its number; the rows before it are kept."""
    graph = Graph({"a": lag(library, (1e5, 0.0))}, {"a.u": "a.x"})
    memory = Memory()
    with pytest.raises(
        Stopped, match=r"'a' stopped at t = 0.0 s: its compiled step returned error 7"
    ):
        run(graph, Clock(0.2, 1e-3), memory)
    assert len(memory.rows("a")) == 1


def test_only_functions_and_memory_are_taken(library):
    step = address(library.step)
    with pytest.raises(UsageError, match=r"step:.*the address.*<_FuncPtr"):
        CompiledFunction(INTERFACE, step=library.step, outputs=step)
    with pytest.raises(UsageError, match=r"outputs: .*the address.*, got 0"):
        CompiledFunction(INTERFACE, step=step, outputs=0)
    with pytest.raises(UsageError, match=r"memory: .*finite numbers.*, got "):
        lag(library, [np.nan])
