"""Check that logs can be replayed with the values of a study."""

from __future__ import annotations

from pathlib import Path

from cosim.log.foreign.topics import is_foreign
from cosim.scenario.parsing import Scenario
from cosim.scenario.running.replay import Replays, replays_of
from cosim.studies.contracts import StudyMember
from cosim.studies.design.recorded_base import check_is_of_scenario
from cosim.studies.document.study_file import StudyFile


class RecordingCheck:
    """Builds the replays of members, without their run; a log is opened once in a row.

    Parameters
    ----------
    study : StudyFile
    scenario : Scenario
        Without the edits of the study.
    allow_code : bool
        The replays may run the code of users: then they are not built here.
    """

    def __init__(self, study: StudyFile, scenario: Scenario, *, allow_code: bool) -> None:
        self._study = study
        self._scenario = scenario
        self._allow_code = allow_code
        self._path = ""
        self._replays: Replays | None = None

    def __call__(self, member: StudyMember) -> None:
        """Check a member that replays a log.

        Raises
        ------
        UsageError
            If the log cannot be read, or not be replayed with the values of the member.
        """
        replays = self.open(member)
        if replays is not None:
            replays.check(member.set)

    def open(self, member: StudyMember) -> Replays | None:
        """Return the replays of a member's log; None: it replays none, or may run code.

        Raises
        ------
        UsageError
            If the log cannot be read, is of another scenario, or does not go with what all
            members have.
        """
        path = member.recording
        if path is None:
            return None
        is_of_other_tool = is_foreign(Path(path))
        if self._path != path:
            if not is_of_other_tool:
                check_is_of_scenario(path, self._scenario)
            self._path = path
            self._replays = None
        if self._may_run_code(member):
            return None
        if self._replays is None:
            settings = self._study.settings
            scenario = self._scenario if is_of_other_tool else None
            self._replays = replays_of(path, set=settings.set, map=settings.map, scenario=scenario)
        return self._replays

    def _may_run_code(self, member: StudyMember) -> bool:
        settings = self._study.settings
        keys = [*settings.set, *member.set]
        has_class = any(key.endswith(".class") for key in keys)
        return self._allow_code or bool(settings.swap or member.swap) or has_class
