"""What a command says of a study that is stopped by Ctrl-C."""

from __future__ import annotations


def stopped_text(place: str, *, new: bool) -> str:
    """Return what there is of a study that is stopped; ``new``: that was to begin anew."""
    from cosim.errors import DatasetError
    from cosim.studies.dataset import StudyDataset
    from cosim.studies.study import open_study

    try:
        if not StudyDataset.is_at(place):
            return "stopped before the first member was recorded"
        stopped = open_study(place)
    except DatasetError as error:
        return f"stopped; {error}"
    recorded = f"stopped: {len(stopped)} of {stopped.planned} members are recorded in {place}"
    if new:
        return (
            f"{recorded}; the same command without --new resumes from them, with --new deletes them"
        )
    return f"{recorded}; the same command resumes"
