"""The tables of an identification from logs."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence

from rich.table import Table

from cosim.report.guaranteed import interval_text, reach_text
from cosim.report.identification import IdentificationReport, TimedPart
from cosim.report.summary import numbers_text
from cosim.report.tables.console import new_table, print_json, print_tables
from cosim.report.tables.estimates import IF_WRONG, reason_notes, term_notes
from cosim.scenario.identifying import IdentifierRecord, LogIdentification
from cosim.theory.assessment.consistency import NOTHING_ELSE, ResidualTest
from cosim.theory.assessment.documents import ParameterVerdict
from cosim.theory.assessment.validation import Validation
from cosim.theory.bounded.feasible_program import MOST_PROGRAMS_IN_ALL


def print_identification(report: IdentificationReport, *, as_json: bool) -> None:
    """Print what is said of logs."""
    if as_json:
        print_json(report.to_dict())
        return
    identification = report.identification
    tables = [
        _parameter_table(identification),
        _facts_table(report),
        _test_table(identification),
    ]
    for record, validation in report.validations:
        tables += _validation_tables(record, validation)
    if report.irregular is not None:
        tables.append(_irregular_table(report.irregular))
    print_tables(tables)


def _labelled(identification: LogIdentification) -> list[tuple[str, ParameterVerdict]]:
    """Return the verdicts on theta, then on the amplitudes of every log, with their labels."""
    rows = [(parameter.name, parameter) for parameter in identification.assessment.parameters]
    logs = identification.records
    for number, amplitudes in enumerate(identification.amplitudes, start=1):
        of_log = f", data set {number}" if len(logs) > 1 else ""
        rows += [(f"{amplitude.name}{of_log}", amplitude) for amplitude in amplitudes]
    return rows


def _parameter_table(identification: LogIdentification) -> Table:
    identifier = identification.records[0].identifier
    with_offset = " with offset" if identification.assessment.problem.offset else ""
    title = f"{identifier}: output error{with_offset}"
    columns = ("parameter", "estimate", "standard error", "95 % interval", "verdict")
    table = new_table(title, columns)
    for label, parameter in _labelled(identification):
        value = "no value" if parameter.value is None else f"{parameter.value:+.6g}"
        error = "" if parameter.standard_error is None else f"{parameter.standard_error:.2g}"
        interval = _interval(parameter.lower, parameter.upper)
        table.add_row(label, value, error, interval, str(parameter.verdict))
    return table


def _interval(lower: float | None, upper: float | None) -> str:
    if lower is None or upper is None:
        return ""
    return f"{lower:.6g} to {upper:.6g}"


def _facts_table(report: IdentificationReport) -> Table:
    """Return what verdicts rest on, the noise, and the logs."""
    identification = report.identification
    assessment = identification.assessment
    table = new_table("", ("", ""))
    labelled = _labelled(identification)
    _add_notes(table, labelled)
    for error in identification.undetected:
        table.add_row(IF_WRONG, str(error))
    for i, j in itertools.combinations(range(len(assessment.parameters)), 2):
        if assessment.fit.estimated[[i, j]].all():
            correlation = f"theta[{i}], theta[{j}]: {assessment.correlation[i, j]:+.3f}"
            table.add_row("correlation", correlation)
    noise = f"{numbers_text(assessment.deviations.tolist())}: {report.noise}"
    table.add_row("noise of y", noise.replace(": of y,", ",", 1))
    for text in identification.contradictions:
        table.add_row("contradiction", text)
    for index, record in enumerate(identification.records):
        x0 = ", ".join(f"{value:.4g}" for value in assessment.fit.x0[index])
        number = f"data set {index + 1}: " if len(identification.records) > 1 else ""
        table.add_row(record.log.label, f"{number}{record.data.samples} samples; x(0) {x0}")
    return table


def _add_notes(table: Table, labelled: Sequence[tuple[str, ParameterVerdict]]) -> None:
    """Add the reasons of verdicts, and the terms that amplitudes belong to."""
    triples = [(label, str(row.verdict), row.reason) for label, row in labelled]
    for verdict, text in reason_notes(triples):
        table.add_row(verdict, text)
    for label, text in term_notes([(row.name, row.reason) for _, row in labelled]):
        table.add_row(label, text)


def _test_table(identification: LogIdentification) -> Table:
    """Return the tests of the residual of every log."""
    table = new_table("", ("residual test", "statistic", "limit", "outcome"))
    for index, record in enumerate(identification.records):
        of_log = f"{record.log.label}: " if len(identification.records) > 1 else ""
        tests = identification.assessment.consistency.tests_by_data[index]
        _add_tests(table, tests, prefix=of_log)
    return table


def _add_tests(table: Table, tests: Iterable[ResidualTest], *, prefix: str = "") -> None:
    for test in tests:
        outcome = "passed" if test.passed else "failed"
        if test.largest and not test.passed:
            outcome += f" ({test.largest})"
        numbers = (f"{test.statistic:.3g}", f"{test.threshold:.3g}")
        table.add_row(f"{prefix}{test.name}", *numbers, outcome)


def _validation_tables(record: IdentifierRecord, validation: Validation) -> list[Table]:
    title = f"validation {record.log.label}"
    facts = new_table(title, ("", ""))
    facts.add_row(str(validation.verdict), validation.reason)
    size = f"{validation.ratio:.4g} times that of the fit"
    if validation.consistency.is_exact:
        size = f"at most {NOTHING_ELSE:g} times what step, quantization and rounding allow"
    facts.add_row("residual", f"standard deviation {validation.deviation:.3g}, {size}")
    tests = new_table("", ("residual test", "statistic", "limit", "outcome"))
    _add_tests(tests, [test for test in validation.tests if test.degrees])
    return [facts, tests]


def _irregular_table(timed: TimedPart) -> Table:
    part = timed.part
    chance = ""
    if part.confidence != 1.0:
        chance = f", noise within its bounds with probability {part.confidence:g}"
    text = f"all theta that explain the data{chance}; computed in {timed.seconds:.3g} s"
    if part.unsolved:
        text += (
            f"; {part.unsolved} starting points of the linear programs failed or exceeded "
            f"{MOST_PROGRAMS_IN_ALL} programs: there the interval is open"
        )
    table = new_table("", ("parameter", "guaranteed interval", ""))
    table.add_row(f"|delta_0| <= {part.bound:g}", "", text)
    for effect in part.effects:
        interval = interval_text(effect.lower, effect.upper, is_explained=effect.is_explained)
        reach = reach_text(effect.first_order, holds=effect.holds)
        table.add_row(effect.name, interval, reach)
    return table
