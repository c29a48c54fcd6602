"""The certificate of a run as a table."""

from __future__ import annotations

from collections.abc import Iterator

from rich.table import Table

from cosim.report.certificate import CouplingShare, SignalCertificate, StepCertificate
from cosim.report.tables.console import new_table


def certificate_tables(certificate: StepCertificate | None) -> list[Table]:
    """Return the tables: what was tried where a step was searched for, then the errors.

    None: there are none.
    """
    if certificate is None:
        return []
    tables = [_search_table(certificate)] if certificate.trials else []
    return [*tables, _error_table(certificate)]


def _search_table(certificate: StepCertificate) -> Table:
    """Return the steps that were tried, with what was found, from the largest to the smallest."""
    table = new_table("steps that were tried", ("", ""))
    for step, text in search_rows(certificate):
        table.add_row(step, text)
    return table


def _error_table(certificate: StepCertificate) -> Table:
    """Return the table: estimates first, then signals without one, by the reason."""
    finer = " and ".join(f"{step:g} s" for step in certificate.finer_steps)
    title = f"error of the step of {certificate.step:g} s, by runs with {finer}"
    table = new_table(title, ("", "largest", "at t", "at the end", "order"))
    if certificate.problem:
        table.add_row("no estimate", "", "", "", certificate.problem)
        return table
    equal: list[str] = []
    reasons: dict[str, list[str]] = {}
    for signal in certificate.signals:
        if signal.largest is None:
            reasons.setdefault(signal.reason, []).append(signal.signal)
        elif signal.order is None:
            equal.append(signal.signal)
        else:
            _add_estimate(table, signal)
    if equal:
        table.add_row("0", "", "", "", f"the same in all three runs: {', '.join(equal)}")
    for reason, signals in reasons.items():
        table.add_row("no estimate", "", "", "", f"{', '.join(signals)}: {reason}")
    for share in certificate.shares:
        table.add_row(share.estimate, "", "", _number(share.coupling), share_text(share))
    for note in notes(certificate):
        table.add_row("note", "", "", "", note)
    return table


def search_rows(certificate: StepCertificate) -> Iterator[tuple[str, str]]:
    """Yield the steps that were tried, and what was found."""
    wanted = ", ".join(f"{signal} {value:g}" for signal, value in certificate.tolerances.items())
    for trial in sorted(certificate.trials, key=lambda trial: -trial.step):
        text = trial.failure
        if not text:
            text = f"within {wanted}"
            if trial.step == certificate.step:
                text += ": the largest step that is, of those that divide all given times"
        yield f"step {trial.step:g} s", text


def _add_estimate(table: Table, signal: SignalCertificate) -> None:
    unit = "" if signal.unit is None else f" {signal.unit}"
    table.add_row(
        signal.signal,
        f"{signal.largest:.3g}{unit}",
        f"{signal.time:g} s",
        _number(signal.last),
        f"{signal.order:.2f}",
    )


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:+.3g}"


def share_text(share: CouplingShare) -> str:
    """Return in words how much of an error is the coupling."""
    if share.coupling is None:
        return f"of its error, {share.error:+.3g} at the end, no part is known to be the coupling"
    if not share.error:
        return "it has no error at the end"
    part = 100.0 * share.coupling / share.error
    return f"of its error, {share.error:+.3g} at the end: {part:.2g} % is the coupling"


def notes(certificate: StepCertificate) -> list[str]:
    """Return what is to be known of the figures."""
    texts = []
    if certificate.solvers:
        names = ", ".join(certificate.solvers)
        texts.append(f"errors of the solvers inside {names} are in these figures, too")
    if len(set(certificate.ends)) > 1:
        ends = ", ".join(f"{end:g} s" for end in certificate.ends)
        first = f"{min(certificate.ends):g} s"
        texts.append(f"the three runs ended at {ends}; they are compared up to {first}")
    if certificate.every > 1:
        texts.append(f"compared at one communication point in {certificate.every}")
    return texts
