"""Estimated constants as tables, with what is common to several said once below."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Final, NamedTuple

from rich.table import Table

from cosim.report.estimators import numbers_text
from cosim.report.summary import Summary, ValueOutcome
from cosim.report.tables.console import new_table
from cosim.scenario.record import IrregularEffect, IrregularPart
from cosim.theory.documents import ParameterVerdict

_IN_TERM: Final = "in "  # begins the reason of an amplitude that names its term
IF_WRONG: Final = "if it is wrong"  # the model, behind the sentence that says "if it is right"
_SHOWN_RTOL: Final = 1e-6  # of values with six digits
_COLUMNS: Final = ("parameter", "estimate", "95 % interval", "truth", "error", "verdict")


class EstimateRow(NamedTuple):
    """An estimated constant: what it is, its truth where that is known, and its verdict."""

    label: str
    estimate: str
    half_width: str = ""
    truth: str = ""
    error: str = ""
    verdict: str = ""
    reason: str = ""


def estimate_rows(summary: Summary) -> list[EstimateRow]:
    """Return the rows of a run, those with a truth first.

    Below the others are what output error says beside another method, amplitudes and phases.
    """
    verdicts: dict[str, ParameterVerdict] = {}
    others: list[EstimateRow] = []
    with_truth = {outcome.estimate for outcome in summary.values}
    for identification in summary.identifications:
        for verdict in identification.parameters:
            verdicts[verdict.name] = verdict
            if verdict.name not in with_truth:
                others.append(_verdict_row(verdict.name, verdict))
        for verdict in identification.reference:
            _, _, name = verdict.name.partition(".")
            if len(summary.identifications) > 1:
                name = verdict.name
            others.append(_verdict_row(f"{name}, output error", verdict))
        others += (_verdict_row(verdict.name, verdict) for verdict in identification.amplitudes)
    rows: list[EstimateRow] = []
    for outcome in {outcome.estimate: outcome for outcome in summary.values}.values():
        rows += _outcome_rows(outcome, verdicts.get(outcome.estimate))
    return [*rows, *others]


def _outcome_rows(outcome: ValueOutcome, verdict: ParameterVerdict | None) -> Iterator[EstimateRow]:
    """Yield a row; two where the signal ends with another value than that of the verdict."""
    truth = f"{outcome.truth:+g}"
    error = "" if outcome.error is None else f"{outcome.error:.3g}"
    shown = value_text(outcome.value)
    if verdict is None:
        yield EstimateRow(outcome.estimate, shown, truth=truth, error=error)
        return
    if outcome.value is not None and not _is_shown_alike(outcome.value, verdict.value):
        yield EstimateRow(f"{outcome.estimate} (signal)", shown, truth=truth, error=error)
        error = ""
    if not error and verdict.value is not None:
        error = f"{abs(verdict.value - outcome.truth):.3g}"
    yield _verdict_row(outcome.estimate, verdict, truth=truth, error=error)


def _is_shown_alike(value: float, other: float | None) -> bool:
    if other is None:
        return False
    return abs(value - other) <= _SHOWN_RTOL * max(abs(value), abs(other))


def _verdict_row(
    label: str, verdict: ParameterVerdict, *, truth: str = "", error: str = ""
) -> EstimateRow:
    value = value_text(verdict.value)
    width = "" if verdict.half_width is None else f"± {verdict.half_width:.2g}"
    return EstimateRow(label, value, width, truth, error, verdict.verdict, verdict.reason)


def value_text(value: float | None) -> str:
    """Return an estimate with its sign and six digits."""
    return "no value" if value is None else f"{value:+.6g}"


def estimate_table(rows: list[EstimateRow]) -> Table:
    """Return the table, without the columns that no row has."""
    shown = [i for i in range(len(_COLUMNS)) if any(row[i] for row in rows)]
    cells = [[row[i] for i in shown] for row in rows]
    return new_table("", [_COLUMNS[i] for i in shown], cells)


def estimate_notes(summary: Summary) -> Iterator[tuple[str, str]]:
    """Yield the reasons of verdicts, each once, what they do not see, and terms of amplitudes."""
    rows = estimate_rows(summary)
    yield from reason_notes([(row.label, row.verdict, row.reason) for row in rows])
    for identification in summary.identifications:
        of_several = f"{identification.component}: " if len(summary.identifications) > 1 else ""
        for text in identification.undetected:
            yield IF_WRONG, f"{of_several}{text}"
    for identification in summary.identifications:
        yield from term_notes(identification.amplitudes)


def reason_notes(rows: Iterable[tuple[str, str, str]]) -> Iterator[tuple[str, str]]:
    """Yield the reasons of verdicts, each once; with what they are about where they differ.

    Parameters
    ----------
    rows : iterable of (label, verdict, reason)
    """
    by_verdict: dict[str, dict[str, list[str]]] = {}
    for label, verdict, reason in rows:
        if reason and not reason.startswith(_IN_TERM):
            by_verdict.setdefault(verdict, {}).setdefault(reason, []).append(label)
    for verdict, by_reason in by_verdict.items():
        for reason, labels in by_reason.items():
            names = "" if len(by_reason) == 1 else f"{', '.join(labels)}: "
            yield verdict, f"{names}{reason}"


def term_notes(amplitudes: Iterable[ParameterVerdict]) -> Iterator[tuple[str, str]]:
    """Yield the terms that amplitudes belong to, then the units of other constants."""
    terms: dict[str, None] = {}
    units: dict[str, None] = {}
    for amplitude in amplitudes:
        text = amplitude.reason.removeprefix(_IN_TERM)
        if text == amplitude.reason:
            continue
        if "[" in text:
            terms[text] = None
        else:
            units[f"{amplitude.name} in {text}"] = None
    if terms:
        yield "terms of delta", "; ".join([*terms, *units])


def noise_of_y(deviation: Sequence[float], noise: str) -> str:
    """Return the standard deviations of the noise of y, and what is known of it."""
    if not deviation:
        return noise
    return f"{numbers_text(deviation)}: {noise}".replace(": of y,", ",", 1)


def chance_text(part: IrregularPart) -> str:
    """Return with which probability guaranteed intervals hold, where that is not certain."""
    if part.confidence >= 1.0:
        return ""
    return f", noise within its bounds with probability {part.confidence:g}"


def guaranteed_texts(effect: IrregularEffect) -> tuple[str, str]:
    """Return a guaranteed interval, whose ends may be missing, and its first order, as texts."""
    lower = "-inf" if effect.lower is None else f"{effect.lower:.6g}"
    upper = "inf" if effect.upper is None else f"{effect.upper:.6g}"
    interval = f"{lower} to {upper}" if effect.is_explained else "none"
    reach = f"first order {effect.first_order:.2g} to each side"
    if not effect.holds:
        reach += ", which does not hold for so large a bound"
    return interval, reach
