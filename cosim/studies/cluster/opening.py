"""What a guarded child of a cluster's worker opens: the study's runner, which can be tried first.

A member of a negative number is built, not run. So it is known before the first task whether this
machine imports the classes of users, reads tables and logs, and loads the FMUs.
"""

from __future__ import annotations

from contextlib import ExitStack
from typing import Final, final

from cosim.errors import Interrupted
from cosim.studies.contracts import (
    COMPLETE,
    FAILED,
    MemberOutcome,
    MemberRunner,
    StudyMember,
    StudySubject,
)
from cosim.studies.members.measuring import reason_of
from cosim.studies.members.member_builder import MemberBuilder
from cosim.studies.members.runner import open_runner

OPENER: Final = "cosim.studies.cluster.opening:open_trying_runner"
TRIAL: Final = -1  # number of the member that is built only


@final
class TryingRunner(MemberRunner):
    """Runs the members of a study, and builds the one that is tried.

    Parameters
    ----------
    subject : StudySubject
    runner : MemberRunner
    """

    def __init__(self, subject: StudySubject, runner: MemberRunner) -> None:
        self._subject = subject
        self._runner = runner

    def close(self) -> None:
        """Close the runner."""
        self._runner.close()

    def run(self, member: StudyMember) -> MemberOutcome:
        """Run a member, or build it where it is the one that is tried."""
        if member.number != TRIAL:
            return self._runner.run(member)
        try:
            self._build(member)
        except Interrupted:
            raise
        except Exception as error:  # of a user's code, too
            return MemberOutcome(TRIAL, FAILED, reason=reason_of(error))
        return MemberOutcome(TRIAL, COMPLETE)

    def _build(self, member: StudyMember) -> None:
        builder = MemberBuilder(self._subject)
        try:
            with ExitStack() as resources:
                builder.experiment(member, resources)
        finally:
            builder.close()


def open_trying_runner(subject: StudySubject) -> TryingRunner:
    """Return the runner of a study that can be tried first."""
    return TryingRunner(subject, open_runner(subject))
