"""How late a run or a playback was that kept the pace of the wall clock."""

from __future__ import annotations

from cosim.scenario.record import Lateness


def lateness_text(lateness: Lateness) -> str:
    """Return how late it was."""
    pace = f"{lateness.factor:g} x the wall clock"
    if not lateness.late:
        return f"{pace}; never late in {lateness.blocks} blocks"
    return (
        f"{pace}; late in {lateness.late} of {lateness.blocks} blocks, at most by "
        f"{lateness.largest:.3g} s, at t = {lateness.time:g} s"
    )
