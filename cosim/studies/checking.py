"""Check a study before anything runs: that its members can be built, and what they are made of.

A value that is given for a key is refused where the scenario does not take it, beside a member
that it takes. Of what is drawn a part may be refused: these members fail, and their share is told
before.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np

from cosim.errors import UsageError, command, listing, option, quoted
from cosim.files import file_type
from cosim.log.foreign.topics import is_foreign
from cosim.log.reading.reader import open_log
from cosim.scenario.document.document import Document
from cosim.scenario.parsing import Scenario
from cosim.scenario.preparing import build_experiment
from cosim.scenario.recordings.recorded_scenario import recorded_document
from cosim.scenario.recordings.replaying import texts_in
from cosim.scenario.running.replay import Replays, replays_of
from cosim.studies.contracts import RECORDING, MemberOutcome, StudyMember
from cosim.studies.design import (
    DesignColumn,
    GridColumn,
    SampleColumn,
    StudyDesign,
    edited_scenario,
    plain_values,
)
from cosim.studies.members import MemberSources, OpenedSubject, inspect_member
from cosim.studies.study_file import STUDY
from cosim.studies.variations import SampledVariation
from cosim.studies.workers import LocalExecutor

_UNBOUNDED: Final = ("lognormal", "exponential", "weibull")
MOST_CHECKED: Final = 2000  # values of a key
MOST_BUILT: Final = 6  # of these; each costs what a member does
MOST_NAMED: Final = 3  # values of a key that are refused
PROBES: Final = 9  # draws, from the smallest to the largest, once one is refused
MOST_INSPECTED: Final = 100  # members, one for each text that is varied: files, logs
MOST_DRAWN: Final = 10  # samples that are tried where the first one is refused


@dataclass(frozen=True, slots=True)
class CheckedDesign:
    """A member that is not refused, whose values need not be those of one member; and notices."""

    member: StudyMember
    notices: tuple[str, ...]


def check_design(
    design: StudyDesign, scenario: Scenario, *, allow_code: bool = False
) -> CheckedDesign:
    """Check that the scenario has every varied key, and takes its values.

    Every value that is listed is checked, of very many the first, the smallest and the largest
    number, else the first 2000. With some of these, a scenario of components of this package is
    built, and so is the replay of a log; every log is opened. Code of others is not run here: it
    belongs into the processes of the members.

    Raises
    ------
    UsageError
        If it does not; names the key and the value.
    """
    return _DesignCheck(design, _MemberCheck(design, scenario, allow_code=allow_code)).run()


class _MemberCheck:
    """Says why members are refused."""

    def __init__(self, design: StudyDesign, scenario: Scenario, *, allow_code: bool) -> None:
        self._study = design.study
        self._scenario = scenario
        self._allow_code = allow_code
        self._known: dict[tuple[str, bool], str] = {}
        self._replays = cache(self._opened)
        first = design.member(0)
        edited_scenario(self._study, scenario, first.swap)  # what all have is no member's fault
        _check_files(self._study.settings.swap)
        if first.recording is not None:
            self._replays_of(first)

    def problem(self, member: StudyMember, *, is_built: bool = True) -> str:
        """Return why a member is refused; empty: it is not."""
        key = repr(replace(member, number=0)), is_built
        if key not in self._known:
            self._known[key] = self._problem(member, is_built=is_built)
        return self._known[key]

    def _problem(self, member: StudyMember, *, is_built: bool) -> str:
        try:
            edited = edited_scenario(self._study, self._scenario, member.swap, member.set)
            _check_files(member.swap)
            if is_built and member.recording is not None:
                replays = self._replays_of(member)
                if replays is not None:
                    replays.check(member.set)
            elif is_built and is_own_code(edited):
                with ExitStack() as resources:
                    experiment = build_experiment(edited, resources, None)
                    if experiment.plan is None:
                        experiment.graph.prepare(experiment.clock.step_ns, experiment.designs)
        except UsageError as error:
            return _with_keys(str(error), member)
        return ""

    def _replays_of(self, member: StudyMember) -> Replays | None:
        """Open the log of a member; None: a replay of it may run the code of others."""
        settings = self._study.settings
        has_class = any(key.endswith(".class") for key in (*settings.set, *member.set))
        runs_code = self._allow_code or bool(settings.swap or member.swap) or has_class
        return self._replays(str(member.recording), is_read=not runs_code)

    def _opened(self, path: str, *, is_read: bool) -> Replays | None:
        is_of_other_tool = is_foreign(Path(path))
        if not is_of_other_tool:
            check_is_of_scenario(path, self._scenario)
        if not is_read:
            return None
        settings = self._study.settings
        scenario = self._scenario if is_of_other_tool else None
        return replays_of(path, set=settings.set, map=settings.map, scenario=scenario)


class _DesignCheck:
    """Checks the values of one key after the other, beside values of the others that are taken."""

    def __init__(self, design: StudyDesign, check: _MemberCheck) -> None:
        self._design = design
        self._problem = check.problem
        self._member = design.member(0)
        self._drawn = {item.key: item for item in design.study.sampled if not item.values}
        self._notices: list[str] = []

    def run(self) -> CheckedDesign:
        columns = self._design.columns
        names = [n for n, c in columns.items() if isinstance(c, GridColumn | SampleColumn)]
        names.sort(key=lambda name: name == RECORDING)  # logs are not to blame for a value
        if self._problem(self._member):
            self._take_medians()
        problem = self._problem(self._member)
        if problem:
            alone = self._problem(StudyMember(0, {}, {}, self._member.recording))
            if problem == alone:
                raise UsageError(problem)  # no value is to blame
            # what is wrong by itself comes first, as beside it all others are wrong, too
            names.sort(key=lambda name: bool(self._problem(_without(self._member, name))))
            if names and self._problem(_without(self._member, names[0])):  # several are
                self._member = replace(self._member, set={})
        problems: list[str] = []
        for name in names:
            column = columns[name]
            if name in self._drawn:
                self._check_drawn(name, np.asarray(getattr(column, "values", ())))
                continue
            problems += self._value_problems(name, column)
            if problems and self._problem(self._member):
                break  # beside a value that is refused all others are, too
        problem = "\n".join(problems) or self._problem(self._member)
        if problem:
            raise UsageError(problem)
        return CheckedDesign(self._member, tuple(self._notices))

    def _take_medians(self) -> None:
        for name in self._drawn:
            values = np.sort(np.asarray(getattr(self._design.columns[name], "values", ())))
            self._member = _with_value(self._member, name, float(values[len(values) // 2]))

    def _check_drawn(self, name: str, values: np.ndarray[Any, Any]) -> None:
        def attempt(value: float) -> str:
            return without_key(self._problem(_with_value(self._member, name, value)), name)

        layout = self._design.layout
        found = check_draws(self._drawn[name], values, attempt, layout.seeds * layout.grid)
        if found is not None:
            notice, accepted = found
            self._notices.append(notice)
            if self._problem(self._member):
                self._member = _with_value(self._member, name, accepted)

    def _value_problems(self, name: str, column: DesignColumn) -> list[str]:
        """Return what is wrong with the first values of a key that are refused.

        The keys after it are checked beside one that is taken.
        """
        values = _listed(column)
        count = len(values)
        built = set(np.linspace(0, count - 1, min(count, MOST_BUILT)).astype(int).tolist())
        accepted: StudyMember | None = None
        problems: list[str] = []
        for number, value in enumerate(values):
            member = _with_value(self._member, name, value)
            problem = self._problem(member, is_built=number in built)
            if not problem:
                accepted = accepted or member
                continue
            if name != RECORDING or not problem.startswith(str(value)):
                problem = f"{name} = {quoted(value)}: {without_key(problem, name)}"
            problems.append(f"{self._place(column, value)}{problem}")
            if len(problems) == MOST_NAMED:
                break
        if problems and accepted is not None:
            self._member = accepted
        return problems

    def _place(self, column: DesignColumn, value: Any) -> str:
        """Return where a value stands in the table of cases, before a message; empty: nowhere."""
        cases = self._design.study.settings.cases
        if cases is None or not isinstance(column, SampleColumn):
            return ""
        rows = map(repr, plain_values(column.values))
        return f"file {cases!r}, row {list(rows).index(repr(value)) + 1}: "


def _listed(column: DesignColumn) -> list[Any]:
    """Return the values of a column that are checked, each once."""
    values = getattr(column, "values", ())
    if isinstance(values, np.ndarray):
        is_drawn = isinstance(column, SampleColumn) and column.indices is None
        if is_drawn or len(values) > MOST_CHECKED:
            values = np.array([values[0], values.min(), values.max()])
        values = values.tolist()
    distinct = {repr(value): value for value in values if value is not None}  # also nan once
    return list(distinct.values())[:MOST_CHECKED]


def _with_value(member: StudyMember, name: str, value: Any) -> StudyMember:
    if name == RECORDING:
        return replace(member, recording=value)
    kind, dot, component = name.partition(".")
    if kind + dot == "swap.":
        return replace(member, swap={**member.swap, component: value})
    return replace(member, set={**member.set, name: value})


def _without(member: StudyMember, name: str) -> StudyMember:
    return replace(member, set={key: v for key, v in member.set.items() if key != name})


def without_key(problem: str, key: str) -> str:
    """Return a problem without the place that a scenario has for a key that is varied."""
    rest = re.sub(rf"^\S+:\d+ \(with {re.escape(key)}\): ", "", problem)
    return rest.removeprefix(f"{key}: ").removeprefix(f"components.{key}: ")


def _with_keys(problem: str, member: StudyMember) -> str:
    """Return a problem with the keys of a member; a worker names them as options in Python."""
    for key in member.set:
        problem = problem.replace(option("set", key), key).replace(f"set[{key!r}]", key)
    return problem


def _check_files(swaps: Mapping[str, str]) -> None:
    for name, path in swaps.items():
        if not (os.path.exists(path) or os.path.exists(path.rpartition("#")[0])):
            raise UsageError(f"{option('swap', name)}: {path}: no such file")


def is_own_code(scenario: Scenario) -> bool:
    """Return whether a scenario has components of this package only: no FMU, no user's class."""
    if any(spec.code is not None for spec in scenario.specs.values()):
        return False
    texts = texts_in(scenario.tree.get("components", {}))
    return not any(file_type(text.partition("#")[0]) == "FMU" for text in texts)


# --- drawn values ---


def check_draws(
    variation: SampledVariation,
    values: np.ndarray[Any, Any],
    attempt: Callable[[float], str],
    members_each: int,
) -> tuple[str, float] | None:
    """Check what was drawn for a key.

    Parameters
    ----------
    variation : SampledVariation
    values : array
        A draw for each sample.
    attempt : callable
        Returns why a value is refused; empty: it is not.
    members_each : int
        Of a sample.

    Returns
    -------
    notice : str
        How many draws are refused, about: from one that is taken to the next that is refused the
        change is searched by bisection.
    accepted : float
        A draw that is taken.

    None: neither the first, nor the smallest, nor the largest draw is refused.

    Raises
    ------
    UsageError
        If all are that were tried.
    """
    distinct, counts = np.unique(values, return_counts=True)
    reason = cache(lambda index: attempt(float(distinct[index])))
    last = len(distinct) - 1
    first = int(np.searchsorted(distinct, values[0]))
    if not (reason(first) or reason(0) or reason(last)):
        return None
    probes = np.linspace(0, last, min(len(distinct), PROBES)).astype(int).tolist()
    probes = sorted({first, *probes})
    wrong = [index for index in probes if reason(index)]
    example = first if reason(first) else wrong[0]
    value = float(distinct[example])
    number = int(np.flatnonzero(values == distinct[example])[0]) * members_each
    if len(wrong) == len(probes):
        tried = (
            "the only draw is" if last == 0 else f"so are all {len(probes)} draws that were tried"
        )
        raise UsageError(
            f"{variation.key} = {quoted(value)}, drawn from {variation} for member {number}: "
            f"{reason(example)}; {tried}; choose another distribution"
        )
    is_wrong = np.zeros(len(distinct), bool)
    for low, high in pairwise(probes):
        change = _change(low, high, reason)
        is_wrong[low:change] = bool(reason(low))
        is_wrong[change : high + 1] = bool(reason(high))
    ways_out = {
        "normal": "truncate the distribution with 'lower' and 'upper'",
        **dict.fromkeys(_UNBOUNDED, "use a bounded distribution, such as uniform"),
    }
    way_out = ways_out.get(variation.distribution, "choose a distribution of accepted values")
    notice = (
        f"{variation.key}: about {int(counts[is_wrong].sum())} of {len(values)} draws of "
        f"{variation} are invalid, and members that draw them will fail: {value!r} of member "
        f"{number}: {reason(example)}; {way_out}"
    )
    return notice, float(distinct[next(index for index in probes if not reason(index))])


def _change(low: int, high: int, reason: Callable[[int], str]) -> int:
    """Return the first of some draws that is taken where the first is not, or the reverse."""
    is_wrong = bool(reason(low))
    if bool(reason(high)) == is_wrong:
        return high
    while high - low > 1:
        middle = (low + high) // 2
        if bool(reason(middle)) == is_wrong:
            low = middle
        else:
            high = middle
    return high


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


# --- what members are made of ---

Inspected: TypeAlias = MemberSources | MemberOutcome  # the latter: it could not be found out


@dataclass(frozen=True)
class Inspection:
    """What members are made of, by number; one that is not refused; and which are."""

    members: Mapping[int, StudyMember]
    found: Mapping[int, Inspected]
    trial: StudyMember
    notices: Sequence[str]


def inspect_members(design: StudyDesign, scenario: Scenario, checked: CheckedDesign) -> Inspection:
    """Build the first member, and the first with each text that is varied.

    Numbers that are drawn are those that were checked; where the member is refused with these, it
    is built with those of other samples.
    """
    drawn = [item.key for item in design.study.sampled if not item.values]
    values = {name: checked.member.set[name] for name in drawn}
    members = {n: _with_drawn(design.member(n), values) for n in _with_texts(design)}
    found = dict(_inspect(design, scenario, members.values()))
    samples = np.linspace(0, design.layout.samples - 1, MOST_DRAWN).astype(int)
    each = design.layout.seeds * design.layout.grid
    trial = members[0]
    notices = []
    for number, member in members.items() if drawn else ():
        first = found[number]
        if isinstance(first, MemberOutcome) or not first.refused:
            continue
        others = {}
        for sample in np.unique(samples).tolist():
            of_sample = design.member(sample * each).set
            other = _with_drawn(member, {name: of_sample[name] for name in drawn})
            others[sample] = replace(other, number=sample)
        for sample, again in _inspect(design, scenario, others.values()):
            if isinstance(again, MemberOutcome) or not again.refused:
                is_real = member == design.member(number)
                with_these = "cannot be built with the values that were tried"
                will = "will fail" if is_real else with_these
                notices.append(f"member {number} {will}: {first.refused}")
                found[number] = again
                trial = others[sample] if number == 0 else trial
                break
    return Inspection(members, found, trial, notices)


def _with_drawn(member: StudyMember, values: Mapping[str, Any]) -> StudyMember:
    return replace(member, set={**member.set, **values})


def _inspect(
    design: StudyDesign, scenario: Scenario, members: Iterable[StudyMember]
) -> Iterator[tuple[int, Inspected]]:
    """Build members; in a worker where code of others may be run."""
    study = design.study
    members = list(members)
    edited = (edited_scenario(study, scenario, member.swap, member.set) for member in members)
    if all(map(is_own_code, edited)):
        with OpenedSubject(study.subject) as opened:
            for member in members:
                yield member.number, opened.inspect(member)
        return
    with LocalExecutor(study.subject, 1, timeout=study.settings.timeout) as executor:
        for member, found in executor.run(members, inspect_member):
            if isinstance(found, MemberSources):
                found = replace(found, refused=_with_keys(found.refused, member))
            yield member.number, found


def _with_texts(design: StudyDesign) -> list[int]:
    """Return the first member, and the first with each text that is varied."""
    numbers = {0}
    for name in design.names:
        column = design.column(name)
        if isinstance(column, list):
            first: dict[str, int] = {}
            for number, value in enumerate(column):
                if isinstance(value, str):
                    first.setdefault(value, number)
                if len(first) == MOST_INSPECTED:
                    break
            numbers |= set(first.values())
    return sorted(numbers)
