"""Metrics: arithmetic of reductions of the rows of a run.

:mod:`cosim.native.numerics.expression` is the language of what is reduced, of the conditions, and
of the arithmetic. ``min`` and ``max`` of one argument are reductions, also with a condition behind
it; those of two numbers are arithmetic outside of reductions, and pointwise inside.

A condition with ``for`` is true at the rows up to which it has held for so long, as everywhere:
``first(t, C for 1 s)`` is where a run until ``C for 1 s`` ends, 1 s after C has begun to hold.
"""

from __future__ import annotations

import ast
import math
import operator
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias, TypeVar, final

import numpy as np

from cosim.arguments import mapping_argument
from cosim.arrays import NAN, Vector
from cosim.core.port import Port
from cosim.core.recorded.partial import PartialChannels
from cosim.core.recorded.run import RecordedRun
from cosim.core.recorded.signals import RecordedPort, find_signal
from cosim.core.recording import Recording
from cosim.core.signals import Channel
from cosim.errors import UnknownSignalError, UsageError, listing, nearest, quoted
from cosim.log import Log
from cosim.log.spans import open_joined
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
from cosim.native.numerics.reductions import KeptValues, RowReduction, RowReductions
from cosim.scenario.data_files.recording_file import open_recording

_COMPARISONS: Final[Mapping[type[ast.cmpop], Callable[[Any, Any], Any]]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}
_SETTLING_SHARE: Final = 0.02  # of the change from first to last value, where no band is given
_REDUCTION_NEEDED: Final = "expected at least one reduction, such as last(plant.y)"
_PLACE: Final = "metrics."  # the table of a study that has them
_QUOTED_OR_DURATION: Final = re.compile(
    r"'(?:\\.|[^'\\])*(?:'|$)"
    r'|"(?:\\.|[^"\\])*(?:"|$)'
    r"|(?<=[\s)\]])for(?=\s)(?P<duration>[^,()\[\]'\"]*)"
)
_Key = TypeVar("_Key")
_Values: TypeAlias = Callable[[Vector], float]  # a number, of the values of reductions
# of texts of metrics, or numbers
MetricComparison: TypeAlias = tuple[str | float, Callable[[Any, Any], Any], str | float]


class ReductionKind(NamedTuple):
    """What a reduction keeps of its values, and what it makes of that.

    Parameters
    ----------
    parts : tuple of str
        Of :data:`~cosim.native.numerics.reductions.PARTS`.
    value : callable
        Of what was kept of one value or more, and the band; without parts also of none.
    forms : tuple of str
        How it is called.
    """

    parts: tuple[str, ...]
    value: Callable[[KeptValues, float | None], float]
    forms: tuple[str, ...] = ("EXPRESSION", "EXPRESSION, CONDITION")


def _std(kept: KeptValues, _: float | None) -> float:
    mean = kept.shifted_sum / kept.number
    variance = kept.shifted_squares / kept.number - mean * mean
    return 0.0 if variance < 0.0 else math.sqrt(variance)


def _settling(kept: KeptValues, band: float | None) -> float:
    if band is None:
        band = _SETTLING_SHARE * abs(kept.last - kept.first)
    return kept.settled(band) if band >= 0.0 else NAN


def _overshoot(kept: KeptValues, _: float | None) -> float:
    change = kept.last - kept.first
    if change == 0.0:
        return NAN
    excess = kept.high - kept.last if change > 0.0 else kept.last - kept.low
    return excess / abs(change)


_BANDS: Final = ("EXPRESSION", "EXPRESSION, BAND", "EXPRESSION, CONDITION")
KINDS: Final[Mapping[str, ReductionKind]] = {
    "last": ReductionKind(("ends",), lambda kept, _: kept.last),
    "initial": ReductionKind(("ends",), lambda kept, _: kept.first, ("EXPRESSION",)),
    "max": ReductionKind(("high",), lambda kept, _: kept.high + 0.0),
    "min": ReductionKind(("low",), lambda kept, _: kept.low + 0.0),
    "mean": ReductionKind(("sum",), lambda kept, _: kept.sum / kept.number),
    "rms": ReductionKind(("squares",), lambda kept, _: math.sqrt(kept.squares / kept.number)),
    "std": ReductionKind(("shifted", "ends"), _std),
    "integral": ReductionKind(("integral",), lambda kept, _: kept.integral),
    "count": ReductionKind((), lambda kept, _: float(kept.number)),
    "first": ReductionKind(("ends",), lambda kept, _: kept.first, ("EXPRESSION, CONDITION",)),
    "share": ReductionKind(
        ("sum",), lambda kept, _: kept.sum / kept.number, ("CONDITION", "CONDITION, CONDITION")
    ),
    "settling": ReductionKind(
        ("kept", "ends"), _settling, (*_BANDS, "EXPRESSION, BAND, CONDITION")
    ),
    "overshoot": ReductionKind(("ends", "low", "high"), _overshoot),
}


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
    band : callable or None
        Of ``settling``; over the reductions before this one.
    """

    kind: ReductionKind
    values: Program | ConditionProgram
    where: ConditionProgram | None = None
    band: _Values | None = None

    @property
    def signals(self) -> tuple[str, ...]:
        """The signals in it as they are written, each once."""
        parts = [self.values] if self.where is None else [self.values, self.where]
        programs = [part if isinstance(part, Program) else part.program for part in parts]
        return tuple(dict.fromkeys(chain.from_iterable(one.signals for one in programs)))


class Metric(NamedTuple):
    """A metric: what joins its reductions."""

    name: str
    reductions: tuple[Reduction, ...]
    joined: _Values


def parse_metric_text(name: str, text: str) -> Metric:
    """Parse a metric; whether there are its signals is not known here.

    Raises
    ------
    UsageError
        If the text is no metric; with what was found and what is possible instead.
    """
    parser = _Parser(text)
    joined = parser.arithmetic()
    if not parser.reductions:
        raise parser.refusal(_REDUCTION_NEEDED)
    return Metric(name, tuple(parser.reductions), joined)


def parse_comparisons(text: str, names: Collection[str] = ()) -> list[MetricComparison]:
    """Parse comparisons of metrics with numbers, or with each other, joined by ``and``.

    ``names`` are those of metrics that may stand in it for their texts.

    Raises
    ------
    UsageError
        If the text is something else; as from :func:`parse_metric_text`.
    """
    parser = _Parser(text)
    parts = [parser.tree]
    if isinstance(parser.tree, ast.BoolOp) and isinstance(parser.tree.op, ast.And):
        parts = parser.tree.values
    found = []
    for part in parts:
        if not isinstance(part, ast.Compare):
            raise parser.refusal(
                "expected a comparison, such as rms(plant.y) < 0.1, or several joined by 'and'"
            )
        nodes = [part.left, *part.comparators]
        operands = [_operand(parser.written(node), names) for node in nodes]
        for (left, right), kind in zip(pairwise(operands), map(type, part.ops), strict=True):
            if kind not in _COMPARISONS:
                raise parser.refusal("expected one of the comparisons < <= > >= == !=")
            if isinstance(left, float) and isinstance(right, float):
                raise parser.refusal(_REDUCTION_NEEDED)
            found.append((left, _COMPARISONS[kind], right))
    return found


def _operand(text: str, names: Collection[str]) -> str | float:
    """Return a metric as it is written, or the value of what is a number alone."""
    if text in names:
        return text
    parser = _Parser(text)
    joined = parser.arithmetic()
    return text if parser.reductions else joined(np.zeros(1))


class _Parser(ast.NodeTransformer):
    """Parses one text, and finds its reductions.

    In the source that Python parses a duration is an argument behind its condition:
    ``first(t, C for 1 s)`` is ``first(t, C ,0     )``, whose places are those of the text.
    """

    def __init__(self, text: str) -> None:
        self.reductions: list[Reduction] = []
        self._text = " ".join(text.splitlines()).strip()
        self._start = f"metric {quoted(self._text)}"
        self._durations: dict[ast.expr, int] = {}  # [ns] by their conditions
        written: dict[int, int] = {}  # [ns] by where they are in the source, in bytes

        def argument(match: re.Match[str]) -> str:
            if match["duration"] is None:
                return match[0]
            place = len(self._text[: match.start()].encode()) + 1
            written[place] = read_duration(self._start, match["duration"])
            return ",0" + " " * (len(match[0].encode()) - 2)

        self._source = _QUOTED_OR_DURATION.sub(argument, self._text)
        self.tree = parse_metric(self._text, self._source)
        for call in [one for one in ast.walk(self.tree) if isinstance(one, ast.Call)]:
            for before, node in pairwise(call.args.copy()):
                if is_condition(before) and node.col_offset in written:
                    self._durations[before] = written.pop(node.col_offset)
                    call.args.remove(node)
        if written:
            raise self.refusal(
                "expected 'for' after a condition, such as first(t, plant.y < 1 for 1 s)"
            )

    def written(self, node: Any) -> str:
        """Return the text of a node, with its durations."""
        return self._text.encode()[node.col_offset : node.end_col_offset].decode()

    def refusal(self, problem: str) -> UsageError:
        """Return the error of a text that is no metric."""
        return UsageError(f"{self._start}: {problem}")

    def arithmetic(self) -> _Values:
        """Return the arithmetic of the text, which may be a number alone."""
        try:
            tree = self.visit(self.tree)
        except RecursionError as error:
            raise nested_too_deep(self._start) from error
        return _values_of(compile_arithmetic(tree, self._source))

    def visit(self, node: ast.AST) -> Any:
        """Return arithmetic in which the number of each reduction, as a text, stands for it."""
        match node:
            case ast.BinOp() | ast.UnaryOp(op=ast.USub() | ast.UAdd()):
                self.generic_visit(node)
            case ast.Call(func=ast.Name(id=name), keywords=[]) if _is_reduction(node):
                self.reductions.append(self._reduction(name, node))
                return ast.copy_location(ast.Constant(str(len(self.reductions) - 1)), node)
            case ast.Call(func=ast.Name(id=name), keywords=[]):
                self._check_function(name, node)
                node.args = [self.visit(argument) for argument in node.args]
            case ast.expr() if is_condition(node):
                raise self.refusal(
                    "expected a number, such as share(plant.y < 1), got the condition "
                    f"{quoted(self.written(node))} outside of a reduction"
                )
            case ast.Name(id="pi" | "e"):
                pass
            case ast.expr() if is_signal(node) or isinstance(node, ast.Name):
                part = self.written(node)
                raise self.refusal(
                    f"expected a reduction, such as last({part}), got {quoted(part)} outside of one"
                )
        return node

    def _check_function(self, name: str, call: ast.Call) -> None:
        """Refuse a function of reductions that there is not, or that is of signals."""
        if name not in FUNCTIONS and name not in KINDS:
            known = nearest(name, [*KINDS, *FUNCTIONS])
            raise self.refusal(f"no reduction or function {quoted(name)}; {known}")
        if name in KINDS and any(map(is_signal, call.args)):
            part = self.written(call)
            raise self.refusal(
                f"expected two reductions in {quoted(part)}; for the {name} over all rows, use "
                f"{name}({part})"
            )

    def _reduction(self, name: str, call: ast.Call) -> Reduction:
        """Return a reduction, whose form fits its kind."""
        kind = KINDS[name]
        words = ["CONDITION" if is_condition(argument) else "EXPRESSION" for argument in call.args]
        for place, argument in enumerate(call.args):
            inner = [node for node in ast.walk(argument) if _is_reduction(node)]
            if inner and (place == 0 or is_condition(argument)):
                raise self.refusal(
                    f"expected an expression over signals inside {name}(...), got "
                    f"{quoted(self.written(inner[0]))}: reductions can be combined by arithmetic, "
                    "but not nested"
                )
        if words[1:2] == ["EXPRESSION"]:
            words[1] = "BAND"
        if ", ".join(words) not in kind.forms:
            expected = " or ".join(f"{name}({form})" for form in kind.forms)
            if name == "initial":
                expected += " or first(EXPRESSION, CONDITION)"
            raise self.refusal(f"expected {expected}, got {quoted(self.written(call))}")

        def condition(argument: ast.expr) -> ConditionProgram:
            duration_ns = self._durations.get(argument, 0)
            return compile_condition_part(argument, self._source, duration_ns)

        first = call.args[0]
        is_of_condition = words[0] == "CONDITION"
        values = condition(first) if is_of_condition else compile_part(first, self._source)
        where = condition(call.args[-1]) if "CONDITION" in words[1:] else None
        if "BAND" not in words:
            return Reduction(kind, values, where)
        written = self.written(call.args[1])
        program = compile_arithmetic(self.visit(call.args[1]), self._source)
        band = _values_of(program)
        if not program.signals and not band(np.zeros(1)) >= 0.0:
            raise self.refusal(f"expected a band >= 0, got {quoted(written)}")
        return Reduction(kind, values, where, band)


def _values_of(program: Program) -> _Values:
    """Return what computes arithmetic; its columns are the numbers of reductions."""
    columns = [int(name) for name in program.signals]
    if len(program.code) == len(columns) == 1:
        return lambda values: float(values[columns[0]])
    rows = RowProgram(program.with_columns(columns))
    return lambda values: float(rows.evaluate(np.zeros(1), values[np.newaxis])[0])


def _is_reduction(node: ast.AST) -> bool:
    match node:
        case ast.Call(func=ast.Name(id="min" | "max"), args=[_, other]):
            return is_condition(other)
        case ast.Call(func=ast.Name(id=name)):
            return name in KINDS
    return False


@final
class Metrics:
    """Metrics of one run.

    Parameters
    ----------
    metrics : sequence of Metric
    place : str
        Where they are written, before the name of each: for messages.
    """

    def __init__(self, metrics: Sequence[Metric], place: str = _PLACE) -> None:
        self._metrics = tuple(metrics)
        self._place = place
        self.names = tuple(metric.name for metric in metrics)
        self.reductions = tuple(chain.from_iterable(metric.reductions for metric in metrics))
        self.signals = _signals_of(self.reductions)

    def check(self, channels: Mapping[str, Channel], *, source: str = "the run") -> None:
        """Check that there are all signals, each a number.

        Raises
        ------
        UsageError
            If not; with a line for each problem of each metric.
        """
        problems = []
        for metric in self._metrics:
            for name in _signals_of(metric.reductions):
                try:
                    find_element(channels, name, source)
                except UsageError as error:
                    problems.append(f"{self._place}{metric.name}: {error}")
        if problems:
            raise UsageError("\n".join(problems))

    def of(self, recording: Recording) -> dict[str, float | None]:
        """Return the metrics of a recorded run; None: one has no value.

        Raises
        ------
        UsageError
            As from :meth:`check`.
        """
        self.check(recording.channels, source=recording.label)

        def timed_by(reduction: Reduction) -> frozenset[str]:
            """Return what has the instants: components, and signals that may have own ones."""
            channels = recording.channels
            gaps = [
                name
                for name in reduction.signals
                if find_element(channels, name, recording.label).signal.optional
            ]
            return frozenset([*gaps, *(one.name for one in channels_of(reduction, channels))])

        groups = self.grouped(timed_by).items()
        return self.values((own, _reduced(recording, names, own.values())) for names, own in groups)

    def grouped(self, key: Callable[[Reduction], _Key]) -> dict[_Key, dict[int, Reduction]]:
        """Return the reductions by their numbers, those with the same key together."""
        groups: dict[_Key, dict[int, Reduction]] = {}
        for number, reduction in enumerate(self.reductions):
            groups.setdefault(key(reduction), {})[number] = reduction
        return groups

    def values(
        self, groups: Iterable[tuple[Iterable[int], RowReductions]]
    ) -> dict[str, float | None]:
        """Return the metrics, of the numbers of reductions and what they have reduced."""
        kept = {n: rows.kept(place) for own, rows in groups for place, n in enumerate(own)}
        numbers = iter(range(len(self.reductions)))
        found: dict[str, float | None] = {}
        for metric in self._metrics:
            values = np.full(len(metric.reductions), NAN)
            for place, reduction in enumerate(metric.reductions):
                part = kept[next(numbers)]
                if part.number or not reduction.kind.parts:
                    band = None if reduction.band is None else reduction.band(values)
                    values[place] = reduction.kind.value(part, band)
            value = metric.joined(values)
            found[metric.name] = value if math.isfinite(value) else None
        return found


def _signals_of(reductions: Iterable[Reduction]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(chain.from_iterable(one.signals for one in reductions)))


def parse_metrics(texts: Mapping[str, str], place: str = _PLACE) -> Metrics:
    """Parse metrics by name.

    Raises
    ------
    UsageError
        If one is none; with a line for each that is.
    """
    metrics = []
    problems = []
    for name, text in mapping_argument("metrics", texts).items():
        try:
            if not name:
                raise UsageError("expected a name that is not empty")
            if not isinstance(text, str):
                raise UsageError(
                    f"expected an expression such as 'max(abs(plant.y))', got {quoted(text)}"
                )
            metrics.append(parse_metric_text(name, text))
        except UsageError as error:
            problems.append(f"{place}{name}: {error}")
    if problems:
        raise UsageError("\n".join(problems))
    return Metrics(metrics, place)


def find_element(channels: Mapping[str, Channel], name: str, source: str) -> RecordedPort:
    """Return the one number that a signal is.

    Raises
    ------
    UsageError
        If there is no such signal, or it has several elements.
    """
    try:
        port = find_signal(channels, name, source=source)
    except UnknownSignalError as error:
        raise UsageError(str(error)) from error
    if port.size != 1:
        names = Port.parse(name).element_names(port.size)
        raise UsageError(f"'{name}' has {port.size} elements; expected one of: {listing(names)}")
    return port


def channels_of(reduction: Reduction, channels: Mapping[str, Channel]) -> list[Channel]:
    """Return the components whose instants a reduction is over; of none the fastest one's."""
    if not channels:
        raise UsageError("expected at least one component in the run, got none")
    if not reduction.signals:
        return [min(channels.values(), key=lambda channel: channel.period)]
    return [find_element(channels, name, "the run").channel for name in reduction.signals]


def bind(reductions: Iterable[Reduction], column_of: Callable[[str], int]) -> RowReductions:
    """Return reductions of rows, in which each signal has its column."""

    def placed(part: Any) -> Any:
        if isinstance(part, Program):
            return part.with_columns([column_of(name) for name in part.signals])
        return part and replace(part, program=placed(part.program))

    return RowReductions(
        [RowReduction(one.kind.parts, placed(one.values), placed(one.where)) for one in reductions]
    )


def _reduced(
    recording: Recording, timed_by: Collection[str], reductions: Collection[Reduction]
) -> RowReductions:
    """Return reductions of the rows at the instants that components and signals share."""
    times = [recording.time_ns(name) for name in timed_by]
    time_ns = np.ascontiguousarray(reduce(np.intersect1d, times))
    columns = {name: column for column, name in enumerate(_signals_of(reductions))}
    rows = np.empty((len(time_ns), max(len(columns), 1)))
    for name, column in columns.items():
        rows[:, column] = recording[name][np.searchsorted(recording.time_ns(name), time_ns)]
    bound = bind(reductions, columns.__getitem__)
    bound.begin(recording.step_ns)
    bound.add(time_ns, rows)
    return bound


def metrics(
    log: str | Path | RecordedRun, expressions: Mapping[str, str]
) -> dict[str, float | None]:
    """Return metrics of a recorded run, by name; None: one has no value.

    They are those that a study has of this run, bit for bit, where the log has all of its rows.

    >>> import cosim
    >>> cosim.metrics("logs/academic.mcap", {"error": "rms(observer.delta - delta.y)"})
    {'error': 0.14566791481551514}

    Parameters
    ----------
    log : str, Path or RecordedRun
        Of a path, see :func:`cosim.open_recording`; a file of a log that was rotated is read with
        those before it.
    expressions : mapping of name to expression
        As [metrics] of a study has them, such as ``{"last": "last(plant.y)"}``.

    Raises
    ------
    UsageError
        If an expression is no metric, or has a signal that is not recorded.
    LogError
        If the log cannot be read.
    """
    return parse_metrics(expressions).of(open_whole(log))


def open_whole(log: str | Path | RecordedRun) -> RecordedRun:
    """Open a recording; the last file of a log that was rotated with those before it."""
    recording = log if isinstance(log, RecordedRun) else open_recording(log)
    return open_joined(recording) if isinstance(recording, Log) else recording


def missing_rows(metrics: Metrics, log: RecordedRun) -> str:
    """Return which rows of its run a log lacks that metrics are made of; empty: none."""
    if log.status == "partial":
        return f"{log.label} is a part of the log of its run"
    channels = log.channels
    if isinstance(channels, PartialChannels):
        names = [find_element(channels, name, log.label).channel.name for name in metrics.signals]
        for name in names or channels:
            if channels[name].period != channels.partial.declared[name].period:
                every = channels.partial.selection.every
                return f"{log.label} has rows at every {every} steps only"
    return ""
