"""What members read: the files that texts name, and the check that they stay what they were.

A study belongs to the content that its files have when it is planned. Whoever runs a member looks
at the files that it reads before its run and after it: one that may be another is read again, and
where it is, neither this member nor any other has an outcome. The files are

* those that a text of the scenario, of its edits or of the member names,
* those that were opened to build a run, such as the modules of users.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final, final

from cosim.digests import FileDigests, digest_of
from cosim.errors import ChangedFileError
from cosim.files import file_type
from cosim.log.mcap_file.rotation import part_paths
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.parsing import Scenario
from cosim.scenario.recordings.replaying import texts_in
from cosim.studies.contracts import StudyMember, StudySubject
from cosim.studies.document.study_file import STUDY

CODE: Final = "code of "  # before the name of a class of users
_SHOWN: Final = 12  # characters of a SHA-256


def possible_files(texts: Iterable[str], folder: Path) -> Iterator[str]:
    """Yield the paths that texts may name, from a folder on, whether there are files or not.

    What follows a path, as in ``x.fmu#cs``, may be part of the name. Of a log that was rotated the
    files before it are read, too.
    """
    for text in texts:
        path = os.path.join(folder, text)
        yield from _with_parts(path)
        if "#" in text:
            yield from _with_parts(path.rpartition("#")[0])


def common_texts(scenario: Scenario, subject: StudySubject) -> set[str]:
    """Return the texts that may name what every member reads, its own left out.

    A component that is replaced is read, too: the one in its place is compared with it.
    """
    document = scenario.document
    texts = texts_in([dict(subject.set), dict(subject.swap)])
    for tree in (scenario.tree, document.unswapped().tree()[0]):
        texts |= texts_in({name: table for name, table in tree.items() if name != STUDY})
    return texts


def member_texts(member: StudyMember) -> set[str]:
    """Return the texts of a member that may name what it reads."""
    texts = texts_in([dict(member.set), dict(member.swap)])
    if member.recording is not None:
        texts.add(member.recording)
    return texts


def code_digests(experiment: Experiment) -> dict[str, str]:
    """Return the SHA-256 of the classes of users, by the word ``code of`` and their names."""
    found = {}
    for table in experiment.metadata.values():
        if "code" in table:
            found[f"{CODE}{table['code']['class']}"] = digest_of(table["code"])
    return found


@final
class SourceCheck:
    """Checks that members read what was there when their study was planned.

    Parameters
    ----------
    subject : StudySubject
    digests : FileDigests
        Of this process.

    Raises
    ------
    ChangedFileError
        If the scenario is another one.
    """

    def __init__(self, subject: StudySubject, digests: FileDigests) -> None:
        self._expected = dict(subject.digests)
        self._digests = digests
        self._folder = Path()
        self._common: list[str] = []  # the scenario is read once, and not among them
        self._opened: set[Path] = set()
        if subject.scenario in self._expected:
            self._compare(subject.scenario)

    def open(self, scenario: Scenario, subject: StudySubject) -> None:
        """Take the files that all members have in common from the scenario, and check them.

        Raises
        ------
        ChangedFileError
            If one is another.
        """
        if not self._expected:
            return
        self._folder = scenario.document.folder
        if subject.scenario in self._expected:
            self._compare(subject.scenario)  # again, as it was read meanwhile
        self._common = self._known(common_texts(scenario, subject))
        for path in self._common:
            self._compare(path)

    def check(self, member: StudyMember) -> None:
        """Check all that a member reads, as far as it is known.

        Raises
        ------
        ChangedFileError
            If a file is another one.
        """
        if not self._expected:
            return
        for path in self._common:
            self._compare(path)
        for path in self._known(member_texts(member)):
            self._compare(path)

    def note(self, experiment: Experiment, texts: Iterable[str]) -> None:
        """Have what was opened for a run checked for all members that follow.

        What nobody knew of when the study was planned has to stay as it is now.

        Parameters
        ----------
        experiment : Experiment
        texts : iterable of str
            Of a member; what they name is checked for this one, and others that name it.

        Raises
        ------
        ChangedFileError
            If a file or a class is another one.
        """
        if not self._expected:
            return
        new = (experiment.files | experiment.modules) - self._opened
        if not new:
            return
        self._opened |= new
        named = {os.path.realpath(path) for path in (*self._common, *self._known(texts))}
        for path in map(str, new):
            if path in named:
                continue
            self._common.append(path)
            if path not in self._expected:
                self._expected[path] = self._digest(path)
            self._compare(path)
        for name, digest in code_digests(experiment).items():
            if self._expected.get(name, digest) != digest:
                raise ChangedFileError(f"the {name} has changed since this study began")

    def _known(self, texts: Iterable[str]) -> list[str]:
        return [path for path in possible_files(texts, self._folder) if path in self._expected]

    def _compare(self, path: str) -> None:
        found = self._digest(path)
        expected = self._expected[path]
        if found != expected:
            raise ChangedFileError(
                f"{path} has changed since this study began: expected the SHA-256 "
                f"{expected[:_SHOWN]}..., got {found[:_SHOWN]}..."
            )

    def _digest(self, path: str) -> str:
        try:
            return self._digests.of(path)
        except OSError as error:
            reason = error.strerror or error
            raise ChangedFileError(
                f"{path} has changed since this study began: it cannot be read ({reason})"
            ) from error


def _with_parts(path: str) -> Iterator[str]:
    """Yield a path; of a part of a log the paths of those before it, too."""
    if file_type(path) != "log":
        yield path
        return
    yield from map(str, part_paths(Path(path)))
