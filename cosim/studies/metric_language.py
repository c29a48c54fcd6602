"""The text of a metric: arithmetic of reductions, whose arguments are expressions over signals.

:mod:`cosim.native.numerics.expression` is the language of the arguments, of the conditions, and of
the arithmetic. ``min`` and ``max`` of one argument are reductions, also with a condition behind it;
those of two numbers are arithmetic outside of reductions, and pointwise inside.

A condition with ``for`` is true at the rows up to which it has held for so long, as everywhere:
``first(t, C for 1 s)`` is where a run until ``C for 1 s`` ends, 1 s after C has begun to hold.
"""

from __future__ import annotations

import ast
import math
import operator
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, TypeAlias, final

import numpy as np

from cosim.arrays import NAN, Vector
from cosim.errors import UsageError, nearest, quoted
from cosim.native.numerics.expression import (
    FUNCTIONS,
    ConditionProgram,
    Program,
    compile_arithmetic,
    compile_condition_part,
    compile_part,
    is_condition,
    is_signal,
    nested_too_deep,
    parse_metric,
    read_duration,
)
from cosim.native.numerics.programs import RowProgram
from cosim.native.numerics.reductions import KeptValues

SETTLING_SHARE: Final = (
    0.02  # of the change from the first to the last value, where no band is given
)


@dataclass(frozen=True)
class ReductionKind:
    """A kind of reduction.

    Parameters
    ----------
    usage : str
        How it is written.
    parts : tuple of str
        What is to be kept of the values (:data:`cosim.native.numerics.reductions.PARTS`).
    value : callable
        Returns its value, NaN where it has none, for values of which there is one at least, and
        the band, None where there is none.
    takes_condition : bool
        Whether a condition may restrict the rows.
    needs_condition : bool
    of_condition : bool
        Whether it is of a condition, not of an expression.
    takes_band : bool
    without_values : float
        Its value where there are no values.
    """

    usage: str
    parts: tuple[str, ...]
    value: Callable[[KeptValues, float | None], float]
    takes_condition: bool = True
    needs_condition: bool = False
    of_condition: bool = False
    takes_band: bool = False
    without_values: float = NAN


def _std(kept: KeptValues) -> float:
    """Return the standard deviation.

    Sums of differences to the first value x lose little: n var >= (x - mean)^2, as x is one of the
    values, so that the sum of squares of the differences is at most (n + 1) times n var.
    """
    mean = kept.shifted_sum / kept.number
    variance = kept.shifted_squares / kept.number - mean * mean
    return 0.0 if variance < 0.0 else math.sqrt(variance)


def _settling(kept: KeptValues, band: float | None) -> float:
    """Return the instant of the first value from which on all are within a band of the last one.

    Parameters
    ----------
    kept : KeptValues
    band : float or None
        None: a share of the change. One that has no value has no such instant.
    """
    if band is None:
        band = SETTLING_SHARE * abs(kept.last - kept.first)
    return kept.settled(band) if band >= 0.0 else NAN


def _overshoot(kept: KeptValues) -> float:
    """Return how far values are beyond the last one, as a share of the change from the first."""
    change = kept.last - kept.first
    if change == 0.0:
        return NAN
    excess = kept.high - kept.last if change > 0.0 else kept.last - kept.low
    return excess / abs(change)


def _simple(
    name: str, parts: tuple[str, ...], value: Callable[[KeptValues], float]
) -> ReductionKind:
    usage = f"{name}(EXPRESSION), or {name}(EXPRESSION, CONDITION)"
    return ReductionKind(usage, parts, lambda kept, _: value(kept))


KINDS: Final[Mapping[str, ReductionKind]] = {
    "last": _simple("last", ("ends",), lambda kept: kept.last),
    "initial": ReductionKind(
        "initial(EXPRESSION), or first(EXPRESSION, CONDITION)",
        ("ends",),
        lambda kept, _: kept.first,
        takes_condition=False,
    ),
    # -0 + 0 is 0: which one of zeros with different signs is found depends on the blocks of a run
    "max": _simple("max", ("high",), lambda kept: kept.high + 0.0),
    "min": _simple("min", ("low",), lambda kept: kept.low + 0.0),
    "mean": _simple("mean", ("sum",), lambda kept: kept.sum / kept.number),
    "rms": _simple("rms", ("squares",), lambda kept: math.sqrt(kept.squares / kept.number)),
    "std": _simple("std", ("shifted", "ends"), _std),
    "integral": _simple("integral", ("integral",), lambda kept: kept.integral),
    "count": ReductionKind(
        "count(EXPRESSION), or count(EXPRESSION, CONDITION)",
        (),
        lambda kept, _: float(kept.number),
        without_values=0.0,
    ),
    "first": ReductionKind(
        "first(EXPRESSION, CONDITION)",
        ("ends",),
        lambda kept, _: kept.first,
        needs_condition=True,
    ),
    "share": ReductionKind(
        "share(CONDITION), or share(CONDITION, CONDITION)",
        ("sum",),
        lambda kept, _: kept.sum / kept.number,
        of_condition=True,
    ),
    "settling": ReductionKind(
        "settling(EXPRESSION), settling(EXPRESSION, BAND), or one of them with a CONDITION behind",
        ("kept", "ends"),
        _settling,
        takes_band=True,
    ),
    "overshoot": _simple("overshoot", ("ends", "low", "high"), _overshoot),
}


_QUOTED_OR_DURATION: Final = re.compile(
    r"'(?:\\.|[^'\\])*(?:'|$)"
    r'|"(?:\\.|[^"\\])*(?:"|$)'
    r"|(?<=[\s)\]])for(?=\s)(?P<duration>[^,()\[\]'\"]*)"
)
Compare: TypeAlias = Callable[[Any, Any], Any]
COMPARISONS: Final[dict[type[ast.cmpop], tuple[str, Compare]]] = {
    ast.Lt: ("<", operator.lt),
    ast.LtE: ("<=", operator.le),
    ast.Gt: (">", operator.gt),
    ast.GtE: (">=", operator.ge),
    ast.Eq: ("==", operator.eq),
    ast.NotEq: ("!=", operator.ne),
}
_CONSTANTS: Final = ("pi", "e")
_NOT_NESTED: Final = frozenset(KINDS) - {"min", "max"}


@final
class Arithmetic:
    """Numbers that follow from the values of reductions.

    Parameters
    ----------
    program : Program
        Its columns are the numbers of reductions.
    """

    def __init__(self, program: Program) -> None:
        columns = [int(name) for name in program.signals]
        self.columns = tuple(columns)
        self._is_one = len(columns) == len(program.code) == 1
        self._program = RowProgram(program.with_columns(columns))

    def value(self, values: Vector) -> float:
        """Return its value for those of the reductions; NaN where it has none."""
        if self._is_one:
            return float(values[self.columns[0]])
        [value] = self._program.evaluate(np.zeros(1), values[np.newaxis]).tolist()
        return float(value)


@dataclass(frozen=True, eq=False)
class Reduction:
    """A reduction in a metric.

    Parameters
    ----------
    kind : ReductionKind
    values : Program or ConditionProgram
        What is reduced, over signals; of ``share`` a condition.
    where : ConditionProgram or None
        Restricts the rows.
    band : Arithmetic or None
        Of ``settling``; over the reductions before this one.
    """

    kind: ReductionKind
    values: Program | ConditionProgram
    where: ConditionProgram | None = None
    band: Arithmetic | None = None

    @property
    def signals(self) -> tuple[str, ...]:
        """The signals in it as they are written, each once."""
        names: dict[str, None] = {}
        for part in (self.values, self.where):
            program = part.program if isinstance(part, ConditionProgram) else part
            if program is not None:
                names.update(dict.fromkeys(program.signals))
        return tuple(names)


@dataclass(frozen=True, eq=False)
class Metric:
    """A metric of a study.

    Parameters
    ----------
    name, text : str
    reductions : tuple of Reduction
    arithmetic : Arithmetic
        What joins them.
    """

    name: str
    text: str
    reductions: tuple[Reduction, ...]
    arithmetic: Arithmetic


class MetricComparison(NamedTuple):
    """Two operands that are compared: texts of metrics, or numbers."""

    left: str | float
    holds: Compare
    right: str | float


def parse_metric_text(name: str, text: str) -> Metric:
    """Parse a metric; whether there are its signals is not known here.

    Raises
    ------
    UsageError
        If the text is no metric; with what was found and what is possible instead.
    """
    parser = _MetricParser(" ".join(text.splitlines()).strip())
    arithmetic = parser.parse()
    return Metric(name, text, tuple(parser.reductions), arithmetic)


def parse_comparisons(text: str, names: Collection[str] = ()) -> list[MetricComparison]:
    """Parse comparisons of metrics with numbers, or with each other, joined by ``and``.

    Parameters
    ----------
    text : str
    names : collection of str
        Of metrics that may stand in it for their texts.

    Raises
    ------
    UsageError
        If the text is something else; as from :func:`parse_metric_text`.
    """
    return _MetricParser(" ".join(text.splitlines()).strip()).comparisons(names)


def _operand(text: str, names: Collection[str]) -> str | float:
    """Return a metric as it is written, or the value of what is a number alone."""
    if text in names:
        return text
    parser = _MetricParser(text)
    arithmetic = parser.arithmetic()
    return text if parser.reductions else arithmetic.value(np.zeros(1))


class _MetricParser:
    """Parses one text, and finds its reductions.

    Parameters
    ----------
    text : str
        One line.
    """

    def __init__(self, text: str) -> None:
        self.reductions: list[Reduction] = []
        self._text = text
        self._start = f"metric {quoted(text)}"
        self._durations: dict[int, int] = {}  # [ns] by where their 'for' begins, in bytes
        self._source = _QUOTED_OR_DURATION.sub(self._take_duration, text)

    def _take_duration(self, match: re.Match[str]) -> str:
        """Return what stands for a match in the source: blanks for a duration."""
        if match["duration"] is None:
            return match[0]
        begin = len(self._text[: match.start()].encode())
        self._durations[begin] = read_duration(self._start, match["duration"])
        return " " * len(match[0].encode())  # places in the tree are counted in bytes

    def parse(self) -> Arithmetic:
        """Return the arithmetic of the text, which has a reduction."""
        arithmetic = self.arithmetic()
        if not self.reductions:
            raise self._refusal("expected at least one reduction, such as last(plant.y)")
        return arithmetic

    def comparisons(self, names: Collection[str]) -> list[MetricComparison]:
        """Return the comparisons of the text; of a chain each two that are neighbors."""
        tree = parse_metric(self._text, self._source)
        parts = tree.values if isinstance(tree, ast.BoolOp) else [tree]
        is_joined_by_or = isinstance(tree, ast.BoolOp) and isinstance(tree.op, ast.Or)
        found = []
        for part in parts:
            if is_joined_by_or or not isinstance(part, ast.Compare):
                raise self._refusal(
                    "expected a comparison, such as rms(plant.y) < 0.1, or several joined by 'and'"
                )
            nodes = (part.left, *part.comparators)
            operands = [_operand(self._written(node), names) for node in nodes]
            for left, operation, right in zip(operands, part.ops, operands[1:], strict=False):
                if type(operation) not in COMPARISONS:
                    known = " ".join(dict(COMPARISONS.values()))
                    raise self._refusal(f"expected one of the comparisons {known}")
                if isinstance(left, float) and isinstance(right, float):
                    raise self._refusal(
                        "expected at least one reduction in a comparison, such as last(plant.y)"
                    )
                found.append(MetricComparison(left, COMPARISONS[type(operation)][1], right))
        return found

    def _written(self, node: ast.expr) -> str:
        """Return the text of a node with its durations, which the source has not."""
        return self._text.encode()[node.col_offset : node.end_col_offset].decode()

    def arithmetic(self) -> Arithmetic:
        """Return the arithmetic of the text, which may be a number alone."""
        tree = parse_metric(self._text, self._source)
        try:
            arithmetic = self._arithmetic(tree)
        except RecursionError as error:
            raise nested_too_deep(self._start) from error
        if self._durations:
            raise self._refusal(
                "expected 'for' after a condition, such as first(t, plant.y < 1 for 1 s)"
            )
        return Arithmetic(compile_arithmetic(arithmetic, self._source))

    def _arithmetic(self, node: ast.expr) -> ast.expr:
        """Return arithmetic in which the number of each reduction, as a text, stands for it."""
        match node:
            case ast.UnaryOp(op=ast.USub() | ast.UAdd()):
                node.operand = self._arithmetic(node.operand)
            case ast.BinOp():
                node.left = self._arithmetic(node.left)
                node.right = self._arithmetic(node.right)
            case ast.Call(func=ast.Name(id=name), keywords=[]):
                return self._call(name, node)
            case ast.Name(id=name) if name in _CONSTANTS:
                pass
            case _ if is_condition(node):
                found = f"the condition {self._quoted(node)} outside of a reduction"
                is_of_rows = _first_reduction(node) is None
                example = f", such as share({self._part(node)})" if is_of_rows else ""
                raise self._refusal(f"expected a number{example}, got {found}")
            case _ if is_signal(node) or isinstance(node, ast.Name):
                part = self._part(node)
                raise self._refusal(
                    f"expected a reduction, such as last({part}), got {quoted(part)} outside of one"
                )
        return node

    def _call(self, name: str, node: ast.Call) -> ast.expr:
        """Return the arithmetic of a call: a reduction, or a function of reductions."""
        is_extreme = name in ("min", "max")
        if is_extreme and len(node.args) == 2 and not is_condition(node.args[1]):
            if any(map(_is_over_signals, node.args)):
                part = self._part(node)
                raise self._refusal(
                    f"expected two reductions in {quoted(part)}; for the {name} over all rows, use "
                    f"{name}({part})"
                )
        elif name in KINDS:
            return self._reduction(name, node)
        elif name not in FUNCTIONS:
            known = nearest(name, [*KINDS, *FUNCTIONS])
            raise self._refusal(f"no reduction or function {quoted(name)}; {known}")
        node.args = [self._arithmetic(argument) for argument in node.args]
        return node

    def _reduction(self, name: str, node: ast.Call) -> ast.expr:
        """Take up a reduction; return what stands for it."""
        kind = KINDS[name]
        arguments = list(node.args)
        durations = self._durations_of(node)
        for place, argument in enumerate(arguments):
            if place == 0 or is_condition(argument):
                self._check_nesting(name, argument)
        where: ConditionProgram | None = None
        if len(arguments) > 1 and is_condition(arguments[-1]) and kind.takes_condition:
            where = compile_condition_part(arguments.pop(), self._source, durations[len(arguments)])
        most = 2 if kind.takes_band else 1
        fits = 1 <= len(arguments) <= most and (where is not None or not kind.needs_condition)
        if not fits or is_condition(arguments[0]) is not kind.of_condition:
            raise self._refusal(f"expected {kind.usage}, got {self._quoted(node)}")
        values: Program | ConditionProgram
        if kind.of_condition:
            values = compile_condition_part(arguments[0], self._source, durations[0])
        else:
            values = compile_part(arguments[0], self._source)
        band = self._band(arguments[1]) if len(arguments) > 1 else None
        self.reductions.append(Reduction(kind, values, where, band))
        stands_for = ast.Constant(str(len(self.reductions) - 1))
        return ast.copy_location(stands_for, node)

    def _band(self, node: ast.expr) -> Arithmetic:
        """Return the band of a settling time.

        Raises
        ------
        UsageError
            If it is a negative number.
        """
        band = Arithmetic(compile_arithmetic(self._arithmetic(node), self._source))
        if not band.columns and not band.value(np.zeros(1)) >= 0.0:
            raise self._refusal(f"expected a band >= 0, got {self._quoted(node)}")
        return band

    def _durations_of(self, call: ast.Call) -> list[int]:
        """Return the durations that stand behind the arguments of a call [ns]; 0: none.

        Those behind conditions only; others remain, for a refusal.
        """
        begins = [argument.col_offset for argument in call.args[1:]] + [call.end_col_offset or 0]
        durations = []
        for argument, next_begin in zip(call.args, begins, strict=False):
            end = argument.end_col_offset or 0
            inside = [begin for begin in self._durations if end <= begin < next_begin]
            taken = [self._durations.pop(begin) for begin in inside if is_condition(argument)]
            durations.append(sum(taken))
        return durations

    def _check_nesting(self, name: str, argument: ast.expr) -> None:
        """Check that there is no reduction in what is reduced, or in its condition."""
        inner = _first_reduction(argument)
        if inner is not None:
            raise self._refusal(
                f"expected an expression over signals inside {name}(...), got "
                f"{self._quoted(inner)}: reductions can be combined by arithmetic, but not nested"
            )

    def _part(self, node: ast.expr) -> str:
        return ast.get_source_segment(self._source, node) or ""

    def _quoted(self, node: ast.expr) -> str:
        return quoted(self._part(node))

    def _refusal(self, problem: str) -> UsageError:
        return UsageError(f"{self._start}: {problem}")


def _first_reduction(tree: ast.expr) -> ast.expr | None:
    """Return a reduction in a syntax tree; None: there is none."""
    for node in ast.walk(tree):
        match node:
            case ast.Call(func=ast.Name(id=name), args=arguments) if name in _NOT_NESTED or (
                name in KINDS and len(arguments) == 1
            ):
                return node
    return None


def _is_over_signals(node: ast.expr) -> bool:
    """Return whether there is a signal, or t, in arithmetic outside of reductions."""
    match node:
        case ast.Name(id="t"):
            return True
        case ast.UnaryOp(operand=operand):
            return _is_over_signals(operand)
        case ast.BinOp(left=left, right=right):
            return _is_over_signals(left) or _is_over_signals(right)
        case ast.Call(func=ast.Name(id=name), args=arguments) if name in FUNCTIONS:
            return any(map(_is_over_signals, arguments))
    return is_signal(node)
