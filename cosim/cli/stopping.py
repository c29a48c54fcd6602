"""What a command says of a study that is stopped by Ctrl-C."""

from __future__ import annotations


def stopped_text(place: str) -> str:
    """Return what there is of a study that is stopped."""
    from cosim.errors import DatasetError
    from cosim.studies.dataset.study import open_study

    try:
        stopped = open_study(place)
    except DatasetError:
        return "stopped before the first member was recorded"
    return (
        f"stopped: {len(stopped)} of {stopped.planned} members are recorded in {place}; the same "
        "command goes on"
    )
