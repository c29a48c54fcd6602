"""What logs say about theta, after their runs, as tables and as JSON."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any, Final

from rich.table import Table

from cosim.documents import plain
from cosim.report.estimators import noise_text
from cosim.report.tables.console import new_table, print_json, print_tables
from cosim.report.tables.estimates import (
    IF_WRONG,
    chance_text,
    guaranteed_texts,
    noise_of_y,
    reason_notes,
    term_notes,
    value_text,
)
from cosim.scenario.kinds.irregular import irregular_part
from cosim.scenario.kinds.run_verdicts import verdicts_of
from cosim.scenario.record import IrregularPart
from cosim.scenario.running.identifying import IdentifierRecord, LogIdentification
from cosim.theory.assessment.consistency import NOTHING_ELSE, ResidualTest
from cosim.theory.assessment.validation import Validation, ValidationVerdict
from cosim.theory.bounded.feasible_program import MOST_PROGRAMS_IN_ALL, Watch
from cosim.theory.documents import ParameterVerdict

_TESTS: Final = ("residual test", "statistic", "limit", "outcome")


@dataclass(frozen=True, eq=False, kw_only=True)
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
        return any(
            validation.verdict is ValidationVerdict.FAILS for _, validation in self.validations
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        found = self.identification
        fit = found.assessment.fit
        logs = [
            {
                "log": record.log.label,
                "samples": record.data.samples,
                "amplitudes": list(map(plain, found.amplitudes[i])),
                "x0": fit.x0[i].tolist(),
                "offset": fit.offset[i].tolist(),
            }
            for i, record in enumerate(found.records)
        ]
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
                {"log": record.log.label, **validation.to_dict()}
                for record, validation in self.validations
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
    return IdentificationReport(
        identification=identification,
        validations=validations,
        irregular=part,
        seconds=perf_counter() - began,
    )


def print_identification(report: IdentificationReport, *, as_json: bool) -> None:
    """Print what is said of logs."""
    if as_json:
        print_json(report.to_dict())
        return
    found = report.identification
    several = len(found.records) > 1
    verdicts = [(parameter.name, parameter) for parameter in found.assessment.parameters]
    tests: list[tuple[str, ...]] = []
    for index, record in enumerate(found.records):
        of_set = f", data set {index + 1}" if several else ""
        verdicts += [(f"{one.name}{of_set}", one) for one in found.amplitudes[index]]
        of_log = f"{record.log.label}: " if several else ""
        tests += _test_rows(found.assessment.consistency.tests_by_data[index], of_log)
    with_offset = " with offset" if found.assessment.problem.offset else ""
    title = f"{found.records[0].identifier}: output error{with_offset}"
    rows = []
    for label, verdict in verdicts:
        error = "" if verdict.standard_error is None else f"{verdict.standard_error:.2g}"
        interval = ""
        if verdict.lower is not None and verdict.upper is not None:
            interval = f"{verdict.lower:.6g} to {verdict.upper:.6g}"
        rows.append((label, value_text(verdict.value), error, interval, verdict.verdict))
    columns = ("parameter", "estimate", "standard error", "95 % interval", "verdict")
    tables = [
        new_table(title, columns, rows),
        new_table("", ("", ""), _facts(report, verdicts)),
        new_table("", _TESTS, tests),
    ]
    for record, validation in report.validations:
        tables += _validation_tables(record, validation)
    if report.irregular is not None:
        tables.append(_irregular_table(report.irregular, report.seconds))
    print_tables(tables)


def _facts(
    report: IdentificationReport, verdicts: list[tuple[str, ParameterVerdict]]
) -> Iterator[tuple[str, str]]:
    """Yield what verdicts rest on, the noise, and the logs."""
    found = report.identification
    assessment = found.assessment
    noise = verdicts_of(assessment)
    yield from reason_notes((label, one.verdict, one.reason) for label, one in verdicts)
    yield from term_notes(one for _, one in verdicts)
    for error in found.undetected:
        yield IF_WRONG, str(error)
    for i, j in itertools.combinations(range(len(assessment.parameters)), 2):
        if assessment.fit.estimated[[i, j]].all():
            yield "correlation", f"theta[{i}], theta[{j}]: {assessment.correlation[i, j]:+.3f}"
    yield "noise of y", noise_of_y(noise.deviation, noise_text(noise))
    for text in found.contradictions:
        yield "contradiction", text
    for index, record in enumerate(found.records):
        x0 = ", ".join(f"{value:.4g}" for value in assessment.fit.x0[index])
        number = f"data set {index + 1}: " if len(found.records) > 1 else ""
        yield record.log.label, f"{number}{record.data.samples} samples; x(0) {x0}"


def _test_rows(tests: Iterable[ResidualTest], prefix: str = "") -> Iterator[tuple[str, ...]]:
    for test in tests:
        outcome = "passed" if test.passed else "failed"
        if test.largest and not test.passed:
            outcome += f" ({test.largest})"
        yield f"{prefix}{test.name}", f"{test.statistic:.3g}", f"{test.threshold:.3g}", outcome


def _validation_tables(record: IdentifierRecord, validation: Validation) -> list[Table]:
    size = f"{validation.ratio:.4g} times that of the fit"
    if validation.consistency.is_exact:
        size = f"at most {NOTHING_ELSE:g} times what step, quantization and rounding allow"
    facts = [
        (str(validation.verdict), validation.reason),
        ("residual", f"standard deviation {validation.deviation:.3g}, {size}"),
    ]
    tests = _test_rows(test for test in validation.tests if test.degrees)
    return [
        new_table(f"validation {record.log.label}", ("", ""), facts),
        new_table("", _TESTS, tests),
    ]


def _irregular_table(part: IrregularPart, seconds: float) -> Table:
    text = f"all theta that explain the data{chance_text(part)}; computed in {seconds:.3g} s"
    if part.unsolved:
        text += (
            f"; {part.unsolved} starting points of the linear programs failed or exceeded "
            f"{MOST_PROGRAMS_IN_ALL} programs: there the interval is open"
        )
    rows = [(f"|delta_0| <= {part.bound:g}", "", text)]
    rows += [(effect.name, *guaranteed_texts(effect)) for effect in part.effects]
    return new_table("", ("parameter", "guaranteed interval", ""), rows)
