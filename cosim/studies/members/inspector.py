"""Build members without running them: what they are made of, and whether their metrics are there.

FMUs are loaded for that, and classes of users imported: it belongs into a worker.
"""

from __future__ import annotations

from contextlib import ExitStack, suppress
from typing import Final, final

from cosim.errors import CosimError, UsageError
from cosim.scenario.building.experiment import Experiment
from cosim.studies.contracts import (
    COMPLETE,
    MemberOutcome,
    MemberRunner,
    StudyMember,
    StudySubject,
)
from cosim.studies.members.designs import encode_designs
from cosim.studies.members.member_builder import MemberBuilder
from cosim.studies.members.sources import code_digests
from cosim.studies.metrics import parse_metrics

DESIGNS: Final = "designs"  # of what all members have in common, as of StudySubject
REFUSED: Final = "refused"  # why a member cannot be built
FILE: Final = "file "  # before the path of a file that a member reads
MODULE: Final = "module "  # before that of a file of a user's class


def open_inspector(subject: StudySubject) -> MemberInspector:
    """Return what builds members of a study; parameters and errors as of ``open_runner``."""
    return MemberInspector(subject)


@final
class MemberInspector(MemberRunner):
    """Builds members; the details of an outcome say what a member reads.

    Parameters
    ----------
    subject : StudySubject
    """

    def __init__(self, subject: StudySubject) -> None:
        self._metrics = parse_metrics(subject.metrics)
        self._builder = MemberBuilder(subject)

    def close(self) -> None:
        """Free what its members were built from."""
        self._builder.close()

    def run(self, member: StudyMember) -> MemberOutcome:
        """Build a member; return the SHA-256 of each file and class, and the common designs.

        Where it is refused, or a metric is of signals that it has not, the outcome says why.

        Raises
        ------
        RunError
            If an FMU fails, as it then does in the run of the member.
        ChangedFileError
            If a file changed meanwhile.
        """
        try:
            with ExitStack() as resources:
                experiment = self._builder.experiment(member, resources)
                channels = {channel.name: channel for channel in experiment.graph.layout.channels}
                self._metrics.check(channels)
                read = self._sources(experiment)
        except UsageError as error:
            return MemberOutcome(member.number, COMPLETE, details={REFUSED: str(error)})
        read[DESIGNS] = self._designs(member)
        self._builder.sources.check(member)
        return MemberOutcome(member.number, COMPLETE, details=read)

    def _designs(self, member: StudyMember) -> str:
        """Return the designs that members have in common: all of them, or those of one log."""
        if member.recording is None:
            return encode_designs(self._builder.common.given)
        with suppress(CosimError):  # what all have in common is wrong there: each has other values
            return encode_designs(self._builder.replay_designs(member.recording))
        return ""

    def _sources(self, experiment: Experiment) -> dict[str, str]:
        """Return the SHA-256 of all files that are read for a run, and of the classes of users."""
        digest = self._builder.digests.of
        sources = {f"{FILE}{path}": digest(str(path)) for path in sorted(experiment.files)}
        for path in sorted(experiment.modules):
            sources[f"{MODULE}{path}"] = digest(str(path))
        return sources | code_digests(experiment)
