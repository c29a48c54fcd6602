"""Models that change at communication points only, and the kernels that an exported one is made of.

A kernel is a C file of ``c/``, around code of ``cosim.native``, with the constants it needs as C
text; numbers are written as hexadecimal floats, which are exact.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.signals import Interface
from cosim.instants import StepNs
from cosim.native.blocks.control import PidConstants
from cosim.native.blocks.window import WindowConstants
from cosim.native.estimation.alphas import PastAlphas, elements_of
from cosim.native.estimation.regression import (
    LeastSquaresConstants,
    RecoveryConstants,
    RegressorConstants,
)
from cosim.native.numerics.expression import Program
from cosim.native.numerics.linear import DiscretizedDynamics

# files of cosim/native that kernels need: those of controllers, those of the method
CONTROL: Final = ("control.c", "linear.c")
ESTIMATION: Final = ("regression.c", "alphas.c", "expression.c", "linear.c", "elementary.c")


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
    affine : bool
        At one instant the outputs change in proportion to the inputs, so that derivatives lead from
        some inputs to others; else an FMU provides none.
    """

    source: str
    natives: tuple[str, ...]
    memory: int
    constants: tuple[str, ...]
    equations: str
    linear: bool = False
    affine: bool = True


@dataclass(frozen=True, slots=True)
class DiscreteModel:
    """A model that changes at communication points only.

    Parameters
    ----------
    interface : Interface
    kernel : Kernel
    step_ns : int or Fraction
        Its communication step [ns]; 0: any.
    reason : str
        Why it is for co-simulation only.
    steps_per_sample : int
        Communication steps between two samples of its outputs; a zero-order hold between them.
    zero_order_hold : bool
        It samples its inputs with its outputs and holds them too, so that all these steps are one;
        else it takes every communication step.
    """

    interface: Interface
    kernel: Kernel
    step_ns: StepNs
    reason: str
    steps_per_sample: int = 1
    zero_order_hold: bool = False

    @property
    def states(self) -> tuple[str, ...]:
        """There are no continuous states."""
        return ()


# --- constants in C ---


def doubles(name: str, values: Iterable[float] | Matrix) -> str:
    """Write an array of doubles."""
    numbers = np.ravel(np.asarray(values, np.float64))
    return f"const double {name}[] = {{{_hexadecimal(numbers) or '0.0'}}};"


def _hexadecimal(numbers: Iterable[float]) -> str:
    return ", ".join(float(number).hex() for number in numbers)


def integers(name: str, values: Iterable[Any]) -> str:
    """Write an array of integers."""
    numbers = np.ravel(list(values))
    return f"const int32_t {name}[] = {{{_decimal(numbers) or '0'}}};"


def _decimal(numbers: Iterable[Any]) -> str:
    return ", ".join(str(int(number)) for number in numbers)


def integer(name: str, value: int) -> str:
    """Write one integer."""
    return f"const int32_t {name} = {value};"


# --- kernels ---


def regressor(constants: RegressorConstants) -> Kernel:
    """Write the regressor (21)-(25)."""
    past = constants.alphas
    lines = past_alphas("alphas", past)
    lines.append("static " + integers("steps", constants.steps))
    lines.append("static " + integers("row", constants.row))
    lines.append("static " + integers("factor", constants.factor))
    lines.append("static " + doubles("sign", constants.sign))
    n_steps = len(constants.steps)
    terms, factors = np.shape(constants.factor)
    lines.append(
        "const cosim_regressor kernel_constants = "
        f"{{{n_steps}, {terms}, {factors}, steps, &alphas, row, factor, sign, 0}};"
    )
    ages = list(past.ages)
    alphas = [f"alpha_{b} = {alpha.text}" for b, alpha in enumerate(past.alphas)]
    equations = (
        "mu_c(t) = sign_c delta(t - D_row) product of alpha_b(t - D_i - lag of delta); "
        f"alpha is read {ages} s before t; {'; '.join(alphas)}. "
        "No value (NaN) before the longest delay has passed."
    )
    return Kernel(
        "regressor.c",
        ESTIMATION,
        constants.memory,
        tuple(lines),
        equations,
        affine=not past.signals,
    )


def past_alphas(name: str, constants: PastAlphas) -> list[str]:
    """Write alphas at instants before now."""
    lines: list[str] = []
    programs: list[str] = []
    for i, alpha in enumerate(constants.alphas):
        if isinstance(alpha, Program):
            lines += _program(f"{name}{i}", alpha)
            programs.append(f"{{{len(alpha.code)}, {name}{i}_code, {name}{i}_constants, 0}}")
        else:
            programs.append("{0, 0, 0, 0}")
    lines.append(f"static const cosim_program {name}_programs[] = {{{', '.join(programs)}}};")
    lines.append("static " + integers(f"{name}_element", elements_of(constants.alphas)))
    lines.append("static " + doubles(f"{name}_age", constants.ages))
    lines.append("static " + integers(f"{name}_steps", constants.steps))
    lines.append("static " + doubles(f"{name}_part", constants.parts))
    count = len(constants.alphas)
    rows = len(constants.ages)
    lines.append(
        f"static const cosim_past_alphas {name} = "
        f"{{{{{count}, {constants.signals}, {name}_element, {name}_programs}}, {rows}, "
        f"{constants.samples}, {name}_age, {name}_steps, {name}_part}};"
    )
    return lines


def _program(name: str, program: Program) -> tuple[str, str]:
    code = integers(f"{name}_code", program.code)
    constants = doubles(f"{name}_constants", program.constants)
    return f"static {code}", f"static {constants}"


def least_squares(constants: LeastSquaresConstants) -> Kernel:
    """Write the identifier (33)-(35)."""
    recovery = ", ".join(_recovery(block) for block in constants.recovery)
    unknowns = constants.unknowns
    blocks = len(constants.recovery)
    parameters = constants.parameters
    held = int(constants.held)
    start_time = constants.start_time.hex()
    prior = constants.prior.hex()
    lines = (
        f"static const cosim_recovery recovery[] = {{{recovery}}};",
        "const cosim_least_squares kernel_constants = "
        f"{{{unknowns}, {blocks}, {parameters}, {held}, {start_time}, {prior}, recovery, 0}};",
    )
    equations = (
        f"Least squares of -mu_0 on mu_1, mu_2, ..., from t = {constants.start_time} s on: eta, "
        "and the parameters theta that follow from it. No value (NaN) before there is one."
    )
    return Kernel("least_squares.c", ESTIMATION, constants.memory, lines, equations)


def _recovery(block: RecoveryConstants) -> str:
    index = _decimal(block.index)
    theta = _decimal(block.theta)
    sign = _hexadecimal(block.sign)
    spacing = float(block.spacing).hex()
    return f"{{{int(block.kind)}, {{{index}}}, {{{theta}}}, {{{sign}}}, {spacing}}}"


def delay(steps: int, width: int, initial: float | None) -> Kernel:
    """Write a delay line; ``initial`` None: initially the output is the input."""
    follows = initial is None
    value = float(initial or 0.0)
    lines = (
        f"const cosim_delay kernel_constants = {{{steps}, {width}, 0}};",
        integer("kernel_follows", int(follows)),
        f"const double kernel_initial = {value.hex()};",
    )
    before = "the initial u" if follows else initial
    equations = f"y(t) = u(t - {steps} h) with the communication step h; before that {before}."
    memory = 1 + steps * width
    return Kernel("delay.c", ("linear.c",), memory, lines, equations, linear=True)


def sampled(discrete: DiscretizedDynamics, *, C: Matrix, D: Matrix, X0: Vector) -> Kernel:
    """Write a linear model discretized for its own step with a zero-order hold of its inputs."""
    equations = (
        "x_next = Ad x + B0 u, y = C x + D u, with u sampled at the start of its own step and a "
        "zero-order hold of y over it"
    )
    Xu = np.zeros(discrete.B0.shape)
    shown = {"Ad": discrete.Ad, "B0": discrete.B0, "C": C, "D": D}  # B1 is zero
    return _discretized(discrete, C, D, X0, Xu, equations=f"{equations}; {_shown(shown)}")


def discretized(
    discrete: DiscretizedDynamics, *, C: Matrix, D: Matrix, X0: Vector, Xu: Matrix
) -> Kernel:
    """Write a linear model discretized for the communication step."""
    equations = "x_next = Ad x + B0 u + B1 u_next, y = C x + D u, initially x = X0 + Xu u"
    shown = {"Ad": discrete.Ad, "B0": discrete.B0, "B1": discrete.B1, "C": C, "D": D}
    return _discretized(discrete, C, D, X0, Xu, equations=f"{equations}; {_shown(shown)}")


def _discretized(
    discrete: DiscretizedDynamics, C: Matrix, D: Matrix, X0: Vector, Xu: Matrix, *, equations: str
) -> Kernel:
    n, m = discrete.B0.shape
    p = len(C)
    arrays = {"Ad": discrete.Ad, "B0": discrete.B0, "B1": discrete.B1, "C": C, "D": D}
    lines = [f"static {doubles(letter, array)}" for letter, array in arrays.items()]
    lines.append(doubles("kernel_X0", X0))
    lines.append(doubles("kernel_Xu", Xu))
    numbers = f"{n}, {m}, {p}, Ad, B0, B1, C, D"
    lines.append(f"const cosim_linear kernel_constants = {{{numbers}, 0, 0, 0, 0}};")
    return Kernel("sampled.c", ("linear.c",), 2 * n, tuple(lines), equations)


def _shown(matrices: Mapping[str, Matrix]) -> str:
    """Write matrices for people."""
    return "; ".join(f"{name} = {matrix.tolist()}" for name, matrix in matrices.items())


def window(constants: WindowConstants, *, X0: Vector, Xu: Matrix) -> Kernel:
    """Write a linear model discretized for its step, with weighted sums over a window of steps."""
    n, m, p = constants.sizes
    names = ("Ad", "B0", "B1", "C", "D", "Jx", "J0", "J1", "weights")
    arrays = (*constants.matrices, *constants.increments)
    lines = []
    for name, array in zip(names, arrays, strict=True):
        lines.append(f"static {doubles(name, array)}")
    lines.append(doubles("kernel_X0", X0))
    lines.append(doubles("kernel_Xu", Xu))
    taps = len(constants.weights)
    lines.append(
        f"const cosim_window kernel_constants = {{{{{n}, {m}, {p}, Ad, B0, B1, C, D, 0}}, "
        f"{taps}, {constants.width}, Jx, J0, J1, weights, 0}};"
    )
    shown = dict(zip(names[:-1], arrays[:-1], strict=True))
    equations = (
        "x_next = Ad x + B0 u + B1 u_next, initially x = X0 + Xu u; the first outputs are C x + D "
        f"u, the others the weighted sums of Jx x + J0 u + J1 u_next over the last {taps} steps, "
        f"which have no value (NaN) before; {_shown(shown)}"
    )
    natives = ("window.c", "linear.c")
    return Kernel("windowed.c", natives, constants.memory, tuple(lines), equations)


def limit(lower: float, upper: float) -> Kernel:
    """Write a limit; it has no memory."""
    bounds = f"const double kernel_lower = {lower.hex()}, kernel_upper = {upper.hex()};"
    equations = f"y = u, at least {lower} and at most {upper}."
    return Kernel("limit.c", ("static.c",), 0, (bounds,), equations, affine=False)


def product(operations: str) -> Kernel:
    """Write a product; it has no memory."""
    count = len(operations)
    divides = [operation == "/" for operation in operations]
    lines = (integer("kernel_count", count), integers("kernel_divides", divides))
    factors = " ".join(f"{operation} u{i}" for i, operation in enumerate(operations, 1))
    equations = f"y = 1 {factors}, element by element."
    return Kernel("product.c", ("static.c",), 0, lines, equations, affine=False)


def switch(threshold: float) -> Kernel:
    """Write a switch; it has no memory."""
    lines = (f"const double kernel_threshold = {threshold.hex()};",)
    equations = f"y = u1 where control >= {threshold}, else y = u2."
    return Kernel("switch.c", ("static.c",), 0, lines, equations, affine=False)


def integrator(width: int, lower: float, upper: float, initial: float) -> Kernel:
    """Write an integrator with limits."""
    bounds = f"{float(lower).hex()}, {float(upper).hex()}"
    lines = (
        f"static const uint8_t held[{width}];",
        f"const cosim_integrator kernel_constants = {{{width}, {bounds}, held, 0}};",
        f"const double kernel_initial = {float(initial).hex()};",
    )
    equations = (
        f"y' = u, initially y = {initial}, at least {lower} and at most {upper}: there y stays as "
        "long as u points outwards. Steps are exact for linearly interpolated inputs."
    )
    return Kernel("integrator.c", CONTROL, width, lines, equations)


def pid(constants: PidConstants, *, sampled: bool) -> Kernel:
    """Write a PID controller."""
    lines = (
        "static const uint8_t held[2];",
        f"const cosim_pid kernel_constants = {{{_hexadecimal(constants.numbers)}, held, 0}};",
        integer("kernel_is_sampled", int(sampled)),
    )
    c = constants
    step = ""
    if sampled:
        step = "by Euler's methods from sample to sample, forward for I and backward for w; "
    equations = (
        f"v = {c.gain} ({c.setpoint_weight} setpoint - measurement) + I + d - w; "
        f"y = v, at least {c.lower} and at most {c.upper}; integral = I; {step}"
        f"I' = {c.integral_gain} (setpoint - measurement) + {c.tracking_rate} (y - v), initially "
        f"{c.initial_integral}; w' = {c.filter_rate} (d - w), initially d; "
        f"d = {c.derivative_gain} ({c.derivative_weight} setpoint - measurement)"
    )
    return Kernel("pid.c", CONTROL, 2, lines, equations, affine=not constants.is_limited)
