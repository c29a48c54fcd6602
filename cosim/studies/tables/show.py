"""What ``cosim study show`` prints: the study, metrics, groups, a member, or Sobol indices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from cosim.errors import UsageError, option
from cosim.studies.analysis.independence import StudyLayout
from cosim.studies.analysis.results import results_of_study
from cosim.studies.tables.groups import print_groups
from cosim.studies.tables.member import check_is_done, print_member
from cosim.studies.tables.metric import print_metrics
from cosim.studies.tables.search import print_search
from cosim.studies.tables.sensitivity import print_sobol
from cosim.studies.tables.study import WORST, CommandOf, print_study

if TYPE_CHECKING:
    from cosim.studies.study import Study
    from cosim.studies.running.recorded_study import RecordedSearch


@dataclass(frozen=True, slots=True)
class ShownParts:
    """What of a study is printed.

    Parameters
    ----------
    member : int or None
        Of this one all; None: of the study.
    metrics : tuple of str
        Of these all figures with their intervals; with ``by`` or ``sobol`` only theirs.
    conditions : tuple of str
        The share of members that pass each, such as ``rms < 0.1``.
    by : str
        Statistics for each value of this key; empty: of all members.
    sobol : bool
        Sobol indices.
    worst : int
        How many members with the largest values are named.
    as_json : bool

    Raises
    ------
    UsageError
        If these do not go together.
    """

    member: int | None = None
    metrics: tuple[str, ...] = ()
    conditions: tuple[str, ...] = ()
    by: str = ""
    sobol: bool = False
    worst: int = WORST
    as_json: bool = False

    def __post_init__(self) -> None:
        if self.worst < 0:
            raise UsageError(f"{option('worst')}: expected 0 or more, got {self.worst}")
        # Each of these prints something of its own; metrics choose what of it.
        alone = {
            "member": self.member is not None,
            "pass": bool(self.conditions),
            "by": bool(self.by),
            "sobol": self.sobol,
        }
        given = [option(name) for name, is_given in alone.items() if is_given]
        if self.metrics and (self.member is not None or self.conditions):
            given.append(option("metric"))
        if len(given) > 1:
            raise UsageError(f"expected one of {given[0]} and {given[1]}, got both")


def show_study(
    study: Study,
    layout: StudyLayout,
    command_of: CommandOf,
    parts: ShownParts,
    *,
    search: RecordedSearch | None = None,
) -> None:
    """Print what a study came to, or a part of it.

    Parameters
    ----------
    study : Study
    layout : StudyLayout
    command_of : callable
        Returns the command that runs a member alone.
    parts : ShownParts
    search : RecordedSearch, optional
        That chose the members.

    Raises
    ------
    UsageError
        If there is no such member or metric, it is not done yet, a condition is none, or the
        design of the study has no Sobol indices.
    DatasetError
        If a file is damaged.
    """
    results = results_of_study(study, layout)
    if parts.member is not None:
        check_is_done(parts.member, results)
        row = study.table(members=[parts.member]).to_pylist()[0]
        print_member(row, results, command_of(parts.member), as_json=parts.as_json)
    elif parts.sobol:
        print_sobol(results, parts.metrics, as_json=parts.as_json)
    elif parts.by:
        print_groups(results, parts.by, parts.metrics, as_json=parts.as_json)
    elif parts.metrics:
        print_metrics(results, parts.metrics, as_json=parts.as_json)
    elif search is not None and not parts.conditions:
        print_search(results, search, command_of, count=parts.worst, as_json=parts.as_json)
    else:
        print_study(
            results,
            command_of,
            conditions=parts.conditions,
            worst=parts.worst,
            as_json=parts.as_json,
        )
