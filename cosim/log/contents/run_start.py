"""The instant at which the rows of a run begin, from the metadata of its log."""

from __future__ import annotations

from collections.abc import Mapping

from cosim.instants import last_nanosecond
from cosim.log.contents.metadata import json_table


def recorded_start_ns(metadata: Mapping[str, Mapping[str, str]]) -> int | None:
    """Return the instant from which steps are counted [ns]; None: it is not recorded.

    That is the start time of the run, or where the span begins that a replay recorded alone.

    Parameters
    ----------
    metadata : mapping of record name to its items
    """
    run = metadata.get("cosim.run", {})
    try:
        # a replay of all has null for its window
        window = json_table(run.get("replay", "{}")).get("window") or [run.get("start_time", "")]
        return last_nanosecond(float(window[0]))
    except (ValueError, OverflowError, TypeError, LookupError):
        return None
