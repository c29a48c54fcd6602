"""Hold any component to the contract of :class:`cosim.core.contracts.Component`.

The master, the loops and the verification of a recorded run rest on these laws; a component that keeps them can be put anywhere
in a graph. Everything is compared bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Protocol

import numpy as np

from cosim.arrays import NAN, Mask, Matrix, Vector
from cosim.core.clock import nanoseconds, seconds
from cosim.core.contracts import Component, Rollback, State, prepare


class RollbackComponent(Component, Rollback[State], Protocol[State]):
    """A component that can go back."""


def check_component(
    make: Callable[[], Component],
    *,
    inputs: Matrix | None = None,
    h: float = 1e-3,
    steps: int = 30,
    seed: int = 0,
) -> None:
    """Check that a component keeps the contract.

    Parameters
    ----------
    make : callable
        Gives a new component, the same every time.
    inputs : Matrix, shape (steps+1, n_u), optional
        Inputs at the communication points, which the component must be able to run through; left out: seeded random numbers.
    h : float
        Communication step [s].
    steps : int
        Number of communication steps; given by ``inputs`` where there are any.
    seed : int
        Of the random numbers.

    Raises
    ------
    AssertionError
        At the first law that is broken, with the signal, the time and the values.

    Examples
    --------
    >>> from cosim.blocks.dynamics import Delay
    >>> check_component(lambda: Delay(3))
    """
    bench = _Bench(make, inputs, h, steps, seed)
    for held in bench.masks():
        component, first = bench.start(held)
        expected = np.vstack([first, bench.advance(component, 0, bench.steps)])
        _check_values(bench, expected)
        _check_repeatable(bench, held, expected)
        _check_blocks(bench, held, expected)
        _check_ownership(bench, held, expected)
        _check_feedthrough(bench, held, expected)
        _check_start(bench, held, expected[0])
        if held.any():
            _check_late_inputs(bench, held, expected)


def check_rollback(
    make: Callable[[], RollbackComponent[State]],
    *,
    inputs: Matrix | None = None,
    h: float = 1e-3,
    steps: int = 30,
    seed: int = 0,
) -> None:
    """Check that ``restore(save())`` is the identity, straight after ``initialize`` and later, as often as asked.

    Parameters are those of :func:`check_component`.

    Raises
    ------
    AssertionError
        Where a run from a restored state differs.
    """
    bench = _Bench(make, inputs, h, steps, seed)
    for k in (0, bench.steps // 2):
        component = make()
        prepare(component, bench.h, bench.masks()[0], {})
        component.initialize(float(bench.t[0]), bench.u[0].copy())
        bench.advance(component, 0, k)
        state, now = component.save(), bench.outputs(component, k, bench.u[k])
        component.save()
        bench.compare("save changes nothing", bench.outputs(component, k, bench.u[k]), now, k)
        expected = bench.advance(component, k, bench.steps)
        for _ in range(2):
            component.restore(state)
            bench.compare(
                "restore goes back to the outputs at save",
                bench.outputs(component, k, bench.u[k]),
                now,
                k,
            )
            rows = bench.advance(component, k, bench.steps)
            bench.compare(
                "a restored component goes on as it did after save", rows, expected, k + 1
            )


def _check_values(bench: _Bench, rows: Matrix) -> None:
    """Require that only optional outputs are NaN, with the bits of the one NaN, and none is infinite."""
    optional = np.array(
        [s.optional for s in bench.interface.outputs for _ in range(s.size)], dtype=np.bool_
    )
    no_value = (rows.view(np.uint64) == np.array(NAN).view(np.uint64)) & optional
    law = "a value is finite, or cosim.arrays.NAN in an optional output"
    bench.compare(law, rows, np.where(np.isfinite(rows) | no_value, rows, 0.0))


def _check_repeatable(bench: _Bench, held: Mask, expected: Matrix) -> None:
    """Another component, a recorded design, a second start: the same run."""
    component = bench.make()
    design = prepare(component, bench.h, held, {})
    replayed = bench.make()
    prepare(replayed, bench.h, held, {name: np.array(array) for name, array in design.items()})
    laws = {
        "a second component repeats the run": component,
        "a component takes its recorded design": replayed,
    }
    for law, other in laws.items():
        first = other.initialize(float(bench.t[0]), bench.u[0].copy())
        bench.compare(law, np.vstack([first, bench.advance(other, 0, bench.steps)]), expected)
    component.initialize(float(bench.t[0]), bench.perturbed[0].copy())
    again = component.initialize(float(bench.t[0]), bench.u[0].copy())
    rows = np.vstack([again, bench.advance(component, 0, bench.steps)])
    bench.compare(
        "initialize forgets the past, and an earlier initialize with other inputs", rows, expected
    )


def _check_blocks(bench: _Bench, held: Mask, expected: Matrix) -> None:
    """Require that the size of the blocks does not matter, nor do calls of outputs, which agree with the last row."""
    for size in (1, 7):
        component, first = bench.start(held)
        edges = [*range(0, bench.steps, size), bench.steps]
        rows = np.vstack(
            [first, *(bench.advance(component, begin, end) for begin, end in pairwise(edges))]
        )
        bench.compare(f"blocks of {size} give the bits of one block", rows, expected)
    component, row = bench.start(held)
    for k in range(bench.steps + 1):
        bench.outputs(component, k, bench.perturbed[k])
        bench.compare(
            "outputs gives the last row again", bench.outputs(component, k, bench.u[k]), row, k
        )
        if k < bench.steps:
            row = bench.advance(component, k, k + 1)
            bench.compare("outputs changes nothing", row, expected[k + 1], k + 1)


def _check_ownership(bench: _Bench, held: Mask, expected: Matrix) -> None:
    """Require that inputs are not written to and not kept, rows may be strided, results do not alias the state."""
    component, _ = bench.start(held)
    wide = np.zeros((bench.steps + 1, bench.n_u + 3))
    for begin in range(0, bench.steps, 3):
        end = min(begin + 3, bench.steps)
        u, t = wide[begin : end + 1, 2 : 2 + bench.n_u], bench.t[begin : end + 1].copy()
        u[:] = bench.u[begin : end + 1]
        now = component.outputs(float(t[0]), u[0])
        rows = component.advance(t, bench.h, u)
        if not (
            np.array_equal(u, bench.u[begin : end + 1], equal_nan=True)
            and np.array_equal(t, bench.t[begin : end + 1])
        ):
            raise AssertionError(
                f"advance does not write to its arguments: they changed in the block from t = {t[0]} s"
            )
        law = "arguments and results of earlier calls are no part of the state, rows of inputs may be strided"
        bench.compare(law, rows, expected[begin + 1 : end + 1], begin + 1)
        for array in (u, t, rows, now):
            if array.flags.writeable:
                array[:] = 1e3  # whoever keeps it will differ in the next block


def _check_feedthrough(bench: _Bench, held: Mask, expected: Matrix) -> None:
    """Require that outputs ignore, at the instant reached, what is not declared to feed through."""
    component, _ = bench.start(held)
    for k in range(bench.steps + 1):
        bench.advance(component, max(k - 1, 0), k)
        for name, columns in bench.interface.input_columns().items():
            u = bench.u[k].copy()
            u[columns] = bench.perturbed[k, columns]
            law = f"outputs ignores {name!r}, which is not declared to feed through"
            bench.compare(
                law,
                np.where(bench.fed_by(name), expected[k], bench.outputs(component, k, u)),
                expected[k],
                k,
            )


def _check_start(bench: _Bench, held: Mask, first: Vector) -> None:
    """Require that outputs ignore at the start what they are not declared to depend on there."""
    for name, columns in bench.interface.input_columns().items():
        component, u = bench.make(), bench.u[0].copy()
        u[columns] = bench.perturbed[0, columns]
        prepare(component, bench.h, held, {})
        y = component.initialize(float(bench.t[0]), u)
        law = f"initialize ignores {name!r}, which is not declared to count at the start"
        bench.compare(law, np.where(bench.fed_at_start(name), first, y), first)


def _check_late_inputs(bench: _Bench, held: Mask, expected: Matrix) -> None:
    """Require that a held input may be wrong at the end of a step: the state ignores it, outputs repairs the rest."""
    component, _ = bench.start(held)
    fed = np.zeros(bench.n_y, np.bool_)
    for name, columns in bench.interface.input_columns().items():
        fed |= bench.fed_by(name) & held[columns].any()
    for k in range(1, bench.steps + 1):
        end = np.where(held, bench.perturbed[k], bench.u[k])
        row = component.advance(bench.t[k - 1 : k + 1], bench.h, np.vstack([bench.u[k - 1], end]))[
            0
        ]
        law = "advance ignores a held input at the end of the step where it is not declared to feed through"
        bench.compare(law, np.where(fed, expected[k], row), expected[k], k)
        law = "the state ignores a held input at the end of the step"
        bench.compare(law, bench.outputs(component, k, bench.u[k]), expected[k], k)


class _Bench:
    """A component's times and inputs, and other inputs to put in their place."""

    def __init__(
        self, make: Callable[[], Component], inputs: Matrix | None, h: float, steps: int, seed: int
    ) -> None:
        self.make, self.interface = make, make().interface
        self.n_u, self.n_y = self.interface.n_u, self.interface.n_y
        if inputs is not None and (inputs.shape[1:] != (self.n_u,) or len(inputs) < 2):
            raise AssertionError(
                f"inputs have shape {inputs.shape}, needed (steps + 1, {self.n_u}) with at least one step"
            )
        self.steps, step_ns = steps if inputs is None else len(inputs) - 1, nanoseconds(h)
        self.h, self.t = step_ns / 1e9, seconds(np.arange(self.steps + 1, dtype=np.int64) * step_ns)
        kinds = np.array(
            [signal.kind for signal in self.interface.inputs for _ in range(signal.size)]
        )
        noise = np.random.default_rng(seed).standard_normal((self.steps + 1, self.n_u))
        drawn = np.where(
            kinds == "boolean",
            noise > 0.0,
            np.where(kinds == "integer", np.round(5.0 * noise), noise),
        )
        self.u = np.array(drawn if inputs is None else inputs, dtype=np.float64)
        other = np.where(kinds == "integer", self.u + 1.0, self.u + 1.0 + noise**2)
        self.perturbed = np.where(kinds == "boolean", 1.0 - self.u, other)

    def masks(self) -> list[Mask]:
        """Put straight lines everywhere, hold every input, hold every other one."""
        sizes = [signal.size for signal in self.interface.inputs]
        masks = [
            np.zeros(len(sizes), np.bool_),
            np.ones(len(sizes), np.bool_),
            np.arange(len(sizes)) % 2 == 0,
        ]
        return [np.repeat(mask, sizes) for mask in masks[: 1 + min(len(sizes), 2)]]

    def start(self, held: Mask) -> tuple[Component, Vector]:
        """Give a component at the start, and its outputs there."""
        component = self.make()
        prepare(component, self.h, held, {})
        first = component.initialize(float(self.t[0]), self.u[0].copy())
        return component, self._sized("initialize", first, (self.n_y,))

    def advance(self, component: Component, begin: int, end: int) -> Matrix:
        """Advance from row ``begin`` to row ``end`` in one call."""
        if begin == end:
            return np.empty((0, self.n_y))
        rows = component.advance(self.t[begin : end + 1], self.h, self.u[begin : end + 1].copy())
        return self._sized("advance", rows, (end - begin, self.n_y))

    def outputs(self, component: Component, k: int, u: Vector) -> Vector:
        """Give the outputs at row ``k`` for inputs ``u``."""
        return self._sized("outputs", component.outputs(float(self.t[k]), u.copy()), (self.n_y,))

    def fed_by(self, name: str) -> Mask:
        """Mark the output elements that an input is declared to feed through to."""
        return np.array(
            [
                name in self.interface.feeds(o.name)
                for o in self.interface.outputs
                for _ in range(o.size)
            ],
            np.bool_,
        )

    def fed_at_start(self, name: str) -> Mask:
        """Mark the output elements that an input is declared to count for at the start."""
        outputs = self.interface.outputs
        return np.array(
            [name in self.interface.feeds_at_start(o.name) for o in outputs for _ in range(o.size)],
            np.bool_,
        )

    def compare(self, law: str, found: Matrix, expected: Matrix, first: int = 0) -> None:
        """Require equal bits of rows, the first of them at row ``first``."""
        found, expected = np.atleast_2d(found), np.atleast_2d(expected)
        wrong = np.argwhere(
            np.ascontiguousarray(found).view(np.uint64)
            != np.ascontiguousarray(expected).view(np.uint64)
        )
        if len(wrong):
            row, column = wrong[0]
            label = [element for signal in self.interface.outputs for element in signal.elements][
                column
            ]
            values = f"found {float(found[row, column])!r}, needed {float(expected[row, column])!r}"
            raise AssertionError(f"{law}: {label!r} at t = {self.t[first + row]} s: {values}")

    @staticmethod
    def _sized(call: str, found: Vector, shape: tuple[int, ...]) -> Vector:
        if found.shape != shape or found.dtype != np.float64:
            raise AssertionError(
                f"{call} gives float64 of shape {shape}: found {found.dtype} of shape {found.shape}"
            )
        return found.copy()
