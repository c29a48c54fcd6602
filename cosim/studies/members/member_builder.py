"""Build the run of one member of a study."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, final

from cosim.fmi.unpacked import UnpackedFmus
from cosim.log import Log
from cosim.log.editing.joining import open_joined
from cosim.log.foreign.topics import is_foreign
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.parsing import Scenario
from cosim.scenario.preparing import build_experiment
from cosim.scenario.running.replay import Replays, replays_of
from cosim.studies.contracts import StudyMember, StudySubject
from cosim.studies.document.scenario_of_study import load_scenario

OPEN_LOGS: Final = 4  # whose rows may be in memory


@final
class MemberBuilder:
    """Builds members of one study; what they have in common is read once.

    Parameters
    ----------
    subject : StudySubject

    Attributes
    ----------
    fmus : UnpackedFmus

    Raises
    ------
    ScenarioError
        If there is no such scenario, or it has problems of its own.
    """

    def __init__(self, subject: StudySubject) -> None:
        self._subject = subject
        self._scenario = load_scenario(subject.scenario)
        self._logs: dict[str, Log] = {}
        self.fmus = UnpackedFmus()

    def close(self) -> None:
        """Forget the logs, and remove the unpacked FMUs."""
        self._logs.clear()
        self.fmus.close()

    def swaps(self, member: StudyMember) -> dict[str, str]:
        """Return all swaps of a member."""
        return {**self._subject.swap, **member.swap}

    def scenario(
        self, swaps: Mapping[str, str], changes: Mapping[str, Any] | None = None
    ) -> Scenario:
        """Return the scenario with the edits of all members, and those of one."""
        subject = self._subject
        values = {**subject.set, **(changes or {})}
        return self._scenario.edit(swap=swaps, map=subject.map, set=values)

    def experiment(self, member: StudyMember, resources: ExitStack) -> Experiment:
        """Build the run of a member, or its replay.

        Raises
        ------
        CosimError
            If it cannot be built.
        """
        swaps = self.swaps(member)
        if member.recording is not None:
            replays = self._replays(member.recording, swaps)
            return replays.experiment({**self._subject.set, **member.set}, resources)
        scenario = self.scenario(swaps, member.set)
        return build_experiment(scenario, resources, None, unpacked=self.fmus)

    def _replays(self, path: str, swaps: Mapping[str, str]) -> Replays:
        """Return a recording that can be replayed."""
        log = self._log(path)
        return replays_of(
            log,
            swap=swaps,
            map=self._subject.map,
            allow_code=self._subject.allow_code,
            scenario=None if isinstance(log, Log) else self._scenario,
        )

    def _log(self, path: str) -> Log | str:
        """Return a log, which is opened once; of another tool's recording its path."""
        if path not in self._logs:
            if is_foreign(Path(path)):
                return path
            while len(self._logs) >= OPEN_LOGS:
                del self._logs[next(iter(self._logs))]
            self._logs[path] = open_joined(path)
        return self._logs[path]
