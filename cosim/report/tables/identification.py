"""What logs say about theta, after their runs, as tables and as JSON."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
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
from cosim.scenario.recordings.verdicts import verdicts_of
from cosim.scenario.running.identifying import LogIdentification
from cosim.theory.assessment.consistency import NOTHING_ELSE, ResidualTest
from cosim.theory.assessment.validation import Validation
from cosim.theory.documents import ParameterVerdict


def show_identification(
    found: LogIdentification,
    validations: Mapping[str, Validation],
    irregular: IrregularPart | None,
    seconds: float,
) -> Shown:
    """Show what is said of logs.

    Parameters
    ----------
    found : LogIdentification
    validations : mapping of label to Validation
        Of logs that were not used in the fit.
    irregular : IrregularPart or None
        What an irregular part within a bound leaves open.
    seconds : float
        What it cost to compute that [s].
    """
    content = _content(found)
    if validations:
        content["validation"] = [
            {"log": label, **validation.to_dict()} for label, validation in validations.items()
        ]
    more = list(_lines_of_logs(found))
    if irregular is not None:
        content["irregular"] = {**irregular.to_dict(), "seconds": seconds}
        more += [*guaranteed_lines(irregular), ("", f"computed in {seconds:.3g} s")]
    yield content
    several = len(found.records) > 1
    verdicts = [(one.name, one) for one in found.assessment.parameters]
    tests: list[tuple[str, ...]] = []
    for index, record in enumerate(found.records):
        of_set = f", data set {index + 1}" if several else ""
        verdicts += [(f"{one.name}{of_set}", one) for one in found.amplitudes[index]]
        of_log = f"{record.log.label}: " if several else ""
        tests += _test_rows(found.assessment.consistency.tests_by_data[index], of_log)
    with_offset = " with offset" if found.assessment.problem.offset else ""
    tables = [
        _estimate_table(f"{found.records[0].identifier}: output error{with_offset}", verdicts),
        new_table("", ("", ""), [*verdict_lines(verdicts, map(str, found.undetected)), *more]),
        _test_table(tests),
    ]
    for label, validation in validations.items():
        size = f"{validation.ratio:.4g} times that of the fit"
        if validation.consistency.is_exact:
            size = f"at most {NOTHING_ELSE:g} times what step, quantization and rounding allow"
        lines = [
            (str(validation.verdict), validation.reason),
            ("residual", f"standard deviation {validation.deviation:.3g}, {size}"),
        ]
        tables.append(new_table(f"validation {label}", ("", ""), lines))
        tables.append(_test_table(_test_rows(test for test in validation.tests if test.degrees)))
    yield tables


def _content(found: LogIdentification) -> dict[str, Any]:
    """Return what JSON says of a fit."""
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
    return {
        "identifier": found.records[0].identifier,
        "offset": found.assessment.problem.offset,
        **found.assessment.to_dict(),
        "undetected": list(map(plain, found.undetected)),
        "logs": logs,
        "contradictions": list(found.contradictions),
    }


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


def _lines_of_logs(found: LogIdentification) -> Iterator[tuple[str, str]]:
    """Yield the correlations of estimates, the noise, and the logs."""
    assessment = found.assessment
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


def _test_rows(tests: Iterable[ResidualTest], prefix: str = "") -> Iterator[tuple[str, ...]]:
    for test in tests:
        outcome = "passed" if test.passed else "failed"
        if test.largest and not test.passed:
            outcome += f" ({test.largest})"
        yield f"{prefix}{test.name}", f"{test.statistic:.3g}", f"{test.threshold:.3g}", outcome


def _test_table(rows: Iterable[tuple[str, ...]]) -> Table:
    return new_table("", ("residual test", "statistic", "limit", "outcome"), rows)
