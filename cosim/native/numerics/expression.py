"""A small safe language, compiled to a postfix program for the C kernel.

Numbers, ``t``, ``pi``, ``e``, ``+ - * / **``, parentheses, ``min``, ``max`` and the functions
listed in ``FUNCTIONS``; ``step(x)`` is 1 where x >= 0 and 0 elsewhere. Nothing else is evaluated,
imported or called. There are four forms:

expression in t
    A number, such as ``1.35 + 0.25*sin(1.7*t)``.
expression over signals
    A number of signals too: ``component.signal``, or an element ``plant.x_a[0]``; in quotes where
    Python would read the name otherwise: ``'plant.der(x)'``, ``'my-plant.y'``.
condition
    Comparisons ``< <= > >= == !=`` of expressions over signals, joined by ``and``, ``or``, ``not``
    and parentheses; at its end perhaps ``for 10 ms``: held without a break for so long. A duration
    has a unit (``UNITS``), or is in seconds: ``for 0.5``.
metric
    Arithmetic of reductions over the rows of a run, such as ``rms(observer.delta - delta.y)``. What
    a reduction is, and which there are, is known in :mod:`cosim.studies.metrics`; here is what it
    is made of.

A comparison with NaN, such as that of an optional signal without a value, is false, and so is its
negation: ``not a < b`` is ``a >= b``. So what has no value never makes a condition true.
"""

from __future__ import annotations

import ast
import math
import re
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from functools import lru_cache, partial
from itertools import pairwise
from typing import Final

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
    "less",
    "less_equal",
    "equal",
    "not_equal",
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
_COMPARISONS: Final[Mapping[type[ast.cmpop], tuple[str, bool]]] = {
    ast.Lt: ("less", False),
    ast.LtE: ("less_equal", False),
    ast.Gt: ("less", True),
    ast.GtE: ("less_equal", True),
    ast.Eq: ("equal", False),
    ast.NotEq: ("not_equal", False),
}  # the operation, and whether its operands are exchanged
_OPPOSITES: Final[Mapping[type[ast.cmpop], type[ast.cmpop]]] = {
    ast.Lt: ast.GtE,
    ast.LtE: ast.Gt,
    ast.Gt: ast.LtE,
    ast.GtE: ast.Lt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
}
_CONSTANTS = {"pi": math.pi, "e": math.e}
UNITS: Final[Mapping[str, int]] = {
    "ns": 1,
    "us": 10**3,
    "ms": 10**6,
    "s": 10**9,
    "min": 60 * 10**9,
    "h": 3600 * 10**9,
}  # of durations [ns]
_COMPARISON_NEEDED = "expected a comparison, such as plant.y < 1, or several joined by and, or, not"
_FOR = re.compile(r"(?<=[\s)\]])for(?=\s|$)")
_NOT_IN_DURATION: Final = frozenset("'\"()[]<>=")
_DURATION = re.compile(
    r"(?P<number>\d+\.?\d*(e[+-]?\d{1,3})?|\.\d+(e[+-]?\d{1,3})?)\s*(?P<unit>\w*)"
)
_LONGEST_NS = 2**63 - 1
_STACK = 64  # COSIM_STACK of expression.h
MOST_TEXT = 100_000  # characters


@dataclass(frozen=True, slots=True)
class _Form:
    """One of the forms of the language, for messages.

    Parameters
    ----------
    name, example : str
    allowed : str
        What there may be in it.
    over_signals, is_condition : bool
    """

    name: str
    example: str
    allowed: str
    over_signals: bool = False
    is_condition: bool = False


_WITH_SIGNALS = "allowed: numbers, t, pi, e, signals such as plant.y, + - * / ** and functions"
_IN_TIME: Final = _Form(
    "an expression",
    "'1.35 + 0.25*sin(1.7*t)'",
    "allowed: numbers, t, pi, e, + - * / ** and functions",
)
_OVER_SIGNALS: Final = _Form(
    "an expression", "'observer.delta - delta.y'", _WITH_SIGNALS, over_signals=True
)
_CONDITION: Final = _Form(
    "a condition",
    "'abs(observer.delta - delta.y) < 1e-3 for 1 s'",
    _WITH_SIGNALS,
    over_signals=True,
    is_condition=True,
)
_METRIC: Final = _Form(
    "a metric",
    "'rms(observer.delta - delta.y)'",
    "allowed: numbers, pi, e, reductions such as last(plant.y), + - * / ** and functions",
    over_signals=True,
)


@dataclass(frozen=True, slots=True)
class Program:
    """A compiled expression, or condition: 1 where it is true, else 0.

    Parameters
    ----------
    text : str
    code : array of int32
        Indices into ``OPERATIONS``; beyond them into ``constants``; -1, -2, ... are the columns 0,
        1, ... of a row: as it is compiled, numbers of ``signals``.
    constants : array of float64
    signals : tuple of str
        As they are written, each once, in the order of the text.
    """

    text: str
    code: NDArray[np.int32]
    constants: NDArray[np.float64]
    signals: tuple[str, ...] = ()

    def with_columns(self, columns: Sequence[int]) -> Program:
        """Return the program for rows in which the signals stand in these columns."""
        codes = [code if code >= 0 else -1 - columns[-1 - code] for code in self.code.tolist()]
        return replace(self, code=np.array(codes, np.int32))


@dataclass(frozen=True, slots=True)
class ConditionProgram:
    """A compiled condition.

    Parameters
    ----------
    text : str
    program : Program
    duration_ns : int
        How long it has to hold without a break [ns]; 0: an instant.
    """

    text: str
    program: Program
    duration_ns: int = 0


@lru_cache(maxsize=64)  # the same texts come with every member of a study
def compile_expression(text: str) -> Program:
    """Compile an expression in ``t``.

    Raises
    ------
    UsageError
        If the text is no expression of the language; with the place, what was found and what is
        possible instead.
    """
    return _Written(_IN_TIME, text, text.strip()).program()


def compile_over_signals(text: str) -> Program:
    """Compile an expression over signals; whether there are these signals is not known here.

    Raises
    ------
    UsageError
        If the text is no expression of the language; as from :func:`compile_expression`.
    """
    return _Written(_OVER_SIGNALS, text, text.strip()).program()


def compile_condition(text: str) -> ConditionProgram:
    """Compile a condition; whether there are its signals is not known here.

    Raises
    ------
    UsageError
        If the text is no condition of the language; as from :func:`compile_expression`.
    """
    condition = text
    duration_ns = 0
    words = list(_FOR.finditer(text))
    last = words[-1] if words else None
    if last is not None and _NOT_IN_DURATION.isdisjoint(text[last.end() :]):
        condition = text[: last.start()]
        duration_ns = read_duration(f"condition {quoted(text)}", text[last.end() :])
    program = _Written(_CONDITION, text, condition.strip()).program()
    return ConditionProgram(text, program, duration_ns)


def compile_part(tree: ast.expr, source: str) -> Program:
    """Compile an expression over signals that is a part of a text; as of its own.

    Parameters
    ----------
    tree : ast.expr
    source : str
        The whole text, as it was parsed.
    """
    part = ast.get_source_segment(source, tree) or ""
    return _Written(_OVER_SIGNALS, part, source).program_of(tree)


def compile_condition_part(tree: ast.expr, source: str, duration_ns: int) -> ConditionProgram:
    """Compile a condition that is a part of a text, as :func:`compile_part`."""
    part = ast.get_source_segment(source, tree) or ""
    program = _Written(_CONDITION, part, source).program_of(tree)
    return ConditionProgram(part, program, duration_ns)


def compile_arithmetic(tree: ast.expr, source: str) -> Program:
    """Compile the arithmetic of a metric, in which constant texts are the names of columns.

    Raises
    ------
    UsageError
        If there is anything else in it than arithmetic.
    """
    return _Written(_METRIC, source, source).program_of(tree)


def is_condition(tree: ast.expr) -> bool:
    """Return whether a syntax tree looks like a condition, not like a number."""
    match tree:
        case ast.Compare() | ast.BoolOp() | ast.UnaryOp(op=ast.Not()):
            return True
    return False


def is_signal(tree: ast.expr) -> bool:
    """Return whether a syntax tree is the name of a signal, in quotes or not."""
    match tree:
        case ast.Constant(value=str()):
            return True
        case ast.Attribute() | ast.Subscript():
            return _is_written(tree)
    return False


def read_duration(start: str, duration: str) -> int:
    """Return a duration in nanoseconds.

    Parameters
    ----------
    start : str
        Of messages.
    duration : str
        What stands behind ``for``.

    Raises
    ------
    UsageError
        If it is none, not positive, or no whole number of nanoseconds.
    """
    found = f"{start}: got {quoted(duration.strip())} after 'for'"
    needed = "expected a duration, such as 10 ms, 1 s, or 0.5 in seconds"
    match = _DURATION.fullmatch(duration.strip())
    if match is None:
        raise UsageError(f"{found}; {needed}")
    unit = match["unit"] or "s"
    if unit not in UNITS:
        raise UsageError(f"{found}: unknown unit {unit!r}; {nearest(unit, UNITS)}")
    ns = Decimal(match["number"]) * UNITS[unit]
    if not 0 < ns <= _LONGEST_NS:
        raise UsageError(f"{found}; expected a positive duration of less than 292 years")
    if ns != int(ns):
        raise UsageError(f"{found}; expected a whole number of nanoseconds")
    return int(ns)


@dataclass(frozen=True, slots=True)
class _Written:
    """A text of a form.

    Parameters
    ----------
    form : _Form
    text : str
        As messages name it.
    source : str
        The part of it that is parsed.
    """

    form: _Form
    text: str
    source: str

    @property
    def start(self) -> str:
        """The start of a message about it."""
        _, name = self.form.name.split()
        return f"{name} {quoted(self.text)}"

    def tree(self) -> ast.expr:
        """Return its syntax tree."""
        if len(self.text) > MOST_TEXT:
            raise UsageError(
                f"{self.start}: expected at most {MOST_TEXT} characters, got {len(self.text)}"
            )
        try:
            with ignored_warnings():  # of "1or 2" and the like, which the compiler refuses
                return ast.parse(self.source.strip(), mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            column = error.offset if isinstance(error, SyntaxError) else None
            place = f" at column {column}" if column else ""
            raise UsageError(
                f"{self.start}: not {self.form.name}{place}; expected something like "
                f"{self.form.example}"
            ) from error

    def program(self) -> Program:
        """Compile it."""
        return self.program_of(self.tree())

    def program_of(self, tree: ast.expr) -> Program:
        """Compile its syntax tree, or a part of that."""
        compiler = _Compiler(self)
        try:
            depth = compiler.emit_condition(tree) if self.form.is_condition else compiler.emit(tree)
        except RecursionError as error:
            raise nested_too_deep(self.start) from error
        if depth > _STACK:
            raise UsageError(
                f"{self.start}: expected at most {_STACK} levels of nesting, got {depth}"
            )
        code = np.array(compiler.code, np.int32)
        constants = np.array(
            compiler.constants or [0.0], np.float64
        )  # never empty: C takes its address
        return Program(self.text, code, constants, tuple(compiler.signals))


def nested_too_deep(start: str) -> UsageError:
    """Return the error of a text that Python cannot follow into its depth."""
    return UsageError(f"{start}: nested too deeply; use fewer terms")


def parse(text: str) -> ast.expr:
    """Return the syntax tree of a text that looks like an expression in t.

    Raises
    ------
    UsageError
        If it does not, or is too long.
    """
    return _Written(_IN_TIME, text, text).tree()


def parse_metric(text: str, source: str) -> ast.expr:
    """Return the syntax tree of a metric.

    Parameters
    ----------
    text : str
        As it was written, for messages.
    source : str
        The same without durations, which Python cannot parse.

    Raises
    ------
    UsageError
        If it does not look like one, or is too long.
    """
    return _Written(_METRIC, text, source).tree()


class _Compiler:
    """The code and constants of one text; each method returns the stack depth it needs.

    Parameters
    ----------
    written : _Written
    """

    def __init__(self, written: _Written) -> None:
        self._written = written
        self._form = written.form
        self.code: list[int] = []
        self.constants: list[float] = []
        self.signals: dict[str, int] = {}  # number of each

    def emit(self, node: ast.expr) -> int:
        """Append the code of a number."""
        match node:
            case ast.Constant(value=str(name)) if self._form.over_signals:
                return self._signal(name)
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
            case _ if self._form.over_signals and is_signal(node):
                return self._signal("".join(self._source(node).split()))
        raise self._refusal("got " + quoted(self._source(node)), self._form.allowed)

    def emit_condition(self, node: ast.expr, *, negated: bool = False) -> int:
        """Append the code of a condition, or of its negation: 1 where it is true, else 0."""
        match node:
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return self.emit_condition(operand, negated=not negated)
            case ast.BoolOp(op=operator, values=values):
                is_and = isinstance(operator, ast.And) is not negated
                parts = [partial(self.emit_condition, value, negated=negated) for value in values]
                return self._joined("min" if is_and else "max", parts)
            case ast.Compare(left=left, ops=operators, comparators=others) if all(
                type(operator) in _COMPARISONS for operator in operators
            ):
                pairs = zip(operators, pairwise([left, *others]), strict=True)
                parts = [partial(self._comparison, *pair, negated) for pair in pairs]
                return self._joined("max" if negated else "min", parts)
        raise self._refusal("got " + quoted(self._source(node)), _COMPARISON_NEEDED)

    def _comparison(
        self, operator: ast.cmpop, operands: tuple[ast.expr, ast.expr], negated: bool
    ) -> int:
        kind = type(operator)
        operation, is_exchanged = _COMPARISONS[_OPPOSITES[kind] if negated else kind]
        ordered = reversed(operands) if is_exchanged else operands
        return self._operation(operation, list(ordered))

    def _joined(self, operation: str, parts: Sequence[Callable[[], int]]) -> int:
        """Append the code of conditions, and that of an operation between each two."""
        depth = parts[0]()
        for part in parts[1:]:
            depth = max(depth, 1 + part())
            self.code.append(_CODE[operation])
        return depth

    def _signal(self, name: str) -> int:
        composed = unicodedata.normalize("NFC", name)
        number = self.signals.setdefault(composed, len(self.signals))
        self.code.append(-1 - number)
        return 1

    def _source(self, node: ast.expr) -> str:
        return ast.get_source_segment(self._written.source, node) or ""

    def _literal(self, value: object) -> int:
        if value is ...:
            raise self._refusal("got '...'", self._form.allowed)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise self._refusal("got " + quoted(value), "expected a real number")
        return self._constant(value)

    def _name(self, name: str) -> int:
        if name == "t":
            self.code.append(_CODE["t"])
            return 1
        if name not in _CONSTANTS:
            nearest_name = nearest(name, ["t", *_CONSTANTS, *FUNCTIONS, "min", "max"])
            if self._form.over_signals:
                nearest_name += (
                    "; a signal is COMPONENT.SIGNAL, in quotes where a name has other characters "
                    "than letters, digits and '_'"
                )
            raise self._refusal(f"unknown name {quoted(name)}", nearest_name)
        return self._constant(_CONSTANTS[name])

    def _constant(self, value: float) -> int:
        try:
            number = float(value)
        except OverflowError:  # an integer beyond the largest double
            number = math.inf
        if not math.isfinite(number):
            raise self._refusal("got " + quoted(value), "expected a finite number")
        self.code.append(len(OPERATIONS) + len(self.constants))
        self.constants.append(number)
        return 1

    def _call(self, name: str, arguments: list[ast.expr]) -> int:
        needed = 2 if name in ("min", "max") else 1
        if name not in FUNCTIONS and needed == 1:
            nearest_name = nearest(name, [*FUNCTIONS, "min", "max"])
            raise self._refusal(f"unknown function {quoted(name)}", nearest_name)
        if len(arguments) != needed:
            raise self._refusal(f"got {name} with {len(arguments)} arguments", f"expected {needed}")
        return self._operation(name, arguments)

    def _operation(self, operation: str, arguments: list[ast.expr]) -> int:
        # the values of the earlier arguments stay on the stack while the next one is computed
        depths = [position + self.emit(argument) for position, argument in enumerate(arguments)]
        self.code.append(_CODE[operation])
        return max(depths)

    def _refusal(self, problem: str, way_out: str) -> UsageError:
        return UsageError(f"{self._written.start}: {problem}; {way_out}")


def _is_written(node: ast.expr) -> bool:
    """Return whether a node is the name of a signal, perhaps with elements: ``plant.x[0]``."""
    match node:
        case ast.Name():
            return True
        case ast.Attribute(value=inner):
            return _is_written(inner)
        case ast.Subscript(value=inner, slice=index):
            parts = [part for part in ast.walk(index) if isinstance(part, ast.expr)]
            allowed = (ast.Constant, ast.Slice, ast.Tuple)
            return _is_written(inner) and all(isinstance(part, allowed) for part in parts)
    return False
