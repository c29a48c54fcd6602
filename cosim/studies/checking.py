"""Check a study before anything runs: that its members can be built, and what they are made of.

A value that is given for a key is refused where a member that has it cannot be built; what is drawn
is left out for that. Of the draws of a key a part may be refused: these members fail, and their
share is told before. Code of others (FMUs, classes of users) is run in a worker only, for the first
member, and for the first with each text.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, TypeAlias, final

import numpy as np
from numpy.typing import NDArray

from cosim.errors import UsageError, command, listing, option, quoted
from cosim.files import file_type
from cosim.log.foreign.topics import is_foreign
from cosim.log.reader import open_log
from cosim.scenario.document.document import Document
from cosim.scenario.kinds.base import Scenario
from cosim.scenario.recordings.recorded_scenario import recorded_document
from cosim.scenario.recordings.replaying import texts_in
from cosim.studies.contracts import RECORDING, SWAP, MemberOutcome, StudyMember, member_of
from cosim.studies.design import StudyDesign, edited_scenario
from cosim.studies.members import MemberSources, OpenedSubject, inspect_member
from cosim.studies.study_file import STUDY
from cosim.studies.workers import LocalExecutor

MOST_CHECKED: Final = 2000  # values of a key
MOST_BUILT: Final = 6  # of these; each costs what a member does
MOST_INSPECTED: Final = 100  # texts of a key, which may be files
MOST_NAMED: Final = 5  # problems
MOST_TRIED: Final = 50  # samples, once one is refused
MOST_RUN: Final = 10  # of these, where code of others is run for that
_EDITED, _BUILT, _RUN = range(3)  # by text; if no code of others is run for that; in any case

Inspected: TypeAlias = MemberSources | MemberOutcome  # the latter: it could not be found out


@dataclass(frozen=True, slots=True)
class CheckedDesign:
    """A design that is not refused.

    Parameters
    ----------
    trial : StudyMember
        One that can be built; its values need not be those of one member.
    found : sequence of (int, Inspected)
        What members are made of, by number.
    notices : tuple of str
        Which draws are refused.
    """

    trial: StudyMember
    found: Sequence[tuple[int, Inspected]]
    notices: tuple[str, ...]


def check_design(design: StudyDesign, scenario: Scenario) -> CheckedDesign:
    """Check that the scenario has every varied key, and takes its values.

    Of each key 2000 values are checked by the scenario's text, every log among them is opened, and
    some are built.

    Raises
    ------
    UsageError
        If a value is refused, or all draws of a key are; names the key and the value.
    """
    subject, timeout = design.study.subject, design.study.settings.timeout
    with (
        closing(OpenedSubject(subject)) as opened,
        LocalExecutor(subject, 1, timeout=timeout) as executor,
    ):
        return _DesignCheck(design, scenario, opened, executor).run()


@final
@dataclass(frozen=True, slots=True)
class _DesignCheck:
    """Builds members of a design."""

    design: StudyDesign
    scenario: Scenario
    opened: OpenedSubject
    executor: LocalExecutor
    found: dict[str, tuple[int, Inspected]] = field(default_factory=dict)
    recordings: set[str] = field(default_factory=set)  # of this scenario

    @property
    def drawn(self) -> list[str]:
        """The keys of drawn numbers."""
        return [item.key for item in self.design.study.sampled if not item.values]

    def run(self) -> CheckedDesign:
        first = self.design.member(0)
        own = {key: first.set[key] for key in self.drawn}
        for given in ({}, own):  # for what is drawn: the scenario's own values, if they are right
            trial = self._member(0, given)
            if not self._problem(trial, _RUN):
                break
        refused: list[str] = []
        for number, level in self._chosen().items():
            member = self._member(number, given)
            if len(refused) < MOST_NAMED and self._problem(member, level):
                refused += self._blame(member, level)
        if refused:
            raise UsageError("\n".join(dict.fromkeys(refused)))
        notices = self._refused_samples() if self.drawn else ()
        return CheckedDesign(trial, [*self.found.values()], tuple(notices))

    def _member(self, number: int, given: Mapping[str, Any]) -> StudyMember:
        """Return a member, with other values of what is drawn."""
        member = self.design.member(number)
        listed = {key: value for key, value in member.set.items() if key not in self.drawn}
        return replace(member, set={**listed, **given})

    def _chosen(self) -> dict[int, int]:
        """Return the first member with each value, and how it is checked."""
        levels = {0: _RUN}
        free = {*self.drawn, *self.design.layout.noise_seeds}
        for key, column in self.design.columns.items():
            firsts = [] if key in free else _firsts(column.values)[:MOST_CHECKED]
            built = np.linspace(0, len(firsts) - 1, min(len(firsts), MOST_BUILT)).astype(int)
            for count, place in enumerate(firsts):
                level = _BUILT if count in built else _EDITED
                if isinstance(column.values[place], str) and count < MOST_INSPECTED:
                    level = _RUN
                number = place * column.stride
                levels[number] = max(levels.get(number, level), level)
        return levels

    def _refused_samples(self) -> list[str]:
        """Return how many of the samples are refused, if the first or an extreme one is."""
        layout = self.design.layout
        each = layout.seeds * layout.grid
        draws = [self.design.columns[key].values for key in self.drawn]
        extremes = [int(place) for draw in draws for place in (draw.argmin(), draw.argmax())]
        first = self.design.member(0)
        levels = [level for level in (_BUILT, _RUN) if self._problem(first, level)] or [_BUILT]
        level = levels[0]
        if not any(self._reasons([0, *extremes], each, level).values()):
            return []
        most = MOST_TRIED if level == _BUILT else MOST_RUN
        tried = np.unique(np.linspace(0, layout.samples - 1, most).astype(int)).tolist()
        reasons = self._reasons(tried, each, level)
        count = sum(map(bool, reasons.values()))
        reasons |= self._reasons(extremes, each, level)
        number = next(sample * each for sample, reason in reasons.items() if reason)
        example = "; ".join(self._blame(self.design.member(number), level))
        example = f"such as member {number}: {example}"
        if count == len(tried):
            raise UsageError(f"all {count} samples that were tried are invalid, {example}")
        of = "" if len(tried) == layout.samples else f" that were tried, of {layout.samples},"
        return [
            f"{count or 'fewer than 1'} of {len(tried)} samples{of} are invalid, and their members "
            f"will fail, {example}; draw from a bounded distribution: uniform, or normal with "
            "'lower' and 'upper'"
        ]

    def _reasons(self, samples: Sequence[int], each: int, level: int) -> dict[int, str]:
        """Return why samples are refused, by number."""
        return {n: self._problem(self.design.member(n * each), level) for n in samples}

    def _blame(self, member: StudyMember, level: int) -> list[str]:
        """Return what is wrong with a member, by the keys without which it is not."""
        problem = self._problem(member, level)
        swaps = {f"{SWAP}{name}": path for name, path in member.swap.items()}
        values = {**member.set, **swaps}
        blamed = []
        for key, value in values.items():  # without its log it would run what the log has in it
            others = {k: v for k, v in values.items() if k != key} | {RECORDING: member.recording}
            rest = self._problem(member_of(member.number, others), level).splitlines()
            lines = [_without_key(line, key) for line in problem.splitlines() if line not in rest]
            if lines:
                text = "\n".join(lines)
                place = self._place(key, member.number)
                blamed.append(f"{place}{key} = {quoted(value)}: {text}")
        is_of_log = member.recording is not None and problem.startswith(member.recording)
        return blamed or [f"{self._place(RECORDING, member.number) if is_of_log else ''}{problem}"]

    def _place(self, key: str, number: int) -> str:
        """Return where a value stands in the table of cases, before a message; empty: nowhere."""
        if key not in self.design.cases:
            return ""
        row = number // (self.design.layout.seeds * self.design.layout.grid) + 1
        return f"file {self.design.study.settings.cases!r}, row {row}: "

    # --- members ---

    def _problem(self, member: StudyMember, level: int) -> str:
        """Return why a member is refused; empty: it is not, as far as is known."""
        try:
            edited = edited_scenario(self.design.study, self.scenario, member.swap, member.set)
            path = member.recording
            if path is not None and path not in self.recordings and not is_foreign(Path(path)):
                check_is_of_scenario(path, self.scenario)
                self.recordings.add(path)
            is_built = level == _RUN or (level == _BUILT and self._is_safe(member, edited))
            found = self._inspected(member, edited) if is_built else None
            text = found.refused if isinstance(found, MemberSources) else ""
        except UsageError as error:
            text = str(error)
        for key in member.set:
            text = text.replace(option("set", key), key)
        for name in member.swap:
            text = text.replace(option("swap", name), f"{SWAP}{name}")
        return text

    def _is_safe(self, member: StudyMember, edited: Scenario) -> bool:
        """Return whether a member is built without code of others."""
        settings = self.design.study.settings
        if member.recording is None or is_foreign(Path(member.recording)):
            return is_own_code(edited)
        has_class = any(key.endswith(".class") for key in (*settings.set, *member.set))
        return not (settings.allow_code or settings.swap or member.swap or has_class)

    def _inspected(self, member: StudyMember, edited: Scenario) -> Inspected:
        key = repr(replace(member, number=0))
        if key not in self.found:
            if self._is_safe(member, edited):
                self.found[key] = member.number, self.opened.inspect(member)
            else:
                ((_, found),) = self.executor.run([member], inspect_member)
                self.found[key] = member.number, found
        return self.found[key][1]


def _firsts(values: NDArray[Any]) -> list[int]:
    """Return the first place of each value that is to be checked; of many numbers, the extremes."""
    if values.dtype == object:
        places = {repr(value): place for place, value in reversed([*enumerate(values)])}
        places.pop("None", None)
        return sorted(places.values())
    firsts = np.unique(values, return_index=True)[1]
    if len(firsts) > MOST_CHECKED:
        return [0, int(values.argmin()), int(values.argmax())]
    return sorted(firsts.tolist())


def _without_key(problem: str, key: str) -> str:
    """Return a problem without the place that a scenario has for a key that is varied."""
    rest = re.sub(rf"^\S+:\d+ \(with {re.escape(key)}\): ", "", problem)
    return rest.removeprefix(f"{key}: ").removeprefix(f"components.{key}: ")


def is_own_code(scenario: Scenario) -> bool:
    """Return whether a scenario has components of this package only: no FMU, no user's class."""
    if any(spec.code is not None for spec in scenario.specs.values()):
        return False
    texts = texts_in(scenario.tree.get("components", {}))
    return not any(file_type(text.partition("#")[0]) == "FMU" for text in texts)


# --- recordings ---


def check_is_of_scenario(path: str, scenario: Scenario) -> None:
    """Check that a log is a recording of a scenario.

    Raises
    ------
    UsageError
        If it is of another one, or of another version of it; names what differs.
    """
    recorded, named = _tables(recorded_document(open_log(path))), _tables(scenario.document)
    if recorded == named:
        return
    found, expected = (tables.get("scenario", {}).get("name") for tables in (recorded, named))
    problem = f"the log is of {quoted(found)}, and the study is of {quoted(expected)}"
    if found == expected:
        problem = (
            f"the log is of another {quoted(found)} than {scenario.document.source} is now: they "
            f"differ in {listing(list(_differing(recorded, named)), 3)}"
        )
    raise UsageError(
        f"{path}: {problem}; a replay runs the scenario of its log: use a log of this scenario, "
        f"or run {command('study')} on the log itself"
    )


def _tables(document: Document) -> dict[str, Any]:
    tree = replace(document, swaps={}, maps={}, changes={}).tables().tree
    return {name: table for name, table in tree.items() if name != STUDY}


def _differing(one: Mapping[str, Any], two: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for key in dict.fromkeys([*one, *two]):
        first, second = one.get(key), two.get(key)
        if isinstance(first, Mapping) and isinstance(second, Mapping):
            yield from _differing(first, second, f"{prefix}{key}.")
        elif first != second:
            yield f"{prefix}{key}"
