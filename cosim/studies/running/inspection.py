"""Build some members of a study before it runs: what they read, and whether they can be built."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from cosim.scenario.parsing import Scenario
from cosim.studies.contracts import MemberOutcome, StudyMember
from cosim.studies.design.checking import CheckedDesign
from cosim.studies.design.member_check import is_own_code
from cosim.studies.design.planning import edited_scenario
from cosim.studies.design.study_design import StudyDesign
from cosim.studies.document.study_file import StudyFile
from cosim.studies.members import MemberSources, OpenedSubject, inspect_member
from cosim.studies.workers import LocalExecutor

MOST_INSPECTED: Final = 100  # members, one for each text that is varied: files, logs
MOST_DRAWN: Final = 10  # samples that are tried where the first one is refused


@dataclass(frozen=True)
class Inspection:
    """What members are made of.

    Parameters
    ----------
    found : mapping of member to MemberSources or MemberOutcome
    trial : StudyMember
        One that is not refused, if there is one.
    notices : sequence of str
        Which members are, where others are not.
    """

    found: Mapping[int, MemberSources | MemberOutcome]
    trial: StudyMember
    notices: Sequence[str]


def inspect_members(
    study: StudyFile, scenario: Scenario, design: StudyDesign, members: Sequence[StudyMember]
) -> Inspection:
    """Build members; one that is refused with its draws is built with those of other members."""
    found = dict(_inspect(study, scenario, members))
    trial = members[0]
    notices = []
    for member in members:
        others = _with_other_draws(design, member)
        first = found[member.number]
        if not others or isinstance(first, MemberOutcome) or not first.refused:
            continue
        for number, other in _inspect(study, scenario, others):
            if isinstance(other, MemberOutcome) or not other.refused:
                notices.append(f"{_refusal_of(design, member)}: {first.refused}")
                found[member.number] = other
                trial = others[number] if member is members[0] else trial
                break
    return Inspection(found, trial, notices)


def _refusal_of(design: StudyDesign, member: StudyMember) -> str:
    if member == design.member(member.number):
        return f"member {member.number} will fail"
    return f"member {member.number} cannot be built with the values that were tried"


def inspected_members(design: StudyDesign, checked: CheckedDesign) -> list[StudyMember]:
    """Return the first member, and the first with each text that is varied.

    What is drawn in them is what can be built, as far as that is known.
    """
    drawn = {name: checked.member.set[name] for name in _drawn(design.study)}
    members = []
    for number in _with_texts(design):
        member = design.member(number)
        members.append(replace(member, set={**member.set, **drawn}))
    return members


def _inspect(
    study: StudyFile, scenario: Scenario, members: Sequence[StudyMember]
) -> Iterator[tuple[int, MemberSources | MemberOutcome]]:
    """Build members, and yield what the inspector says of each."""
    edited = (edited_scenario(study, scenario, member.swap, member.set) for member in members)
    if all(is_own_code(one) for one in edited):
        with closing(OpenedSubject(study.subject)) as opened:
            for member in members:
                yield member.number, opened.inspect(member)
        return
    with LocalExecutor(study.subject, 1, timeout=study.settings.timeout) as executor:
        for member, found in executor.run(members, inspect_member):
            yield member.number, found


def _with_other_draws(design: StudyDesign, member: StudyMember) -> list[StudyMember]:
    """Return a member with the numbers that are drawn in some of the other samples."""
    names = _drawn(design.study)
    if not names:
        return []
    samples = np.unique(np.linspace(0, design.layout.samples - 1, MOST_DRAWN).astype(int))
    each = design.layout.seeds * design.layout.grid
    others = []
    for number, sample in enumerate(samples.tolist()):
        values = design.member(sample * each).set
        drawn = {name: values[name] for name in names}
        others.append(replace(member, number=number, set={**member.set, **drawn}))
    return others


def _drawn(study: StudyFile) -> list[str]:
    """Return the keys of the numbers that are drawn."""
    return [item.key for item in study.sampled if not item.values]


def _with_texts(design: StudyDesign) -> list[int]:
    """Return the first member, and the first with each text that is varied."""
    numbers = {0}
    for name in design.names:
        column = design.column(name)
        if not isinstance(column, list):
            continue
        seen: set[str] = set()
        for number, value in enumerate(column):
            if isinstance(value, str) and value not in seen:
                seen.add(value)
                numbers.add(number)
            if len(seen) == MOST_INSPECTED:
                break
    return sorted(numbers)
