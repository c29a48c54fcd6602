"""What a dataset says of its study, beside its rows."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from pydantic import InstanceOf, TypeAdapter, ValidationError

from cosim.digests import source_digest
from cosim.errors import UsageError
from cosim.log.contents.environment import environment
from cosim.log.contents.metadata import read_json
from cosim.studies.design.commands import run_command
from cosim.studies.document.study_file import StudyFile, study_of
from cosim.studies.layout import StudyLayout
from cosim.studies.study import Study
from cosim.version import __version__


@dataclass(frozen=True, slots=True)
class RecordedSearch:
    """What a dataset says of the search that chooses its members.

    Parameters
    ----------
    metric : str
        Name of the metric that is the objective.
    expression : str
    maximize : bool
    method : str
    members, starts, seed : int
        As of the search.
    keys : sequence of mapping
        What it varies, as plain values.
    """

    metric: str
    expression: str
    maximize: bool
    method: str
    members: int
    starts: int
    seed: int
    keys: Sequence[Mapping[str, Any]]

    @property
    def goal(self) -> str:
        """What is searched: ``minimize rms(a.y - b.y)``."""
        return f"{'maximize' if self.maximize else 'minimize'} {self.expression}"


def own_environment() -> dict[str, str]:
    """Return versions and processor here, and what tells this source of cosim from another."""
    return {**environment(), "source of cosim": source_digest()}


@dataclass(frozen=True)
class RecordedStudy:
    """What a dataset says of its study.

    Parameters
    ----------
    study : StudyFile
    layout : StudyLayout
    environment : mapping of str to str
        Versions and processor where it was planned last.
    search : RecordedSearch, optional
        That chooses the members.
    warnings : tuple of str
        What was not known of it when it was planned.
    """

    study: InstanceOf[StudyFile]
    layout: StudyLayout
    environment: Mapping[str, str]
    search: RecordedSearch | None = None
    warnings: tuple[str, ...] = ()

    def to_text(self) -> str:
        """Return the text that a dataset keeps."""
        layout, search = (
            None if one is None else asdict(one) for one in (self.layout, self.search)
        )
        described = {
            "tables": self.study.to_dict(),
            "source": self.study.source,
            "layout": layout,
            "environment": dict(self.environment),
            "search": search,
            "warnings": self.warnings,
        }
        return json.dumps(described, ensure_ascii=False)

    @classmethod
    def read(cls, text: str) -> RecordedStudy:
        """Read the text of a dataset's study.

        Raises
        ------
        UsageError
            If it is of another version of this package.
        """
        try:
            described = read_json(text)
            file = TypeAdapter(_File).validate_python(described)
            study, problems = study_of(file.tables, file.source)
            if study is not None:
                return TypeAdapter(cls).validate_python({**described, "study": study})
        except (ValueError, KeyError, TypeError) as error:
            raise _unreadable(_in_a_line(error)) from error
        raise _unreadable("; ".join(text for _, text in problems))

    def command_of(self, dataset: Study) -> Callable[[int], str]:
        """Return what gives the command that runs a member of a dataset alone.

        Its parameters are those that are recorded, whatever the study would plan by now.
        """
        return lambda number: run_command(dataset.member(number), self.study)


@dataclass(frozen=True)
class _File:
    """The file of a study, as the text of a dataset has it."""

    tables: Mapping[str, Any]
    source: str


def _in_a_line(error: Exception) -> str:
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    return f"{type(error).__name__}: {error}"


def _unreadable(problem: str) -> UsageError:
    return UsageError(
        f"the description of the study in the dataset cannot be read by cosim {__version__} "
        f"({problem}); read it with the version that wrote it, or start the study over"
    )
