"""Build the run of one member of a study."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final, final

from cosim.core.contracts import Design
from cosim.core.signals import Interface
from cosim.digests import FileDigests
from cosim.fmi.unpacked import UnpackedFmus
from cosim.log import Log
from cosim.log.editing.joining import open_joined
from cosim.log.foreign.topics import is_foreign
from cosim.scenario.building.common_designs import CommonDesigns, setting_designs, without
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.building.kept_build import KeptBuild
from cosim.scenario.parsing import Scenario
from cosim.scenario.preparing import build_experiment
from cosim.scenario.running.replay import Replays, replays_of
from cosim.studies.contracts import StudyMember, StudySubject
from cosim.studies.document.scenario_of_study import load_scenario
from cosim.studies.members.designs import decode_designs
from cosim.studies.members.sources import SourceCheck, member_texts

OPEN_LOGS: Final = 4  # whose rows may be in memory
MOST_BUILDS: Final = 16  # that are kept, of members with swaps of their own


@final
class MemberBuilder:
    """Builds members of one study; what they have in common is read once.

    Parameters
    ----------
    subject : StudySubject

    Attributes
    ----------
    digests : FileDigests
        Of this process.
    sources : SourceCheck
    fmus : UnpackedFmus

    Raises
    ------
    ScenarioError
        If there is no such scenario, or it has problems of its own.
    UsageError
        If the designs of the subject cannot be understood.
    ChangedFileError
        If a file is another one than when the study was planned.
    """

    def __init__(self, subject: StudySubject) -> None:
        self._subject = subject
        self._given = decode_designs(subject.designs)
        self._of_replays = {path: decode_designs(text) for path, text in subject.replay_designs}
        self._replay_common: dict[str, CommonDesigns] = {}
        self.digests = FileDigests()
        self.sources = SourceCheck(subject, self.digests)
        self._scenario = load_scenario(subject.scenario)
        self.sources.open(self._scenario, subject)
        self._logs: dict[str, Log] = {}
        self._builds: dict[tuple[tuple[str, str], ...], KeptBuild | None] = {}
        self.fmus = UnpackedFmus(self.digests)

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
            If it cannot be built; ChangedFileError where it reads another file than was planned.
        """
        experiment = self._experiment(member, resources)
        self.sources.note(experiment, member_texts(member))
        return experiment

    def _experiment(self, member: StudyMember, resources: ExitStack) -> Experiment:
        swaps = self.swaps(member)
        common = replace(self.common_of(member), own=decode_designs(member.designs))
        if member.recording is not None:
            replays = self._replays(member.recording, swaps)
            changes = {**self._subject.set, **member.set}
            replay = replays.experiment(changes, resources, self.fmus)
            return common.with_settings(common.prepared(replay))
        scenario = self.scenario(swaps, member.set)
        return build_experiment(scenario, resources, None, unpacked=self.fmus, common=common)

    def replay_designs(self, path: str) -> dict[str, Design]:
        """Return what replays of a recording have in common and not from there, computed here.

        Raises
        ------
        CosimError
            If such a replay cannot be built, or prepared.
        """
        with ExitStack() as resources:
            replays = self._replays(path, self._subject.swap)
            experiment = replays.experiment(self._subject.set, resources, self.fmus)
            recorded = experiment.designs or {}
            plan = experiment.plan
            if plan is None:
                plan = experiment.graph.prepare(experiment.clock.step_ns, recorded)
            return {**without(plan.designs, recorded), **setting_designs(experiment)}

    def common_of(self, member: StudyMember) -> CommonDesigns:
        """Return the designs that a member has in common with others, as far as that is known."""
        path = member.recording
        if path is None:
            return self.common
        if path not in self._replay_common:
            given = self._of_replays.get(path, {})
            computed = {}
            if given:
                with suppress(Exception):  # each member says itself what is wrong with it
                    computed = self.replay_designs(path)
            self._replay_common[path] = CommonDesigns(computed, given)
        return self._replay_common[path]

    @property
    def common(self) -> CommonDesigns:
        """The designs that members have in common with the scenario; none where it has none."""
        return self._base[1]

    def kept(self, swaps: Mapping[str, str]) -> KeptBuild | None:
        """Return what members with some swaps have in common; None: that is no run by itself."""
        if swaps == self._subject.swap:
            return self._base[0]
        key = tuple(sorted(swaps.items()))
        if key in self._builds:
            self._builds[key] = self._builds.pop(key)  # the last that was used
            return self._builds[key]
        while len(self._builds) >= MOST_BUILDS:
            del self._builds[next(iter(self._builds))]
        kept = self._built(swaps)
        if kept is not None:
            kept.take(self.common)
        self._builds[key] = kept
        return kept

    @cached_property
    def _base(self) -> tuple[KeptBuild | None, CommonDesigns]:
        """What members without swaps of their own have in common, and its designs."""
        kept = self._built(self._subject.swap)
        computed = {} if kept is None else kept.computed
        common = CommonDesigns(computed, self._given or computed)
        if kept is not None:
            kept.take(common)
        return kept, common

    def _built(self, swaps: Mapping[str, str]) -> KeptBuild | None:
        """Build the scenario with some swaps; None: it cannot be."""
        kept = None
        with suppress(Exception):  # each member says itself what is wrong with it
            scenario = self.scenario(swaps)
            replaced: Mapping[str, Interface] = {}
            warnings: list[tuple[str, str]] = []
            if scenario.file.swap:
                from cosim.scenario.swapping.swap_comparison import (
                    compare_swaps,
                    replaced_interfaces,
                )

                replaced = replaced_interfaces(scenario, self.fmus)
                warnings = compare_swaps(scenario, self.fmus).warnings
            kept = KeptBuild(scenario, self.fmus, replaced, warnings)
        if kept is not None:
            self.sources.note(kept.built, swaps.values())
        return kept

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
