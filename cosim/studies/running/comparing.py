"""Compare what a member came to when it ran again with what is recorded of it, bit for bit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from cosim.studies.contracts import HANGS


def same_value(one: Any, other: Any) -> bool:
    """Return whether two metrics have the same bits: zeros of either sign differ."""
    return type(one) is type(other) and repr(one) == repr(other)


def same_reason(one: str, other: str) -> bool:
    """Return whether two reasons of failures are the same, however long one was waited for."""
    return one == other or (one.startswith(HANGS) and other.startswith(HANGS))


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
        ends = (after or now["status"], before or recorded["status"])
        return "it ended with {!r}; recorded: {!r}".format(*ends)
    for name in ("steps", *metrics):
        if not same_value(now[name], recorded[name]):
            cause = _cause(now, recorded)
            return f"{name} = {now[name]!r}; recorded: {recorded[name]!r}; {cause}"
    return ""


def _cause(now: Mapping[str, Any], recorded: Mapping[str, Any]) -> str:
    """Return why two runs of a member may differ."""
    repeats = "the model is not deterministic"
    machine, before = ((row["worker"] or "").rpartition(":")[0] for row in (now, recorded))
    if machine == before:
        return repeats
    return f"it ran on {before} before, which may round differently from {machine}, or {repeats}"
