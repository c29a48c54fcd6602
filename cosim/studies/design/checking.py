"""Check a design before anything runs: that the scenario takes its values."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from typing import Any, Final

import numpy as np

from cosim.errors import UsageError, option, quoted
from cosim.files import file_type
from cosim.scenario.parsing import Scenario
from cosim.scenario.preparing import build_experiment
from cosim.studies.contracts import StudyMember
from cosim.studies.design.columns import GridColumn, SampleColumn
from cosim.studies.design.planning import edited_scenario
from cosim.studies.design.recording_check import RecordingCheck
from cosim.studies.design.study_design import RECORDING, StudyDesign
from cosim.studies.document.variations import SWAP

MOST_CHECKED: Final = 2000  # values of a key
MOST_BUILT: Final = 6  # of these; each costs what a member does


def check_design(design: StudyDesign, scenario: Scenario, *, allow_code: bool = False) -> None:
    """Check that the scenario has every varied key, and takes its values.

    Of a key of the grid every value is checked, of a sampled one the first, the smallest and the
    largest, of a case's key every one that is no number, too. Of very many values these are the
    first, the smallest and the largest number, and else the first 2000. The other keys have the
    values of the first member.

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
    _check_files(study.settings.swap)
    check_recording = RecordingCheck(study, scenario, allow_code=allow_code)
    check_recording.open(first)
    for name, values in _checked(design):
        built = _some(values)
        for number, value in enumerate(values):
            member = _with_value(first, name, value)
            try:
                edited = edited_scenario(study, scenario, member.swap, member.set)
                _check_files(member.swap)
                if number not in built:
                    continue
                if member.recording is not None:
                    check_recording(member)
                elif is_own_code(edited):
                    _check_built(edited)
            except UsageError as error:
                if name == RECORDING and str(error).startswith(str(value)):
                    raise
                raise UsageError(f"{name} = {quoted(value)}: {error}") from error


def _check_files(swaps: Mapping[str, str]) -> None:
    """Check that there is what takes the place of components."""
    for name, path in swaps.items():
        if not (os.path.exists(path) or os.path.exists(path.rpartition("#")[0])):
            raise UsageError(f"{option('swap', name)}: {path}: there is no such file")


def _some(values: list[Any]) -> set[int]:
    """Return which values are built: of many some, the first and the last among them."""
    return set(np.linspace(0, len(values) - 1, min(len(values), MOST_BUILT)).astype(int).tolist())


def _check_built(scenario: Scenario) -> None:
    with ExitStack() as resources:
        experiment = build_experiment(scenario, resources, None)
        if experiment.plan is None:
            experiment.graph.prepare(experiment.clock.step_ns, experiment.designs)


def is_own_code(scenario: Scenario) -> bool:
    """Return whether no component runs the code of others: FMUs, classes of users."""
    if any(spec.code is not None for spec in scenario.specs.values()):
        return False
    return not any(_is_fmu(text) for text in _texts(scenario.tree.get("components")))


def _is_fmu(text: str) -> bool:
    return file_type(text.partition("#")[0]) == "FMU"


def _texts(value: Any) -> Iterator[str]:
    """Yield every text in tables and lists."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping | list | tuple):
        for item in value.values() if isinstance(value, Mapping) else value:
            yield from _texts(item)


def _checked(design: StudyDesign) -> Iterator[tuple[str, list[Any]]]:
    """Yield keys with the values to check; the logs last, as they are not to blame for a value."""
    columns = sorted(design.columns.items(), key=lambda item: item[0] == RECORDING)
    for name, column in columns:
        if isinstance(column, GridColumn | SampleColumn):  # seeds are right
            yield name, _values(column)


def _values(column: GridColumn | SampleColumn) -> list[Any]:
    values = column.values
    if isinstance(values, np.ndarray):
        is_few = isinstance(column, GridColumn) and len(values) <= MOST_CHECKED
        if is_few:
            return list(dict.fromkeys(values.tolist()))
        extremes = [values[0], values.min(), values.max()]
        return list(dict.fromkeys(value.item() for value in extremes))
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
