"""Models that live at the communication points, and the kernels of ``cosim.native`` that an exported one is made of.

A kernel here is a C file of ``c/`` with the constants it needs as C text; numbers are
written as hexadecimal floats, which are exact.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.signals import Interface
from cosim.native.expression import Program
from cosim.native.step import (
    DiscretizedDynamics,
    LeastSquaresConstants,
    RecoveryConstants,
    RegressorConstants,
)


@dataclass(frozen=True, slots=True)
class Kernel:
    """What a discrete model computes.

    Parameters
    ----------
    source : str
        Its file in ``c/``.
    natives : tuple of str
        Files of ``cosim/native`` that it needs.
    memory : int
        Number of doubles that change.
    constants : tuple of str
        Lines of C.
    equations : str
        What it computes, for people.
    linear : bool
        The outputs are the inputs times constants.
    """

    source: str
    natives: tuple[str, ...]
    memory: int
    constants: tuple[str, ...]
    equations: str
    linear: bool = False


@dataclass(frozen=True, slots=True)
class DiscreteModel:
    """A model that lives at the communication points.

    Parameters
    ----------
    interface : Interface
    kernel : Kernel
    step_ns : int
        Its communication step [ns]; 0: any.
    reason : str
        Why it is for co-simulation only.
    every : int
        Communication steps between two answers; the outputs hold between.
    holds : bool
        It samples its inputs at an answer and takes all those steps as one; else it takes every step.
    """

    interface: Interface
    kernel: Kernel
    step_ns: int
    reason: str
    every: int = 1
    holds: bool = False

    @property
    def states(self) -> tuple[str, ...]:
        """There are no continuous states."""
        return ()


def doubles(name: str, values: Iterable[float] | Matrix) -> str:
    """Write an array of doubles."""
    listed = ", ".join(float(v).hex() for v in np.ravel(np.asarray(values, np.float64)))
    return f"const double {name}[] = {{{listed or '0.0'}}};"


def integers(name: str, values: Iterable[Any]) -> str:
    """Write an array of integers."""
    return f"const int32_t {name}[] = {{{', '.join(str(int(v)) for v in np.ravel(list(values))) or '0'}}};"


def integer(name: str, value: int) -> str:
    """Write one integer."""
    return f"const int32_t {name} = {value};"


def regressor(constants: RegressorConstants) -> Kernel:
    """Write the regressor (21)-(25)."""
    terms, factors = np.shape(constants.factor)
    lines = [
        line
        for b, program in enumerate(constants.alphas)
        for line in _program(f"alpha{b}", program)
    ]
    programs = ", ".join(
        f"{{{len(p.code)}, alpha{b}_code, alpha{b}_constants}}"
        for b, p in enumerate(constants.alphas)
    )
    lines += [
        f"static const cosim_program alphas[] = {{{programs}}};",
        "static " + integers("steps", constants.steps),
        "static " + doubles("delays", constants.delays),
        "static " + integers("row", constants.row),
        "static " + integers("factor", constants.factor),
        "static " + doubles("sign", constants.sign),
        f"const cosim_regressor kernel_constants = {{{len(constants.steps)}, {len(constants.alphas)}, {terms}, {factors}, "
        "steps, delays, alphas, row, factor, sign, 0};",
    ]
    alphas = "; ".join(f"alpha_{b} = {program.text}" for b, program in enumerate(constants.alphas))
    return Kernel(
        "regressor.c",
        ("estimate.c", "expression.c"),
        constants.memory,
        tuple(lines),
        f"mu_c(t) = sign_c delta(t - D_row) product of alpha_b(t - D_i); delays D = {list(constants.delays)} s; {alphas}. "
        "No value (NaN) before the longest delay has passed.",
    )


def _program(name: str, program: Program) -> tuple[str, str]:
    return "static " + integers(f"{name}_code", program.code), "static " + doubles(
        f"{name}_constants", program.constants
    )


def least_squares(constants: LeastSquaresConstants) -> Kernel:
    """Write the identifier (33)-(35)."""
    recovery = ", ".join(_recovery(step) for step in constants.recovery)
    return Kernel(
        "identifier.c",
        ("estimate.c", "expression.c"),
        constants.memory,
        (
            f"static const cosim_recovery recovery[] = {{{recovery}}};",
            f"const cosim_least_squares kernel_constants = {{{constants.unknowns}, {len(constants.recovery)}, "
            f"{constants.parameters}, {int(constants.held)}, {constants.start.hex()}, {constants.prior.hex()}, recovery, 0}};",
        ),
        f"Least squares of -mu_0 on mu_1, mu_2, ..., from t = {constants.start} s on: eta, and the parameters theta that follow "
        "from it. No value (NaN) before there is one.",
    )


def _recovery(step: RecoveryConstants) -> str:
    numbers = [
        "{" + ", ".join(texts) + "}"
        for texts in (
            map(str, step.index),
            map(str, step.theta),
            (float(sign).hex() for sign in step.sign),
        )
    ]
    return f"{{{int(step.kind)}, {', '.join(numbers)}, {float(step.spacing).hex()}}}"


def delay(steps: int, width: int, initial: float | None) -> Kernel:
    """Write a delay line; ``initial`` None: it starts at the input."""
    return Kernel(
        "delay.c",
        ("linear.c",),
        1 + steps * width,
        (
            f"const cosim_delay kernel_constants = {{{steps}, {width}, 0}};",
            f"const int32_t kernel_follows = {int(initial is None)};",
            f"const double kernel_initial = {float(initial or 0.0).hex()};",
        ),
        f"y(t) = u(t - {steps} communication steps); before that {'u at the start' if initial is None else initial}.",
        linear=True,
    )


def sampled(discrete: DiscretizedDynamics, *, C: Matrix, D: Matrix, X0: Vector) -> Kernel:
    """Write a linear model discretized for its own step, its inputs held over it."""
    n, m, p = len(discrete.Ad), discrete.B0.shape[1], len(C)
    arrays = {"Ad": discrete.Ad, "B0": discrete.B0, "B1": discrete.B1, "C": C, "D": D}
    return Kernel(
        "sampled.c",
        ("linear.c",),
        2 * n,
        (
            *("static " + doubles(letter, array) for letter, array in arrays.items()),
            doubles("kernel_X0", X0),
            f"const cosim_linear kernel_constants = {{{n}, {m}, {p}, Ad, B0, B1, C, D, 0}};",
        ),
        "x_next = Ad x + B0 u, y = C x + D u, with u sampled at the start of its own step and y held over it; "
        + "; ".join(f"{letter} = {arrays[letter].tolist()}" for letter in ("Ad", "B0", "C", "D")),
    )


def limit(lower: float, upper: float) -> Kernel:
    """Write a limit; it has no memory."""
    bounds = (f"const double kernel_lower = {lower.hex()}, kernel_upper = {upper.hex()};",)
    return Kernel("limit.c", (), 0, bounds, f"y = u, at least {lower} and at most {upper}.")
