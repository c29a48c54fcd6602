"""The certificate of a run as a table."""

from __future__ import annotations

from collections.abc import Iterator

from rich.table import Table

from cosim.report.certificate import CouplingShare, SignalCertificate, StepCertificate
from cosim.report.tables.console import new_table


def certificate_tables(certificate: StepCertificate | None) -> list[Table]:
    """Return the tables: the search for the step where there was one, the errors, and notes."""
    if certificate is None:
        return []
    tables = []
    if certificate.trials:
        search = new_table("search for the communication step", ("", ""))
        for step, text in search_rows(certificate):
            search.add_row(step, text)
        tables.append(search)
    finer = " and ".join(f"{step:g} s" for step in certificate.finer_steps)
    title = f"error of the communication step {certificate.step:g} s, from runs with {finer}"
    errors = new_table(title, ("signal", "largest", "at t", "at the end", "order"))
    for signal in certificate.signals:
        if signal.is_bounded or (signal.largest is not None and signal.order is not None):
            _add_estimate(errors, signal)
    below = new_table("" if errors.rows else title, ("", ""))
    for label, text in _notes_below(certificate):
        below.add_row(label, text)
    return [*tables, *(table for table in (errors, below) if table.rows)]


def _notes_below(certificate: StepCertificate) -> Iterator[tuple[str, str]]:
    """Yield signals without an estimate by the reason, shares of errors, then notes."""
    if certificate.problem:
        yield "no estimate", certificate.problem
        return
    equal: list[str] = []
    reasons: dict[tuple[str, str], list[str]] = {}
    for signal in certificate.signals:
        if signal.largest is None:
            label = "upper bound" if signal.is_bounded else "no estimate"
            reasons.setdefault((label, signal.reason), []).append(signal.signal)
        elif signal.order is None:
            equal.append(signal.signal)
    if equal:
        yield "no error", f"{', '.join(equal)}: identical in all three runs"
    for (label, reason), signals in reasons.items():
        yield label, f"{', '.join(signals)}: {reason}"
    for share in certificate.shares:
        yield share.estimate, share_text(share)
    for note in notes(certificate):
        yield "note", note


def search_rows(certificate: StepCertificate) -> Iterator[tuple[str, str]]:
    """Yield the steps that were tried, and what was found."""
    wanted = ", ".join(f"{signal} {value:g}" for signal, value in certificate.tolerances.items())
    for trial in sorted(certificate.trials, key=lambda trial: -trial.step):
        text = trial.failure
        if not text:
            text = f"within {wanted}"
            if trial.step == certificate.step:
                text += ": the largest such step that divides all given times"
        yield f"step {trial.step:g} s", text


def _add_estimate(table: Table, signal: SignalCertificate) -> None:
    unit = "" if signal.unit is None else f" {signal.unit}"
    largest = f"at most {signal.bound:.3g}" if signal.is_bounded else f"{signal.largest:.3g}"
    table.add_row(
        signal.signal,
        f"{largest}{unit}",
        "" if signal.time is None else f"{signal.time:g} s",
        _number(signal.last),
        "" if signal.order is None else f"{signal.order:.2f}",
    )


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:+.3g}"


def share_text(share: CouplingShare) -> str:
    """Return in words how much of an error is the coupling."""
    if not share.error:
        return "no error at the end"
    text = f"error {share.error:+.3g} at the end"
    if share.coupling is None:
        return f"{text}; the share of the coupling is not known"
    part = 100.0 * share.coupling / share.error
    return f"{text}, of which {share.coupling:+.3g} ({part:.2g} %) is coupling error"


def notes(certificate: StepCertificate) -> list[str]:
    """Return what is to be known of the figures."""
    texts = []
    if certificate.solvers:
        names = ", ".join(certificate.solvers)
        texts.append(f"includes the solver errors of {names}")
    if len(set(certificate.ends)) > 1:
        ends = ", ".join(f"{end:g} s" for end in certificate.ends)
        first = f"{min(certificate.ends):g} s"
        texts.append(f"the three runs ended at {ends}; compared up to {first}")
    if certificate.every > 1:
        texts.append(f"compared at every {certificate.every}th communication point")
    return texts
