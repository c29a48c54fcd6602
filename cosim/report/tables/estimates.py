"""What is said of estimates, of runs and of logs: a table, and lines with what it rests on.

A line is a label and a text.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from rich.table import Table

from cosim.report.estimators import by_reason, numbers_text
from cosim.report.summary import Summary
from cosim.report.tables.console import new_table
from cosim.scenario.record import IrregularPart
from cosim.theory.documents import ParameterVerdict

_IN_TERM: Final = "in "  # begins the reason of an amplitude that names its term
IF_WRONG: Final = "if it is wrong"  # the model, behind the sentence that says "if it is right"
_SHOWN_RTOL: Final = 1e-6  # of values with six digits
_COLUMNS: Final = ("parameter", "estimate", "95 % interval", "truth", "error", "verdict")


def verdicts_of_run(summary: Summary) -> list[tuple[str, ParameterVerdict]]:
    """Return the verdicts of a run with their labels.

    Those of each identifier are followed by what output error says beside another method, and by
    amplitudes and phases.
    """
    verdicts = []
    for own in summary.identifications:
        verdicts += [(one.name, one) for one in own.parameters]
        prefix = "" if len(summary.identifications) > 1 else f"{own.component}."
        for one in own.reference:
            verdicts.append((f"{one.name.removeprefix(prefix)}, output error", one))
        verdicts += [(one.name, one) for one in own.amplitudes]
    return verdicts


def undetected_in_run(summary: Summary) -> Iterator[str]:
    """Yield which errors of the models of a run would pass; of several with the identifier."""
    for own in summary.identifications:
        prefix = f"{own.component}: " if len(summary.identifications) > 1 else ""
        yield from (f"{prefix}{text}" for text in own.undetected)


def estimate_table(summary: Summary) -> Table:
    """Return the constants that a run estimates, those with a truth first.

    Such a one has two rows where its signal ends with another value than that of its verdict.
    Columns that no row has are left out.
    """
    verdicts = verdicts_of_run(summary)
    by_label = dict(verdicts)
    truths = {own.estimate: own for own in summary.values}
    rows = []
    for label, own in truths.items():
        verdict = by_label.get(label)
        if verdict is None:
            rows.append(_estimate_row(label, own.value, own.truth))
            continue
        value = verdict.value
        if own.value is not None:
            shown = math.nan if value is None else value
            if math.isclose(own.value, shown, rel_tol=_SHOWN_RTOL):
                value = own.value
            else:
                rows.append(_estimate_row(f"{label} (signal)", own.value, own.truth))
        rows.append(_estimate_row(label, value, own.truth, verdict))
    for label, verdict in verdicts:
        if label not in truths:
            rows.append(_estimate_row(label, verdict.value, None, verdict))
    columns = zip(_COLUMNS, *rows, strict=True)
    shown_columns = [column for column in columns if any(column[1:])]
    header, *cells = zip(*shown_columns, strict=True) if rows else [()]
    return new_table("", header, cells)


def _estimate_row(
    label: str, value: float | None, truth: float | None, verdict: ParameterVerdict | None = None
) -> tuple[str, ...]:
    width = None if verdict is None else verdict.half_width
    return (
        label,
        value_text(value),
        "" if width is None else f"± {width:.2g}",
        "" if truth is None else f"{truth:+g}",
        "" if truth is None or value is None else f"{abs(value - truth):.3g}",
        "" if verdict is None else verdict.verdict,
    )


def value_text(value: float | None) -> str:
    """Return an estimate with its sign and six digits."""
    return "no value" if value is None else f"{value:+.6g}"


def verdict_lines(
    verdicts: Sequence[tuple[str, ParameterVerdict]], undetected: Iterable[str]
) -> Iterator[tuple[str, str]]:
    """Yield the reasons of verdicts, each once, what they do not see, and terms of amplitudes.

    Reasons say what they are of where those of a verdict differ.

    Parameters
    ----------
    verdicts : sequence of (label, ParameterVerdict)
    undetected : iterable of str
        Errors of the model that would pass.
    """
    reasons = []
    terms: dict[str, None] = {}
    for label, one in verdicts:
        term = one.reason.removeprefix(_IN_TERM)
        if term == one.reason:
            reasons.append((str(one.verdict), one.reason, label))
        else:  # it is a term, or the unit of a constant of one
            terms[term if "[" in term else f"{one.name} in {term}"] = None
    groups = by_reason(row for row in reasons if row[1])
    for (verdict, reason), labels in groups.items():
        is_only = sum(verdict == other for other, _ in groups) == 1
        yield verdict, reason if is_only else f"{', '.join(labels)}: {reason}"
    for text in undetected:
        yield IF_WRONG, text
    if terms:
        yield "terms of delta", "; ".join(terms)


def noise_line(deviation: Sequence[float], noise: str) -> tuple[str, str]:
    """Return the standard deviations of the noise of y, and what is known of it."""
    if deviation:
        noise = f"{numbers_text(deviation)}: {noise.removeprefix('of y, ')}"
    return "noise of y", noise


def guaranteed_lines(part: IrregularPart) -> Iterator[tuple[str, str]]:
    """Yield what an irregular part of the disturbance within its bound leaves open of theta.

    Of each the interval, whose ends may be missing, and how far the first order reaches.
    """
    label = f"|delta_0| <= {part.bound:g}"
    if part.problem:
        yield label, part.problem
        return
    text = "guaranteed intervals by output error"
    if part.confidence < 1.0:
        text += f", noise within its bounds with probability {part.confidence:g}"
    if part.unsolved:
        text += (
            f"; {part.unsolved} starting points of the linear programs failed or exceeded their "
            "number: there the interval is open"
        )
    yield label, f"{text}:"
    for effect in part.effects:
        lower = "-inf" if effect.lower is None else f"{effect.lower:.6g}"
        upper = "inf" if effect.upper is None else f"{effect.upper:.6g}"
        interval = f"{lower} to {upper}" if effect.is_explained else "none"
        reach = f"first order {effect.first_order:.2g} to each side"
        if not effect.holds:
            reach += ", which does not hold for so large a bound"
        yield effect.name, f"{interval}; {reach}"
