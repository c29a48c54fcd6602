"""Check a study before anything runs: that its members can be built, and what they are made of.

A value that is given for a key is refused where a member that has it cannot be built; what is drawn
is left out for that. Of the draws of a key a part may be refused: these members fail, and their
share is told before. Code of others (FMUs, classes of users) is run in a worker only, for the first
member, and for the first with each text.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, TypeAlias, final

import numpy as np

from cosim.errors import UsageError, command, listing, option, quoted
from cosim.files import file_type
from cosim.log.foreign.topics import is_foreign
from cosim.log.reading.reader import open_log
from cosim.scenario.document.document import Document
from cosim.scenario.parsing import Scenario
from cosim.scenario.recordings.recorded_scenario import recorded_document
from cosim.scenario.recordings.replaying import texts_in
from cosim.studies.contracts import RECORDING, SWAP, MemberOutcome, StudyMember
from cosim.studies.design import StudyDesign, ValueColumn, edited_scenario, member_of
from cosim.studies.members import MemberSources, OpenedSubject, inspect_member
from cosim.studies.study_file import STUDY
from cosim.studies.variations import SampledVariation
from cosim.studies.workers import LocalExecutor

MOST_CHECKED: Final = 2000  # values of a key
MOST_BUILT: Final = 6  # of these; each costs what a member does
MOST_INSPECTED: Final = 100  # texts of a key, which may be files
MOST_NAMED: Final = 5  # members that are refused
PROBES: Final = 9  # draws, from the smallest to the largest, once one is refused
_SAMPLES: Final = 10  # that are tried, once the first one is refused
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
    with ExitStack() as resources:
        return _Check(design, scenario, resources).run()


@final
class _Check:
    """Builds members of a design."""

    def __init__(self, design: StudyDesign, scenario: Scenario, resources: ExitStack) -> None:
        self._design = design
        self._study = design.study
        self._scenario = scenario
        self._resources = resources
        self._drawn = {item.key: item for item in design.study.sampled if not item.values}
        self._given: Mapping[str, Any] = {}  # for what is drawn
        self._found: dict[str, tuple[int, Inspected]] = {}
        self._recordings: set[str] = set()  # of this scenario

    def run(self) -> CheckedDesign:
        first = self._design.member(0)
        own = {key: first.set[key] for key in self._drawn}
        middle = {key: float(np.median(self._draws(key))) for key in self._drawn}
        for self._given in ({}, own, middle):  # the scenario's own values first
            if not self._problem(self._member(0), _RUN):
                break
        else:
            self._given = {}
        problems = list(dict.fromkeys(self._refusals()))
        if problems:
            raise UsageError("\n".join(problems))
        notices = [notice for key in self._drawn if (notice := self._refused_draws(key))]
        if self._drawn and not notices:
            notices += self._refused_samples()
        return CheckedDesign(self._member(0), [*self._found.values()], tuple(notices))

    # --- values that are given ---

    def _refusals(self) -> Iterator[str]:
        """Yield what is wrong with the members that have the values to be checked."""
        refused = 0
        for number, level in self._chosen().items():
            if self._problem(self._member(number), level):
                yield from self._blame(number, level)
                refused += 1
            if refused == MOST_NAMED:
                break

    def _chosen(self) -> dict[int, int]:
        """Return the first member with each value, and how it is checked."""
        levels = {0: _RUN}
        for key, column in self._design.values.items():
            if key in self._drawn:
                continue
            firsts = list(_firsts(column).items())[:MOST_CHECKED]
            built = np.linspace(0, len(firsts) - 1, min(len(firsts), MOST_BUILT)).astype(int)
            for count, (text, position) in enumerate(firsts):
                level = _BUILT if count in built else _EDITED
                if text[0] in "'\"" and count < MOST_INSPECTED:
                    level = _RUN
                number = position * column.stride
                levels[number] = max(levels.get(number, level), level)
        return levels

    def _member(self, number: int) -> StudyMember:
        """Return a member, with other values of what is drawn."""
        member = self._design.member(number)
        set_ = {key: value for key, value in member.set.items() if key not in self._drawn}
        return replace(member, set={**set_, **self._given})

    def _blame(self, number: int, level: int) -> list[str]:
        """Return what is wrong with a member, by the keys without which it is not."""
        member = self._member(number)
        problem = self._problem(member, level)
        swaps = {f"{SWAP}{name}": path for name, path in member.swap.items()}
        values = {**member.set, **swaps, RECORDING: member.recording}
        blamed = []
        for key, value in values.items():
            others = member_of(number, {k: v for k, v in values.items() if k != key})
            rest = self._problem(others, level).splitlines()
            lines = [without_key(line, key) for line in problem.splitlines() if line not in rest]
            if lines:
                text = "\n".join(lines)
                own = "" if text.startswith(str(value)) else f"{key} = {quoted(value)}: "
                blamed.append(f"{self._place(key, number)}{own}{text}")
        return blamed or [problem]

    def _place(self, key: str, number: int) -> str:
        """Return where a value stands in the table of cases, before a message; empty: nowhere."""
        if key not in self._design.cases:
            return ""
        row = number // (self._design.layout.seeds * self._design.layout.grid) + 1
        return f"file {self._study.settings.cases!r}, row {row}: "

    # --- values that are drawn ---

    def _draws(self, key: str) -> np.ndarray[Any, Any]:
        return np.asarray(self._design.values[key].values)

    def _refused_draws(self, key: str) -> str:
        member = self._member(0)

        def reason(value: float) -> str:
            changed = replace(member, set={**member.set, key: value})
            return without_key(self._problem(changed, _BUILT), key)

        each = self._design.values[key].stride
        return refused_draws(self._drawn[key], self._draws(key), reason, each)

    def _refused_samples(self) -> list[str]:
        """Try whole samples, if the first one is refused, such as by an FMU."""
        layout = self._design.layout
        if not self._problem(self._design.member(0), _RUN):
            return []
        samples = np.unique(np.linspace(0, layout.samples - 1, _SAMPLES).astype(int)).tolist()
        members = [self._design.member(sample * layout.seeds * layout.grid) for sample in samples]
        reasons = [self._problem(member, _RUN) for member in members]
        count = len(reasons) - reasons.count("")
        text = f"{count} of {len(samples)} samples that were tried: member 0: {reasons[0]}"
        if count == len(samples):
            raise UsageError(f"the scenario refuses {text}; choose other distributions")
        return [f"members will fail in {text}"]

    # --- members ---

    def _problem(self, member: StudyMember, level: int) -> str:
        """Return why a member is refused; empty: it is not, as far as is known."""
        try:
            edited = edited_scenario(self._study, self._scenario, member.swap, member.set)
            self._check_recording(member.recording)
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

    def _check_recording(self, path: str | None) -> None:
        if path is not None and path not in self._recordings and not is_foreign(Path(path)):
            check_is_of_scenario(path, self._scenario)
            self._recordings.add(path)

    def _is_safe(self, member: StudyMember, edited: Scenario) -> bool:
        """Return whether a member is built without code of others."""
        settings = self._study.settings
        if member.recording is None or is_foreign(Path(member.recording)):
            return is_own_code(edited)
        has_class = any(key.endswith(".class") for key in (*settings.set, *member.set))
        return not (settings.allow_code or settings.swap or member.swap or has_class)

    def _inspected(self, member: StudyMember, edited: Scenario) -> Inspected:
        key = repr(replace(member, number=0))
        if key not in self._found:
            if self._is_safe(member, edited):
                found: Inspected = self._opened.inspect(member)
            else:
                ((_, found),) = self._executor.run([member], inspect_member)
            self._found[key] = member.number, found
        return self._found[key][1]

    @cached_property
    def _opened(self) -> OpenedSubject:
        return self._resources.enter_context(closing(OpenedSubject(self._study.subject)))

    @cached_property
    def _executor(self) -> LocalExecutor:
        limit = self._study.settings.timeout
        executor = LocalExecutor(self._study.subject, 1, timeout=limit)
        return self._resources.enter_context(executor)


def _firsts(column: ValueColumn) -> dict[str, int]:
    """Return the first place of each value that is to be checked, by its text."""
    values = column.values
    places: Sequence[int] = range(len(values) if column.indices is None else len(column.indices))
    if column.indices is None and isinstance(values, np.ndarray) and len(values) > MOST_CHECKED:
        places = [0, int(values.argmin()), int(values.argmax())]
    elif column.indices is not None:
        places = np.unique(column.indices, return_index=True)[1].tolist()
    firsts: dict[str, int] = {}
    for place in places:
        value = values[place if column.indices is None else column.indices[place]]
        if value is not None:
            firsts.setdefault(repr(value), place)
    return firsts


def without_key(problem: str, key: str) -> str:
    """Return a problem without the place that a scenario has for a key that is varied."""
    rest = re.sub(rf"^\S+:\d+ \(with {re.escape(key)}\): ", "", problem)
    return rest.removeprefix(f"{key}: ").removeprefix(f"components.{key}: ")


def is_own_code(scenario: Scenario) -> bool:
    """Return whether a scenario has components of this package only: no FMU, no user's class."""
    if any(spec.code is not None for spec in scenario.specs.values()):
        return False
    texts = texts_in(scenario.tree.get("components", {}))
    return not any(file_type(text.partition("#")[0]) == "FMU" for text in texts)


def refused_draws(
    variation: SampledVariation,
    values: np.ndarray[Any, Any],
    reason: Callable[[float], str],
    members_each: int,
) -> str:
    """Return how many of the draws of a key are refused; empty: the outermost two are not.

    From one that is taken to the next that is refused the change is searched by bisection.

    Raises
    ------
    UsageError
        If all are that were tried.
    """
    distinct, counts = np.unique(values, return_counts=True)
    why = cache(lambda index: reason(float(distinct[index])))
    last = len(distinct) - 1
    first = int(np.searchsorted(distinct, values[0]))
    if not (why(first) or why(0) or why(last)):
        return ""
    probes = sorted({first, *np.linspace(0, last, min(last + 1, PROBES)).astype(int).tolist()})
    wrong = [index for index in probes if why(index)]
    example = first if why(first) else wrong[0]
    value = float(distinct[example])
    number = int(np.flatnonzero(values == value)[0]) * members_each
    if wrong == probes:
        tried = f"so are all {len(probes)} draws that were tried" if last else "the only draw is"
        raise UsageError(
            f"{variation.key} = {quoted(value)}, drawn from {variation} for member {number}: "
            f"{why(example)}; {tried}; choose another distribution"
        )
    is_wrong = np.zeros(last + 1, bool)
    for low, high in pairwise(probes):
        end = bool(why(high))
        change = high
        if bool(why(low)) != end:
            ends = cache(lambda index, end=end: bool(why(index)) == end)
            change = bisect_left(range(high), True, low + 1, key=ends)
        is_wrong[low:change] = bool(why(low))
        is_wrong[change : high + 1] = end
    is_normal = variation.distribution == "normal"
    bounds = "truncate the distribution with 'lower' and 'upper'"
    return (
        f"{variation.key}: about {int(counts[is_wrong].sum())} of {len(values)} draws of "
        f"{variation} are invalid, and members that draw them will fail: {value!r} of member "
        f"{number}: {why(example)}; "
        f"{bounds if is_normal else 'use a bounded distribution, such as uniform'}"
    )


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
    tree, _ = replace(document, swaps={}, maps={}, changes={}).tree()
    return {name: table for name, table in tree.items() if name != STUDY}


def _differing(one: Mapping[str, Any], two: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    for key in dict.fromkeys([*one, *two]):
        first, second = one.get(key), two.get(key)
        if isinstance(first, Mapping) and isinstance(second, Mapping):
            yield from _differing(first, second, f"{prefix}{key}.")
        elif first != second:
            yield f"{prefix}{key}"
