"""What came of running members of a study again, as ``cosim study verify`` prints it."""

from __future__ import annotations

from collections.abc import Sequence

from cosim.errors import listing
from cosim.report.tables.console import print_json, print_line
from cosim.studies.analysis.columns import count_text
from cosim.studies.verification.study_verification import StudyVerification


def print_verification(found: StudyVerification, *, as_json: bool = False) -> None:
    """Print what was compared, every difference, and what was not shown."""
    if as_json:
        print_json(found.to_dict())
        return
    numbers = listing([str(number) for number in found.members], 10)
    print_line(
        f"{found.name}: {len(found.members)} of {count_text(found.done)} ran again, each alone in "
        f"a process of its own and built afresh: {numbers}"
    )
    for item in found.differences:
        print_line(f"member {item.member}: {item.name} was {item.recorded!r}, is {item.now!r}")
    differing = {item.member for item in found.differences}
    if differing:
        differ = "differs" if len(differing) == 1 else "differ"
        total = count_text(len(found.members))
        print_line(f"{len(differing)} of {total} {differ} from what is recorded")
    else:
        print_line(f"as recorded, bit for bit: {listing(found.values, 10)}")
    print_line(f"not shown: {'; '.join(_not_shown(found))}")


def _not_shown(found: StudyVerification) -> Sequence[str]:
    """Return what this does not tell."""
    texts = []
    others = found.done - len(found.members)
    if others:
        texts.append(f"{count_text(others)} did not run again")
    if found.elsewhere:
        texts.append(
            f"these ran on {listing(found.elsewhere, 3)}, and again on another machine, whose "
            "libraries may round otherwise"
        )
    else:
        texts.append("whether another machine comes to the same")
    texts.append("signals that no metric is about")
    if found.is_searched:
        texts.append("that the search would choose these members again")
    for name, (before, now) in found.environment.items():
        texts.append(f"{name} was {before}, is {now}")
    return texts
