"""A small safe language for functions of time, compiled to a postfix program that the C kernel runs.

Numbers, ``t``, ``pi``, ``e``, ``+ - * / **``, parentheses, and the functions listed in ``FUNCTIONS``; ``step(x)`` is 1 where
x >= 0 and 0 elsewhere. Nothing else is evaluated, imported or called.
"""

from __future__ import annotations

import ast
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cosim.errors import UsageError, nearest

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
)  # expression.c's order
_CODE = {name: code for code, name in enumerate(OPERATIONS)}
_BINARY = {
    ast.Add: "add",
    ast.Sub: "subtract",
    ast.Mult: "multiply",
    ast.Div: "divide",
    ast.Pow: "power",
}
_CONSTANTS = {"pi": math.pi, "e": math.e}
_STACK = 64  # COSIM_STACK of cosim.h


@dataclass(frozen=True, slots=True)
class Program:
    """A compiled expression: ``code`` (int32) refers to operations, then to ``constants``."""

    text: str
    code: NDArray[np.int32]
    constants: NDArray[np.float64]


def compile_expression(text: str) -> Program:
    """Compile an expression in ``t``.

    Raises
    ------
    UsageError
        If the text is no expression of the language; with the place, what was found and what is there instead.
    """
    try:
        tree = ast.parse(text.strip(), mode="eval")
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        place = (
            f" at column {error.offset}" if isinstance(error, SyntaxError) and error.offset else ""
        )
        raise UsageError(
            f"expression {text!r}: not an expression{place}; needed something like '1.35 + 0.25*sin(1.7*t)'"
        ) from error
    compiler = _Compiler(text)
    try:
        depth = compiler.emit(tree.body)
    except RecursionError as error:
        raise UsageError(
            f"expression {text!r}: nested too deep to be read; write it with fewer terms"
        ) from error
    if depth > _STACK:
        raise UsageError(f"expression {text!r}: nested {depth} deep, at most {_STACK}")
    return Program(
        text, np.array(compiler.code, np.int32), np.array(compiler.constants or [0.0], np.float64)
    )


class _Compiler:
    def __init__(self, text: str) -> None:
        self.text = text
        self.code: list[int] = []
        self.constants: list[float] = []

    def refuse(self, found: str, needed: str) -> UsageError:
        return UsageError(f"expression {self.text!r}: found {found}; {needed}")

    def emit(self, node: ast.expr) -> int:
        """Append the code of a node; return the stack it needs."""
        match node:
            case ast.Constant(value=bool() | str() | bytes() | complex() | None):
                raise self.refuse(f"{node.value!r}", "needed a real number")
            case ast.Constant(value=int() | float() as value):
                return self.constant(value)
            case ast.Name(id="t"):
                self.code.append(_CODE["t"])
                return 1
            case ast.Name(id=name) if name in _CONSTANTS:
                return self.constant(_CONSTANTS[name])
            case ast.Name(id=name):
                raise self.refuse(
                    f"unknown name {name!r}",
                    nearest(name, ["t", *_CONSTANTS, *FUNCTIONS, "min", "max"]),
                )
            case ast.UnaryOp(op=ast.UAdd(), operand=operand):
                return self.emit(operand)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return self.call("negate", [operand])
            case ast.BinOp(op=operator, left=left, right=right) if type(operator) in _BINARY:
                return self.call(_BINARY[type(operator)], [left, right])
            case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
                return self.function(name, arguments)
            case _:
                raise self.refuse(
                    f"{ast.unparse(node)!r}",
                    "only numbers, t, pi, e, + - * / ** and functions are allowed",
                )

    def constant(self, value: float) -> int:
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            raise self.refuse(f"{value}", "needed a finite number")
        self.code.append(len(OPERATIONS) + len(self.constants))
        self.constants.append(number)
        return 1

    def function(self, name: str, arguments: list[ast.expr]) -> int:
        count = 2 if name in ("min", "max") else 1
        if name not in FUNCTIONS and count == 1:
            raise self.refuse(
                f"unknown function {name!r}", nearest(name, [*FUNCTIONS, "min", "max"])
            )
        if len(arguments) != count:
            raise self.refuse(f"{name} with {len(arguments)} arguments", f"needed {count}")
        return self.call(name, arguments)

    def call(self, operation: str, arguments: list[ast.expr]) -> int:
        depth = max(position + self.emit(argument) for position, argument in enumerate(arguments))
        self.code.append(_CODE[operation])
        return depth
