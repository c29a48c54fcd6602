"""What logs say about theta, after their runs, as tables and as JSON."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

from rich.table import Table

from cosim.documents import plain
from cosim.report.estimators import (
    guaranteed_lines,
    noise_line,
    noise_text,
    value_text,
    verdict_lines,
)
from cosim.report.tables.console import Shown, new_table
from cosim.scenario.record import IrregularPart
from cosim.scenario.recordings.verdicts import irregular_part, verdicts_of
from cosim.scenario.running.identifying import IdentifierRecord, LogIdentification
from cosim.theory.assessment.consistency import NOTHING_ELSE, ResidualTest
from cosim.theory.assessment.validation import Validation, ValidationVerdict
from cosim.theory.bounded.feasible_program import Watch
from cosim.theory.documents import ParameterVerdict


@dataclass(frozen=True, eq=False)
class IdentificationReport:
    """What is said of logs.

    Parameters
    ----------
    identification : LogIdentification
    validations : tuple of (IdentifierRecord, Validation)
    irregular : IrregularPart or None
        What an irregular part within a bound leaves open.
    seconds : float
        What it cost to compute that [s].
    """

    identification: LogIdentification
    validations: tuple[tuple[IdentifierRecord, Validation], ...] = ()
    irregular: IrregularPart | None = None
    seconds: float = 0.0

    @property
    def failed(self) -> bool:
        """Whether the model does not hold for a log that was not used."""
        return any(own.verdict is ValidationVerdict.FAILS for _, own in self.validations)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        found = self.identification
        fit = found.assessment.fit
        logs = []
        for index, record in enumerate(found.records):
            log = {
                "log": record.log.label,
                "samples": record.data.samples,
                "amplitudes": list(map(plain, found.amplitudes[index])),
                "x0": fit.x0[index].tolist(),
                "offset": fit.offset[index].tolist(),
            }
            logs.append(log)
        content: dict[str, Any] = {
            "identifier": found.records[0].identifier,
            "offset": found.assessment.problem.offset,
            **found.assessment.to_dict(),
            "undetected": list(map(plain, found.undetected)),
            "logs": logs,
            "contradictions": list(found.contradictions),
        }
        if self.validations:
            content["validation"] = [
                {"log": other.log.label, **own.to_dict()} for other, own in self.validations
            ]
        if self.irregular is not None:
            content["irregular"] = {**self.irregular.to_dict(), "seconds": self.seconds}
        return content


def report_identification(
    identification: LogIdentification,
    *,
    others: Sequence[IdentifierRecord] = (),
    irregular: float | None = None,
    watch: Watch | None = None,
) -> IdentificationReport:
    """Collect what is said of a fit.

    Parameters
    ----------
    identification : LogIdentification
    others : sequence of IdentifierRecord
        Of logs that were not used, which the fit is held against.
    irregular : float, optional
        Bound of an irregular part of the disturbance.
    watch : callable, optional
        Is told after every linear program for it how many have been solved.

    Raises
    ------
    UsageError
        If one of the others is of another model, or an irregular part cannot be bounded for.
    """
    validations = tuple((other, identification.validate(other)) for other in others)
    began = perf_counter()
    part = None
    if irregular is not None:
        part = irregular_part(irregular, identification.guaranteed_interval(irregular, watch))
    return IdentificationReport(identification, validations, part, perf_counter() - began)


def show_identification(report: IdentificationReport) -> Shown:
    """Show what is said of logs."""
    yield report.to_dict()
    found = report.identification
    several = len(found.records) > 1
    verdicts = [(one.name, one) for one in found.assessment.parameters]
    tests: list[tuple[str, ...]] = []
    for index, record in enumerate(found.records):
        of_set = f", data set {index + 1}" if several else ""
        verdicts += [(f"{one.name}{of_set}", one) for one in found.amplitudes[index]]
        of_log = f"{record.log.label}: " if several else ""
        tests += _test_rows(found.assessment.consistency.tests_by_data[index], of_log)
    with_offset = " with offset" if found.assessment.problem.offset else ""
    title = f"{found.records[0].identifier}: output error{with_offset}"
    tables = [
        _estimate_table(title, verdicts),
        new_table("", ("", ""), _lines(report, verdicts)),
        _test_table(tests),
    ]
    for record, validation in report.validations:
        size = f"{validation.ratio:.4g} times that of the fit"
        if validation.consistency.is_exact:
            size = f"at most {NOTHING_ELSE:g} times what step, quantization and rounding allow"
        lines = [
            (str(validation.verdict), validation.reason),
            ("residual", f"standard deviation {validation.deviation:.3g}, {size}"),
        ]
        tables.append(new_table(f"validation {record.log.label}", ("", ""), lines))
        tables.append(_test_table(_test_rows(test for test in validation.tests if test.degrees)))
    yield tables


def _estimate_table(title: str, verdicts: Sequence[tuple[str, ParameterVerdict]]) -> Table:
    rows = []
    for label, own in verdicts:
        error = "" if own.standard_error is None else f"{own.standard_error:.2g}"
        interval = ""
        if own.lower is not None and own.upper is not None:
            interval = f"{own.lower:.6g} to {own.upper:.6g}"
        rows.append((label, value_text(own.value), error, interval, own.verdict))
    columns = ("parameter", "estimate", "standard error", "95 % interval", "verdict")
    return new_table(title, columns, rows)


def _lines(
    report: IdentificationReport, verdicts: Sequence[tuple[str, ParameterVerdict]]
) -> Iterator[tuple[str, str]]:
    """Yield what verdicts rest on, the noise, the logs, and what an irregular part leaves open."""
    found = report.identification
    assessment = found.assessment
    yield from verdict_lines(verdicts, map(str, found.undetected))
    for i, j in itertools.combinations(range(len(assessment.parameters)), 2):
        if assessment.fit.estimated[[i, j]].all():
            yield "correlation", f"theta[{i}], theta[{j}]: {assessment.correlation[i, j]:+.3f}"
    noise = verdicts_of(assessment)
    yield noise_line(noise.deviation, noise_text(noise))
    for text in found.contradictions:
        yield "contradiction", text
    for index, record in enumerate(found.records):
        x0 = ", ".join(f"{value:.4g}" for value in assessment.fit.x0[index])
        number = f"data set {index + 1}: " if len(found.records) > 1 else ""
        yield record.log.label, f"{number}{record.data.samples} samples; x(0) {x0}"
    if report.irregular is not None:
        yield from guaranteed_lines(report.irregular)
        yield "", f"computed in {report.seconds:.3g} s"


def _test_rows(tests: Iterable[ResidualTest], prefix: str = "") -> Iterator[tuple[str, ...]]:
    for test in tests:
        outcome = "passed" if test.passed else "failed"
        if test.largest and not test.passed:
            outcome += f" ({test.largest})"
        yield f"{prefix}{test.name}", f"{test.statistic:.3g}", f"{test.threshold:.3g}", outcome


def _test_table(rows: Iterable[tuple[str, ...]]) -> Table:
    return new_table("", ("residual test", "statistic", "limit", "outcome"), rows)
