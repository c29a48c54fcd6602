"""The table of an identification from logs."""

from __future__ import annotations

import itertools

from rich.table import Table

from cosim.report.guaranteed import interval_text, reach_text
from cosim.report.identification import IdentificationReport, TimedPart
from cosim.report.summary import numbers_text
from cosim.report.tables.console import new_table, print_json, print_table
from cosim.scenario.identifying import IdentifierRecord, LogIdentification
from cosim.theory.assessment.consistency import NOTHING_ELSE, ResidualTest
from cosim.theory.assessment.validation import Validation
from cosim.theory.assessment.verdicts import ParameterVerdict
from cosim.theory.bounded.feasible_program import MOST_PROGRAMS_IN_ALL


def print_identification(report: IdentificationReport, *, as_json: bool) -> None:
    """Print what is said of logs."""
    if as_json:
        print_json(report.to_dict())
        return
    identification = report.identification
    assessment = identification.assessment
    identifier = identification.records[0].identifier
    columns = ("", "estimate", "standard error", "95 % interval", "")
    has_offset = assessment.problem.offset
    table = new_table(f"{identifier}: output error{' with offset' * has_offset}", columns)
    for parameter in assessment.parameters:
        _add_parameter(table, parameter)
    for i, j in itertools.combinations(range(len(assessment.parameters)), 2):
        if assessment.fit.estimated[[i, j]].all():
            correlation = f"{assessment.correlation[i, j]:+.3f}"
            table.add_row("correlation", correlation, "", "", f"of theta[{i}] and theta[{j}]")
    table.add_row("noise", numbers_text(assessment.deviations.tolist()), "", "", report.noise)
    for text in identification.contradictions:
        table.add_row("contradiction", "", "", "", text)
    for index in range(len(identification.records)):
        _add_log(table, identification, index)
    for record, validation in report.validations:
        _add_validation(table, record, validation)
    if report.irregular is not None:
        _add_irregular(table, report.irregular)
    print_table(table)


def _add_log(table: Table, identification: LogIdentification, index: int) -> None:
    """Add what is of one log: x(0), amplitudes and phases, and the tests of its residual."""
    record = identification.records[index]
    fit = identification.assessment.fit
    x0 = ", ".join(f"{value:.4g}" for value in fit.x0[index])
    number = f"data set {index + 1}: " if len(identification.records) > 1 else ""
    text = f"{number}{record.data.samples} samples; x(0) {x0}"
    table.add_row(record.log.label, "", "", "", text)
    for amplitude in identification.amplitudes[index]:
        _add_parameter(table, amplitude)
    for test in identification.assessment.consistency.tests_by_data[index]:
        _add_test(table, test)


def _add_parameter(table: Table, parameter: ParameterVerdict) -> None:
    value = "no value" if parameter.value is None else f"{parameter.value:+.6g}"
    error = "" if parameter.standard_error is None else f"{parameter.standard_error:.2g}"
    interval = _interval(parameter.lower, parameter.upper)
    text = f"{parameter.verdict}: {parameter.reason}"
    table.add_row(parameter.name, value, error, interval, text)


def _interval(lower: float | None, upper: float | None) -> str:
    if lower is None or upper is None:
        return ""
    return f"{lower:.6g} to {upper:.6g}"


def _add_test(table: Table, test: ResidualTest) -> None:
    outcome = "passed" if test.passed else "failed"
    where = f" ({test.largest})" if test.largest and not test.passed else ""
    text = f"{outcome}: noise leaves up to {test.threshold:.3g}{where}"
    table.add_row(test.name, f"{test.statistic:.3g}", "", "", text)


def _add_validation(table: Table, record: IdentifierRecord, validation: Validation) -> None:
    table.add_section()
    text = f"{validation.verdict}: {validation.reason}"
    table.add_row(f"validation {record.log.label}", "", "", "", text)
    size = f"of the residual with theta held: {validation.ratio:.4g} times that of the fit"
    if validation.consistency.is_exact:
        size = (
            f"the residual with theta held is at most {NOTHING_ELSE:g} times what step, "
            "quantization and rounding allow"
        )
    table.add_row("deviation", f"{validation.deviation:.3g}", "", "", size)
    for test in validation.tests:
        if test.degrees:
            _add_test(table, test)


def _add_irregular(table: Table, timed: TimedPart) -> None:
    table.add_section()
    part = timed.part
    chance = "" if part.confidence == 1.0 else f", noise within its bounds with {part.confidence:g}"
    text = f"every theta that explains the data{chance}; computed in {timed.seconds:.3g} s"
    if part.unsolved:
        text += (
            f"; from {part.unsolved} starts the linear programs could not be solved, or not within "
            f"{MOST_PROGRAMS_IN_ALL} of them, so the data show no end"
        )
    table.add_row(f"|delta_0| <= {part.bound:g}", "", "", "guaranteed", text)
    for effect in part.effects:
        interval = interval_text(effect.lower, effect.upper, is_explained=effect.is_explained)
        reach = reach_text(effect.first_order, holds=effect.holds)
        table.add_row(effect.name, "", "", interval, reach)
