"""Check a design before anything runs: that the scenario takes its values."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from cosim.errors import UsageError, quoted
from cosim.scenario.parsing import Scenario
from cosim.studies.contracts import RECORDING, SWAP, StudyMember
from cosim.studies.design.columns import (
    DesignColumn,
    GridColumn,
    NoiseSeedColumn,
    SampleColumn,
    plain_values,
)
from cosim.studies.design.drawn_check import RefusedDraws, check_draws
from cosim.studies.design.member_check import MemberCheck, check_files, without_key
from cosim.studies.design.planning import edited_scenario
from cosim.studies.design.study_design import StudyDesign

MOST_CHECKED: Final = 2000  # values of a key
MOST_BUILT: Final = 6  # of these; each costs what a member does
MOST_NAMED: Final = 3  # values of a key that are refused


@dataclass(frozen=True, slots=True)
class CheckedDesign:
    """What a check of a design found.

    Parameters
    ----------
    member : StudyMember
        One that is not refused; its values need not be those of one member.
    refused : tuple of RefusedDraws
        Of which members will fail.
    """

    member: StudyMember
    refused: tuple[RefusedDraws, ...]


def check_design(
    design: StudyDesign, scenario: Scenario, *, allow_code: bool = False
) -> CheckedDesign:
    """Check that the scenario has every varied key, and takes its values.

    Of a key of the grid and of a choice every value is checked, of a case's key every one that is
    no number, too, and of its numbers the first, the smallest and the largest. Of very many values
    these are the first, the smallest and the largest number, and else the first 2000. What is
    drawn is refused where no draw is taken: see :mod:`cosim.studies.design.drawn_check`. The other
    keys have the values of the first member, or of another one where that is refused.

    With some of these values of each key, a scenario of components of this package is built, and
    so is the replay of a log; every log is opened. Code of others is not run here: it belongs into
    the processes of the members, which say what is wrong with it.

    Parameters
    ----------
    design : StudyDesign
    scenario : Scenario
        As for :func:`cosim.studies.design.planning.plan_design`.
    allow_code : bool
        Members that replay logs may run the code of users.

    Raises
    ------
    UsageError
        If it does not; names the key and the value.
    """
    study = design.study
    first = design.member(0)
    edited_scenario(study, scenario, first.swap)  # what all have is not blamed on a member
    check_files(study.settings.swap)
    check = MemberCheck(study, scenario, allow_code=allow_code)
    check.recording.open(first)
    return _DesignCheck(design, check, first).run()


class _DesignCheck:
    """Checks the values of one key after the other, beside values of the others that are taken."""

    def __init__(self, design: StudyDesign, check: MemberCheck, first: StudyMember) -> None:
        self._design = design
        self._check = check
        self._member = first
        self._problems: dict[str, str] = {}
        self._drawn = {item.key: item for item in design.study.sampled if not item.values}

    def run(self) -> CheckedDesign:
        names = self._names()
        if self._problem(self._member):
            self._take_medians()
        if self._problem(self._member):
            # what is wrong by itself comes first, as beside it all others are wrong, too
            names.sort(key=lambda name: bool(self._problem_without(name)))
            if names and self._problem_without(names[0]):  # several are: each is checked alone
                self._member = replace(self._member, set={})
        refused = []
        problems: list[str] = []
        for name in names:
            column = self._design.columns[name]
            if name in self._drawn and isinstance(column, SampleColumn):
                draws = self._check_drawn(name, column)
                if draws is not None:
                    refused.append(draws)
                continue
            problems += self._value_problems(name, _values(column))
            if problems and self._problem(self._member):
                break  # beside a value that is refused all others are, too
        if problems:
            raise UsageError("\n".join(problems))
        if self._problem(self._member):
            self._check(self._member)
        return CheckedDesign(self._member, tuple(refused))

    def _problem(self, member: StudyMember) -> str:
        """Return why a member is refused; one that is asked for again is not built again."""
        name = repr(member)
        if name not in self._problems:
            self._problems[name] = self._check.problem(member)
        return self._problems[name]

    def _names(self) -> list[str]:
        """Return the keys; the logs last, as they are not to blame for a value."""
        columns = self._design.columns.items()
        names = [name for name, column in columns if not isinstance(column, NoiseSeedColumn)]
        return sorted(names, key=lambda name: name == RECORDING)

    def _take_medians(self) -> None:
        """Take the median of all draws of each key."""
        for name in self._drawn:
            column = self._design.columns[name]
            if isinstance(column, SampleColumn):
                middle = np.sort(column.values)[len(column.values) // 2]
                self._member = _with_value(self._member, name, float(middle))

    def _problem_without(self, name: str) -> str:
        values = {key: value for key, value in self._member.set.items() if key != name}
        return self._problem(replace(self._member, set=values))

    def _check_drawn(self, name: str, column: SampleColumn) -> RefusedDraws | None:
        def attempt(value: float) -> str:
            member = _with_value(self._member, name, value)
            return without_key(self._problem(member), name)

        layout = self._design.layout
        draws = check_draws(
            self._drawn[name],
            np.asarray(column.values),
            attempt,
            members_each=layout.seeds * layout.grid,
        )
        if draws is not None and self._problem(self._member):
            self._member = _with_value(self._member, name, draws.accepted)
        return draws

    def _value_problems(self, name: str, values: list[Any]) -> list[str]:
        """Return what is wrong with the first values of a key that are refused.

        The keys after it are checked beside one that is taken.
        """
        built = _some(values)
        accepted: StudyMember | None = None
        problems: list[str] = []
        for number, value in enumerate(values):
            member = _with_value(self._member, name, value)
            if number in built:
                problem = self._problem(member)
            else:
                problem = self._check.problem(member, is_built=False)
            if not problem:
                accepted = accepted or member
                continue
            if name != RECORDING or not problem.startswith(str(value)):
                problem = f"{name} = {quoted(value)}: {without_key(problem, name)}"
            problems.append(f"{self._place(name, value)}{problem}")
            if len(problems) == MOST_NAMED:
                break
        if problems and accepted is not None:
            self._member = accepted
        return problems

    def _place(self, name: str, value: Any) -> str:
        """Return where a value stands in the table of cases, before a message; empty: nowhere."""
        cases = self._design.study.settings.cases
        column = self._design.columns[name]
        if cases is None or not isinstance(column, SampleColumn):
            return ""
        row = next(
            row for row, other in enumerate(plain_values(column.values), 1) if _same(other, value)
        )
        return f"file {str(cases)!r}, row {row}: "


def _same(one: Any, other: Any) -> bool:
    """Return whether values of a column are the same, NaN and NaN too."""
    return repr(one) == repr(other)


def _some(values: list[Any]) -> set[int]:
    """Return which values are built: of many some, the first and the last among them."""
    return set(np.linspace(0, len(values) - 1, min(len(values), MOST_BUILT)).astype(int).tolist())


def _values(column: DesignColumn) -> list[Any]:
    """Return the values of a column to check."""
    if not isinstance(column, GridColumn | SampleColumn):
        return []
    values = column.values
    if isinstance(values, np.ndarray):
        is_listed = isinstance(column, GridColumn) or column.indices is not None
        if is_listed and len(values) <= MOST_CHECKED:
            return list(dict.fromkeys(values.tolist()))
        extremes = [values[0], values.min(), values.max()]
        return list(dict.fromkeys(value.item() for value in extremes))
    return _distinct(values)


def _distinct(values: Iterable[Any]) -> list[Any]:
    distinct: dict[str, Any] = {}
    for value in values:
        if value is not None:
            distinct.setdefault(repr(value), value)
            if len(distinct) == MOST_CHECKED:
                break
    return list(distinct.values())


def _with_value(member: StudyMember, name: str, value: Any) -> StudyMember:
    """Return a member with another value of a key."""
    if name == RECORDING:
        return replace(member, recording=value)
    if name.startswith(SWAP):
        return replace(member, swap={**member.swap, name.removeprefix(SWAP): value})
    return replace(member, set={**member.set, name: value})
