"""What a dataset says of its study, beside its rows."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from cosim.errors import UsageError
from cosim.log.contents.environment import environment
from cosim.studies.analysis.independence import StudyLayout
from cosim.studies.dataset.study import Study
from cosim.studies.design.commands import run_command
from cosim.studies.document.study_file import StudyFile, study_of

_TABLES: Final = "tables"
_LAYOUT: Final = "layout"
_SOURCE: Final = "source"
_ENVIRONMENT: Final = "environment"


@dataclass(frozen=True)
class RecordedStudy:
    """What a dataset says of its study.

    Parameters
    ----------
    study : StudyFile
    layout : StudyLayout
    environment : mapping of str to str
        Versions and processor where it was planned last.
    """

    study: StudyFile
    layout: StudyLayout
    environment: Mapping[str, str] = field(default_factory=environment)

    def to_text(self) -> str:
        """Return the text that a dataset keeps."""
        tables = self.study.to_dict()
        return _text(tables, self.study.source, self.layout, self.environment)

    @classmethod
    def read(cls, text: str) -> RecordedStudy:
        """Read the text of a dataset's study.

        Raises
        ------
        UsageError
            If it is of another version of this package.
        """
        try:
            described = json.loads(text)
            study, problems = study_of(described[_TABLES], described[_SOURCE])
            layout = StudyLayout.from_dict(described[_LAYOUT])
            recorded = described[_ENVIRONMENT]
        except (ValueError, KeyError, TypeError) as error:
            raise UsageError("the study of this dataset cannot be read by this version") from error
        if study is None:
            texts = "; ".join(text for _, text in problems)
            raise UsageError(f"the study of this dataset cannot be read by this version: {texts}")
        return cls(study, layout, recorded)

    def command_of(self, dataset: Study) -> Callable[[int], str]:
        """Return what gives the command that runs a member of a dataset alone.

        Its parameters are those that are recorded, whatever the study would plan by now.
        """
        return lambda number: run_command(dataset.member(number), self.study)


def searched_text(tables: Mapping[str, Any], members: int) -> str:
    """Return what a dataset says of a study whose members a search chooses.

    Parameters
    ----------
    tables : mapping
        Of a study file.
    members : int
        How many there may be.
    """
    layout = StudyLayout("cases", samples=members)
    return _text(tables, "", layout, environment())


def _text(
    tables: Mapping[str, Any], source: str, layout: StudyLayout, versions: Mapping[str, str]
) -> str:
    described = {
        _TABLES: tables,
        _SOURCE: source,
        _LAYOUT: layout.to_dict(),
        _ENVIRONMENT: dict(versions),
    }
    return json.dumps(described, ensure_ascii=False)
