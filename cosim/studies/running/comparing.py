"""Compare what a member came to when it ran again with what is recorded of it, bit for bit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

_HANGS: Final = "hangs: "  # and how long it was waited for, which is not of the member


def same_value(one: Any, other: Any) -> bool:
    """Return whether two metrics have the same bits: zeros of either sign differ."""
    return type(one) is type(other) and repr(one) == repr(other)


def same_reason(one: str, other: str) -> bool:
    """Return whether two reasons of failures are the same."""
    return one == other or (one.startswith(_HANGS) and other.startswith(_HANGS))


def difference(now: Mapping[str, Any], recorded: Mapping[str, Any], metrics: Sequence[str]) -> str:
    """Return how a member came to something else than what is recorded; empty: it did not.

    Parameters
    ----------
    now, recorded : mapping
        Rows of it.
    metrics : sequence of str
        The names of those that are compared.
    """
    before = recorded["reason"] or ""
    after = now["reason"] or ""
    if now["status"] != recorded["status"] or not same_reason(after, before):
        return (
            f"it came to {after or now['status']!r}, and to {before or recorded['status']!r} before"
        )
    for name in ("steps", *metrics):
        if not same_value(now[name], recorded[name]):
            return (
                f"{name} = {now[name]!r}, and {recorded[name]!r} before; what it runs gives other "
                "results each time"
            )
    return ""
