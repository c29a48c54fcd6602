"""Compare what a member came to when it ran again with what is recorded of it, bit for bit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from cosim.studies.contracts import FAILED, MemberOutcome

_HANGS: Final = "hangs: "  # and how long it was waited for, which is not of the member


def same_value(one: Any, other: Any) -> bool:
    """Return whether two metrics have the same bits: zeros of either sign differ."""
    return type(one) is type(other) and repr(one) == repr(other)


def same_reason(one: str, other: str) -> bool:
    """Return whether two reasons of failures are the same."""
    return one == other or (one.startswith(_HANGS) and other.startswith(_HANGS))


def difference(outcome: MemberOutcome, recorded: Mapping[str, Any], metrics: Sequence[str]) -> str:
    """Return how a member came to something else than what is recorded; empty: it did not.

    Parameters
    ----------
    outcome : MemberOutcome
    recorded : mapping
        Its row.
    metrics : sequence of str
        The names of those that are compared.
    """
    before = recorded["reason"] or ""
    if outcome.status != recorded["status"] or not same_reason(outcome.reason, before):
        return (
            f"it came to {outcome.reason or outcome.status!r}, and to "
            f"{before or recorded['status']!r} before"
        )
    for name in metrics:
        now = outcome.metrics.get(name)
        if not same_value(now, recorded[name]) and outcome.status != FAILED:
            return (
                f"{name} = {now!r}, and {recorded[name]!r} before; what it runs gives other "
                "results each time"
            )
    return ""
