"""What the members of a study read: every file that one of them may read is hashed, each once.

These are the files that texts of the scenario and of its members name, and what members open that
are built for it: one of all, and one for each of the first texts that are varied.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from cosim.digests import sha256_of
from cosim.errors import RunError, UsageError, listing
from cosim.files import file_type
from cosim.log.mcap_file.rotation import part_paths
from cosim.scenario.parsing import Scenario
from cosim.scenario.recordings.replaying import texts_in
from cosim.studies.contracts import MemberOutcome, StudyMember, StudySubject
from cosim.studies.document.study_file import STUDY
from cosim.studies.members import MemberSources

_KINDS: Final = {".fmu": "FMU", ".mcap": "log", ".csv": "table", ".parquet": "table"}
_SHOWN: Final = 5  # members that a warning names


@dataclass(frozen=True, slots=True)
class StudySources:
    """What the members of a study read.

    Parameters
    ----------
    files : mapping of path to SHA-256
        Under the absolute paths that are opened, and without links; the scenario among them.
    modules : mapping of path to SHA-256
        The files of the classes of users.
    codes : mapping of name to SHA-256
        The classes of users, wherever their files are: ``code of relay:Relay``.
    designs : str
    replay_designs : tuple of (str, str)
        As of StudySubject.
    warnings : tuple of str
        What could not be found out.
    """

    files: Mapping[str, str] = field(default_factory=dict)
    modules: Mapping[str, str] = field(default_factory=dict)
    codes: Mapping[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    def given_to(self, subject: StudySubject) -> StudySubject:
        """Return a subject whose members are checked to read just this."""
        digests = {**self.files, **self.modules, **self.codes}
        return replace(subject, digests=digests)

    def digests(self, scenario: str, folder: Path) -> dict[str, str]:
        """Return the SHA-256 of everything but the scenario, by names for messages.

        Parameters
        ----------
        scenario : str
            Its path: the study belongs to its tables, as they are with all edits.
        folder : Path
            From which files are named.
        """
        own = "" if file_type(scenario) == "log" else os.path.realpath(scenario)
        found = {}
        for path, digest in self.files.items():
            real = os.path.realpath(path)
            if real != own:
                found[_label(Path(real), folder)] = digest
        return {**found, **self.codes}

    def movable(self, folder: Path) -> dict[str, str]:
        """Return the files that another machine may be sent: modules from the scenario's folder."""
        own = {path: digest for path, digest in self.modules.items() if _is_in(path, folder)}
        return {**self.files, **own}


def scenario_digest(subject: StudySubject) -> dict[str, str]:
    """Return the SHA-256 of the scenario's file by its paths; nothing: it is a shipped one.

    It is to be asked for before the scenario is read: where that changes in between, no member
    runs.
    """
    path = subject.scenario
    if not os.path.isfile(path):
        return {}
    digest = sha256_of(path)
    return {path: digest, os.path.realpath(path): digest}


def named_files(texts: Iterable[str], folder: Path) -> dict[str, str]:
    """Return the SHA-256 of the files that texts name, by the paths that are opened and the real.

    Raises
    ------
    UsageError
        If one cannot be read.
    """
    files: dict[str, str] = {}
    for path in possible_files(texts, folder):
        if path in files or not os.path.isfile(path):
            continue
        try:
            real = os.path.realpath(path)
            files[path] = files[real] if real in files else sha256_of(path)
        except OSError as error:
            raise UsageError(
                f"{path}: cannot be read ({error.strerror or error}); expected a readable file"
            ) from error
        files[real] = files[path]
    return files


def found_sources(
    files: Mapping[str, str],
    found: Mapping[int, MemberSources | MemberOutcome],
    members: Mapping[int, StudyMember],
    *,
    refused: Callable[[StudyMember, str], str],
) -> StudySources:
    """Return what members read, as those say that were built, and as is known of all others.

    Parameters
    ----------
    files : mapping of path to SHA-256
        Those that are known to be read, from before members were built.
    outcomes : iterable of MemberOutcome
        Of the inspector.
    members : mapping of number to StudyMember
    refused : callable
        Returns what to say of a member that is refused, given the reason.

    Raises
    ------
    UsageError
        If a member is refused.
    RunError
        If a file changed meanwhile.
    """
    known = dict(files)
    modules: dict[str, str] = {}
    codes: dict[str, str] = {}
    lost: dict[str, list[int]] = {}
    for number, one in found.items():
        if isinstance(one, MemberOutcome):
            lost.setdefault(one.reason, []).append(number)
            continue
        if one.refused:
            raise UsageError(refused(members[number], one.refused))
        codes |= one.codes
        modules |= one.modules
        for path, digest in one.files.items():
            _add(known, path, digest)
    return StudySources(known, modules, codes, tuple(_warnings(lost)))


def _add(files: dict[str, str], path: str, digest: str) -> None:
    if files.setdefault(path, digest) != digest:
        raise RunError(f"{path} has changed while the study was being planned; plan it again")


def _warnings(lost: Mapping[str, Sequence[int]]) -> Iterator[str]:
    """Return what is not known of members that could not be built."""
    for reason, numbers in lost.items():
        names = listing(list(map(str, numbers)), _SHOWN)
        plural = "s" if len(numbers) > 1 else ""
        yield (
            f"member{plural} {names} could not be built when the study was planned: {reason}; the "
            "files that are named are known, but not whether more are read, and the metrics were "
            "not checked"
        )


def _label(path: Path, folder: Path) -> str:
    """Return how a file is named in messages: by its path from the scenario's folder."""
    kind = _KINDS.get(path.suffix.lower(), "file")
    return f"{kind} {path.relative_to(folder) if path.is_relative_to(folder) else path}"


def _is_in(path: str, folder: Path) -> bool:
    return Path(path).is_relative_to(os.path.realpath(folder))


def possible_files(texts: Iterable[str], folder: Path) -> Iterator[str]:
    for text in texts:
        path = os.path.join(folder, text)
        yield from _with_parts(path)
        if "#" in text:
            yield from _with_parts(path.rpartition("#")[0])


def common_texts(scenario: Scenario, subject: StudySubject) -> set[str]:
    document = scenario.document
    texts = texts_in([dict(subject.set), dict(subject.swap)])
    for tree in (scenario.tree, document.unswapped().tree()[0]):
        texts |= texts_in({name: table for name, table in tree.items() if name != STUDY})
    return texts


def _with_parts(path: str) -> Iterator[str]:
    if file_type(path) != "log":
        yield path
        return
    yield from map(str, part_paths(Path(path)))
