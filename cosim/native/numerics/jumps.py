"""Where an expression in t jumps.

``step`` and ``sign`` are the functions of the language that are not continuous where they are
finite. An argument that is linear in t says when.
"""

from __future__ import annotations

import ast
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

from cosim.native.numerics.expression import (
    OPERATIONS,
    compile_expression,
    compile_over_signals,
    parse,
)
from cosim.native.numerics.programs import evaluate

Line: TypeAlias = tuple[float, float]  # slope and intercept


@dataclass(frozen=True, slots=True)
class Jump:
    """A ``step`` or ``sign`` of an argument that is not constant.

    Parameters
    ----------
    function : str
    argument : str
    slope : float or None
        Of an argument that is linear in t; None: it is another function of t.
    instant : float or None
        Where a linear argument is 0 [s].
    """

    function: str
    argument: str
    slope: float | None = None
    instant: float | None = None

    @property
    def text(self) -> str:
        """The call, as in an expression."""
        return f"{self.function}({self.argument})"

    @property
    def remedy(self) -> str:
        """The same function of t, except that at the instant it has the value after it."""
        assert self.slope is not None
        assert self.instant is not None
        shift = f"- {self.instant!r}" if self.instant >= 0.0 else f"+ {-self.instant!r}"
        step = f"step(t {shift})"
        if self.function == "sign":
            return f"2*{step} - 1" if self.slope > 0.0 else f"1 - 2*{step}"
        return step if self.slope > 0.0 else f"1 - {step}"


@lru_cache(maxsize=64)
def jumps(text: str) -> tuple[Jump, ...]:
    """Return where an expression may jump.

    All other functions of the language are continuous wherever they are finite.

    Raises
    ------
    UsageError
        If the text is no expression.
    """
    compile_expression(text)
    calls = []
    for node in ast.walk(parse(text)):
        match node:
            case ast.Call(func=ast.Name(id="step" | "sign" as function), args=[argument]):
                if _depends_on_time(argument):
                    calls.append(_jump(function, argument))
    return tuple(jump for jump in calls if jump.slope != 0.0)


def jumps_with_signals(text: str) -> bool:
    """Return whether an expression over signals may jump where these do not."""
    operations = {OPERATIONS[code] for code in _operations(text)}
    return not operations.isdisjoint(("step", "sign"))


def depends_on_time(text: str) -> bool:
    """Return whether an expression over signals has t in it, beside these."""
    return any(OPERATIONS[code] == "t" for code in _operations(text))


def _operations(text: str) -> list[int]:
    codes: list[int] = compile_over_signals(text).code.tolist()
    return [code for code in codes if 0 <= code < len(OPERATIONS)]


def _jump(function: str, argument: ast.expr) -> Jump:
    text = ast.unparse(argument)
    line = _line(argument)
    if line is None:
        return Jump(function, text)
    slope, intercept = line
    if slope == 0.0:
        return Jump(function, text, 0.0)
    return Jump(function, text, slope, -intercept / slope + 0.0)


def _depends_on_time(node: ast.expr) -> bool:
    return any(isinstance(part, ast.Name) and part.id == "t" for part in ast.walk(node))


def _line(node: ast.expr) -> Line | None:
    """Return slope and intercept of an expression that is linear in t; None: it is another."""
    if not _depends_on_time(node):
        return 0.0, evaluate(compile_expression(ast.unparse(node)), 0.0)
    match node:
        case ast.Name():
            return 1.0, 0.0
        case ast.UnaryOp(op=operator, operand=operand):
            sign = -1.0 if isinstance(operator, ast.USub) else 1.0
            return _scaled(_line(operand), sign)
        case ast.BinOp(op=operator, left=left, right=right):
            return _line_of(operator, _line(left), _line(right))
    return None


def _line_of(operator: ast.operator, left: Line | None, right: Line | None) -> Line | None:
    """Return slope and intercept of an operation with two lines."""
    if left is None or right is None:
        return None
    match operator:
        case ast.Add():
            return left[0] + right[0], left[1] + right[1]
        case ast.Sub():
            return left[0] - right[0], left[1] - right[1]
        case ast.Mult() if right[0] == 0.0:
            return _scaled(left, right[1])
        case ast.Mult() if left[0] == 0.0:
            return _scaled(right, left[1])
        case ast.Div() if right[0] == 0.0 and right[1] != 0.0:
            return left[0] / right[1], left[1] / right[1]
    return None


def _scaled(line: Line | None, factor: float) -> Line | None:
    return None if line is None else (line[0] * factor, line[1] * factor)
