"""What a study will take, as ``cosim study --dry-run`` prints it."""

from __future__ import annotations

from cosim.report.tables.console import print_json, print_section
from cosim.studies.studying import StudyEstimate


def print_estimate(name: str, estimate: StudyEstimate, *, as_json: bool = False) -> None:
    """Print what a study will take."""
    if as_json:
        print_json({"name": name, **estimate.to_dict()})
        return
    logs = "unknown (as many as fail)"
    if estimate.log_bytes is not None:
        logs = _bytes(estimate.log_bytes)
    entries = {
        "members": str(estimate.members),
        "first member of a worker": f"{estimate.first_time:.3g} s",
        "every other member": f"{estimate.member_time:.3g} s, as measured for one",
        f"total, on {estimate.workers} workers": _duration(estimate.study_time),
        "dataset": f"about {_bytes(estimate.dataset_bytes)}, before compression",
        "kept logs": logs,
    }
    if estimate.log_bytes == 0:
        del entries["kept logs"]
    print_section(f"{name}: dry run, nothing was recorded", entries)


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.3g} s"
    if seconds < 7200:
        return f"{seconds / 60:.3g} min"
    return f"{seconds / 3600:.3g} h"


def _bytes(count: int) -> str:
    size = float(count)
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} TB"
