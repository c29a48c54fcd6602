"""What came of running members of a study again, as ``cosim study verify`` prints it."""

from __future__ import annotations

from collections.abc import Sequence

from cosim.errors import listing
from cosim.report.tables.console import print_json, print_line
from cosim.studies.analysis.columns import count_text
from cosim.studies.verifying import StudyVerification


def print_verification(found: StudyVerification, *, as_json: bool = False) -> None:
    """Print what was compared, every difference, and what was not shown."""
    if as_json:
        print_json(found.to_dict())
        return
    numbers = listing([str(number) for number in found.members], 10)
    print_line(
        f"{found.name}: {len(found.members)} of {count_text(found.done)} rerun, each built from "
        f"scratch in its own process: {numbers}"
    )
    for item in found.differences:
        print_line(f"member {item.member}: {item.name} was {item.recorded!r}, is {item.now!r}")
    differing = {item.member for item in found.differences}
    if differing:
        differ = "differs" if len(differing) == 1 else "differ"
        total = count_text(len(found.members))
        print_line(f"{len(differing)} of {total} {differ} from the record")
    else:
        print_line(f"identical bit for bit: {listing(found.values, 10)}")
    print_line(f"not verified: {'; '.join(_not_shown(found))}")


def _not_shown(found: StudyVerification) -> Sequence[str]:
    """Return what this does not tell."""
    texts = []
    others = found.done - len(found.members)
    if others:
        texts.append(f"{count_text(others)} not rerun")
    if found.elsewhere:
        texts.append(
            f"results on the original machine ({listing(found.elsewhere, 3)}): libraries of this "
            "one may round differently"
        )
    else:
        texts.append("results on other machines")
    texts.append("signals without a metric")
    if found.is_searched:
        texts.append("whether the search would choose these members again")
    for name, (before, now) in found.environment.items():
        texts.append(f"{name} was {before}, is {now}")
    return texts
