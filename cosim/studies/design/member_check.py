"""Check one member of a design before anything runs: its values, files, and how it is built."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from typing import Any

from cosim.errors import UsageError, option
from cosim.files import file_type
from cosim.scenario.parsing import Scenario
from cosim.scenario.preparing import build_experiment
from cosim.studies.contracts import StudyMember
from cosim.studies.design.planning import edited_scenario
from cosim.studies.design.recording_check import RecordingCheck
from cosim.studies.document.study_file import StudyFile


class MemberCheck:
    """Checks members; code of others is not run for that.

    Parameters
    ----------
    study : StudyFile
    scenario : Scenario
        Without the edits of the study.
    allow_code : bool
        Members that replay logs may run the code of users.
    """

    def __init__(self, study: StudyFile, scenario: Scenario, *, allow_code: bool) -> None:
        self._study = study
        self._scenario = scenario
        self.recording = RecordingCheck(study, scenario, allow_code=allow_code)

    def __call__(self, member: StudyMember, *, is_built: bool = True) -> None:
        """Check a member.

        Parameters
        ----------
        member : StudyMember
        is_built : bool
            Whether its run, or its replay, is built, where that runs no code of others.

        Raises
        ------
        UsageError
            If it is refused; its values are named by their keys.
        """
        try:
            edited = edited_scenario(self._study, self._scenario, member.swap, member.set)
            check_files(member.swap)
            if not is_built:
                return
            if member.recording is not None:
                self.recording(member)
            elif is_own_code(edited):
                _check_built(edited)
        except UsageError as error:
            raise UsageError(_with_keys(str(error), member)) from error

    def problem(self, member: StudyMember, *, is_built: bool = True) -> str:
        """Return why a member is refused; empty: it is not."""
        try:
            self(member, is_built=is_built)
        except UsageError as error:
            return str(error)
        return ""


def check_files(swaps: Mapping[str, str]) -> None:
    """Check that there is what takes the place of components.

    Raises
    ------
    UsageError
        If there is not.
    """
    for name, path in swaps.items():
        if not (os.path.exists(path) or os.path.exists(path.rpartition("#")[0])):
            raise UsageError(f"{option('swap', name)}: {path}: no such file")


def is_own_code(scenario: Scenario) -> bool:
    """Return whether no component runs the code of others: FMUs, classes of users."""
    if any(spec.code is not None for spec in scenario.specs.values()):
        return False
    return not any(_is_fmu(text) for text in _texts(scenario.tree.get("components")))


def without_key(problem: str, key: str) -> str:
    """Return what is wrong with a value of a key, where that is named before."""
    place = re.compile(rf"\S+:\d+ \(with {re.escape(key)}\): ")  # in the scenario, which is right
    matched = place.match(problem)
    rest = problem[matched.end() :] if matched else problem
    return rest.removeprefix(f"{key}: ").removeprefix(f"components.{key}: ")


def _with_keys(text: str, member: StudyMember) -> str:
    """Return a message that names what a study varies by its key, as nobody set it."""
    for key in member.set:
        text = text.replace(option("set", key), key)
    return text


def _check_built(scenario: Scenario) -> None:
    with ExitStack() as resources:
        experiment = build_experiment(scenario, resources, None)
        if experiment.plan is None:
            experiment.graph.prepare(experiment.clock.step_ns, experiment.designs)


def _is_fmu(text: str) -> bool:
    return file_type(text.partition("#")[0]) == "FMU"


def _texts(value: Any) -> Iterator[str]:
    """Yield every text in tables and lists."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping | list | tuple):
        for item in value.values() if isinstance(value, Mapping) else value:
            yield from _texts(item)
