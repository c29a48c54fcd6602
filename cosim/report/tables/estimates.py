"""The table of estimated constants after a run, with what is common to several said once below."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final

from rich.table import Table

from cosim.report.summary import Identification, Summary, ValueOutcome
from cosim.report.tables.console import new_table
from cosim.theory.assessment.documents import ParameterVerdict

_IN_TERM: Final = "in "  # begins the reason of an amplitude that names its term
IF_WRONG: Final = "if it is wrong"  # the model, behind the sentence that says "if it is right"
_SHOWN_RTOL: Final = 1e-6  # of values with six digits


@dataclass(frozen=True, slots=True)
class EstimateRow:
    """An estimated constant: what it is, its truth where that is known, and its verdict.

    Parameters
    ----------
    label, estimate, half_width, truth, error, verdict : str
    reason : str
        Of the verdict.
    """

    label: str
    estimate: str
    half_width: str = ""
    truth: str = ""
    error: str = ""
    verdict: str = ""
    reason: str = ""


def estimate_rows(summary: Summary) -> list[EstimateRow]:
    """Return the rows of a run, those with a truth first."""
    outcomes = {outcome.estimate: outcome for outcome in summary.values}
    parameters: dict[str, ParameterVerdict] = {}
    rows: list[EstimateRow] = []
    others: list[EstimateRow] = []
    for identification in summary.identifications:
        for parameter in identification.parameters:
            parameters[parameter.estimate] = parameter
            if parameter.estimate not in outcomes:
                others.append(_parameter_row(parameter.estimate, parameter))
        others += _further_rows(identification, single=len(summary.identifications) == 1)
    for name, outcome in outcomes.items():
        rows += _outcome_rows(outcome, parameters.get(name))
    return [*rows, *others]


def _further_rows(identification: Identification, *, single: bool) -> Iterator[EstimateRow]:
    """Yield what output error says beside another method, then amplitudes and phases."""
    for parameter in identification.reference:
        name = parameter.estimate.partition(".")[2] if single else parameter.estimate
        yield _parameter_row(f"{name}, output error", parameter)
    for amplitude in identification.amplitudes:
        yield _parameter_row(amplitude.estimate, amplitude)


def _outcome_rows(
    outcome: ValueOutcome, parameter: ParameterVerdict | None
) -> Iterator[EstimateRow]:
    """Yield a row; two where the signal ends with another value than that of the verdict."""
    truth = f"{outcome.truth:+g}"
    error = "" if outcome.error is None else f"{outcome.error:.3g}"
    shown = "no value" if outcome.value is None else f"{outcome.value:+.6g}"
    if parameter is None:
        yield EstimateRow(outcome.estimate, shown, truth=truth, error=error)
        return
    if outcome.value is not None and not _is_shown_alike(outcome.value, parameter.value):
        yield EstimateRow(f"{outcome.estimate} (signal)", shown, truth=truth, error=error)
        error = ""
    if not error and parameter.value is not None:
        error = f"{abs(parameter.value - outcome.truth):.3g}"
    yield _parameter_row(outcome.estimate, parameter, truth=truth, error=error)


def _is_shown_alike(value: float, other: float | None) -> bool:
    if other is None:
        return False
    return abs(value - other) <= _SHOWN_RTOL * max(abs(value), abs(other))


def _parameter_row(
    label: str, parameter: ParameterVerdict, *, truth: str = "", error: str = ""
) -> EstimateRow:
    estimate = "no value" if parameter.value is None else f"{parameter.value:+.6g}"
    half_width = "" if parameter.half_width is None else f"± {parameter.half_width:.2g}"
    verdict = parameter.verdict
    return EstimateRow(label, estimate, half_width, truth, error, verdict, parameter.reason)


def estimate_table(rows: list[EstimateRow]) -> Table:
    """Return the table, without the columns that no row has."""
    columns = {
        "estimate": "estimate",
        "half_width": "95 % interval",
        "truth": "truth",
        "error": "error",
    }
    columns |= {"verdict": "verdict"}
    shown = [name for name in columns if any(getattr(row, name) for row in rows)]
    table = new_table("", ("parameter", *(columns[name] for name in shown)))
    for row in rows:
        table.add_row(row.label, *(getattr(row, name) for name in shown))
    return table


def estimate_notes(summary: Summary) -> Iterator[tuple[str, str]]:
    """Yield the reasons of verdicts, each once, what they do not see, and terms of amplitudes."""
    rows = estimate_rows(summary)
    yield from reason_notes([(row.label, row.verdict, row.reason) for row in rows])
    for identification in summary.identifications:
        of_several = f"{identification.component}: " if len(summary.identifications) > 1 else ""
        for text in identification.undetected:
            yield IF_WRONG, f"{of_several}{text}"
    for identification in summary.identifications:
        amplitudes = identification.amplitudes
        yield from term_notes([(amplitude.estimate, amplitude.reason) for amplitude in amplitudes])


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


def term_notes(amplitudes: Iterable[tuple[str, str]]) -> Iterator[tuple[str, str]]:
    """Yield the terms that amplitudes belong to, then the units of other constants.

    Parameters
    ----------
    amplitudes : iterable of (name, reason)
    """
    terms: dict[str, None] = {}
    units: dict[str, None] = {}
    for name, reason in amplitudes:
        text = reason.removeprefix(_IN_TERM)
        if not reason.startswith(_IN_TERM):
            continue
        if "[" in text:
            terms[text] = None
        else:
            units[f"{name} in {text}"] = None
    if terms:
        yield "terms of delta", "; ".join([*terms, *units])
