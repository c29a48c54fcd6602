"""A small safe language for functions of time, compiled to a postfix program for the C kernel.

Numbers, ``t``, ``pi``, ``e``, ``+ - * / **``, parentheses, ``min``, ``max`` and the functions
listed in ``FUNCTIONS``; ``step(x)`` is 1 where x >= 0 and 0 elsewhere. Nothing else is evaluated,
imported or called.
"""

from __future__ import annotations

import ast
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cosim.errors import UsageError, nearest, quoted
from cosim.filters import ignored_warnings

FUNCTIONS = (
    "sin",
    "cos",
    "tan",
    "asin",
    "acos",
    "atan",
    "sinh",
    "cosh",
    "tanh",
    "exp",
    "log",
    "sqrt",
    "abs",
    "sign",
    "step",
)
OPERATIONS = (
    "t",
    "add",
    "subtract",
    "multiply",
    "divide",
    "power",
    "min",
    "max",
    "negate",
    *FUNCTIONS,
)  # in the order of expression.c
_CODE = {name: code for code, name in enumerate(OPERATIONS)}
_BINARY = {
    ast.Add: "add",
    ast.Sub: "subtract",
    ast.Mult: "multiply",
    ast.Div: "divide",
    ast.Pow: "power",
}
_CONSTANTS = {"pi": math.pi, "e": math.e}
_ALLOWED = "only numbers, t, pi, e, + - * / ** and functions are allowed"
_STACK = 64  # COSIM_STACK of expression.h
MOST_TEXT = 100_000  # characters


@dataclass(frozen=True, slots=True)
class Program:
    """A compiled expression.

    ``code`` holds an index into ``OPERATIONS`` or, beyond them, into ``constants``.
    """

    text: str
    code: NDArray[np.int32]
    constants: NDArray[np.float64]


def compile_expression(text: str) -> Program:
    """Compile an expression in ``t``.

    Raises
    ------
    UsageError
        If the text is no expression of the language; with the place, what was found and what is
        possible instead.
    """
    tree = parse(text)
    compiler = _Compiler(text.strip())
    try:
        depth = compiler.emit(tree)
    except RecursionError as error:
        raise UsageError(
            f"expression {quoted(text)}: nested too deep to be read; write it with fewer terms"
        ) from error
    if depth > _STACK:
        raise UsageError(f"expression {quoted(text)}: nested {depth} deep, at most {_STACK}")
    code = np.array(compiler.code, np.int32)
    constants = np.array(
        compiler.constants or [0.0], np.float64
    )  # never empty: C takes its address
    return Program(text, code, constants)


def parse(text: str) -> ast.expr:
    """Return the syntax tree of a text that looks like an expression.

    Raises
    ------
    UsageError
        If it does not, or is too long.
    """
    if len(text) > MOST_TEXT:
        raise UsageError(
            f"expression {quoted(text)}: has {len(text)} characters; needed at most {MOST_TEXT}"
        )
    try:
        with ignored_warnings():  # of "1or 2" and the like, which the compiler refuses
            return ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        column = error.offset if isinstance(error, SyntaxError) else None
        place = f" at column {column}" if column else ""
        raise UsageError(
            f"expression {quoted(text)}: not an expression{place}; needed something like "
            "'1.35 + 0.25*sin(1.7*t)'"
        ) from error


class _Compiler:
    """The code and constants of one expression; each method returns the stack depth it needs."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.code: list[int] = []
        self.constants: list[float] = []

    def emit(self, node: ast.expr) -> int:
        """Append the code of a node."""
        match node:
            case ast.Constant(value=value):
                return self._literal(value)
            case ast.Name(id=name):
                return self._name(name)
            case ast.UnaryOp(op=ast.UAdd(), operand=operand):
                return self.emit(operand)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return self._operation("negate", [operand])
            case ast.BinOp(op=operator, left=left, right=right) if type(operator) in _BINARY:
                return self._operation(_BINARY[type(operator)], [left, right])
            case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
                return self._call(name, arguments)
        raise self._refusal(quoted(ast.get_source_segment(self.text, node)), _ALLOWED)

    def _literal(self, value: object) -> int:
        if value is ...:
            raise self._refusal("'...'", _ALLOWED)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise self._refusal(quoted(value), "needed a real number")
        return self._constant(value)

    def _name(self, name: str) -> int:
        if name == "t":
            self.code.append(_CODE["t"])
            return 1
        if name not in _CONSTANTS:
            nearest_name = nearest(name, ["t", *_CONSTANTS, *FUNCTIONS, "min", "max"])
            raise self._refusal(f"unknown name {quoted(name)}", nearest_name)
        return self._constant(_CONSTANTS[name])

    def _constant(self, value: float) -> int:
        try:
            number = float(value)
        except OverflowError:  # an integer beyond the largest double
            number = math.inf
        if not math.isfinite(number):
            raise self._refusal(quoted(value), "needed a finite number")
        self.code.append(len(OPERATIONS) + len(self.constants))
        self.constants.append(number)
        return 1

    def _call(self, name: str, arguments: list[ast.expr]) -> int:
        needed = 2 if name in ("min", "max") else 1
        if name not in FUNCTIONS and needed == 1:
            nearest_name = nearest(name, [*FUNCTIONS, "min", "max"])
            raise self._refusal(f"unknown function {quoted(name)}", nearest_name)
        if len(arguments) != needed:
            raise self._refusal(f"{name} with {len(arguments)} arguments", f"needed {needed}")
        return self._operation(name, arguments)

    def _operation(self, operation: str, arguments: list[ast.expr]) -> int:
        # the values of the earlier arguments stay on the stack while the next one is computed
        depths = [position + self.emit(argument) for position, argument in enumerate(arguments)]
        self.code.append(_CODE[operation])
        return max(depths)

    def _refusal(self, found: str, needed: str) -> UsageError:
        return UsageError(f"expression {quoted(self.text)}: found {found}; {needed}")
