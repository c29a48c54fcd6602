"""Whose dataset it is: what must be the same for outcomes of two sessions to belong together."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

from pydantic import TypeAdapter

from cosim.digests import digest_of
from cosim.errors import DatasetError, flag
from cosim.log.contents.metadata import read_json
from cosim.studies.dataset.columns import StudyColumn, all_columns
from cosim.studies.dataset.layout import PartLayout
from cosim.version import __version__

FORMAT: Final = 2
_READ: Final = (1, FORMAT)  # parts of 1 have no column of warnings
PART_SIZE: Final = 1000
DESCRIPTION: Final = "study.json"
OF_KEY: Final = "key "  # begins what the digest of a key of the scenario is named
OF_METRICS: Final = "the metrics"  # what the digest of the metrics is named
_CHECKSUM: Final = "checksum"
_SHOWN: Final = 8  # differences


@dataclass(frozen=True, slots=True)
class StudyIdentity:
    """What a study is about.

    Parameters
    ----------
    name : str
    text : str
        The study as it was written, for readers; it may change.
    digests : mapping of str to str
        SHA-256 of everything that outcomes depend on, by a name for messages: those of
        :func:`scenario_digests`, ``FMU plant.fmu``, ``table cases.csv``, ``the metrics``. Those of
        files that a study is grown by may come in addition.
    columns : tuple of StudyColumn
        Its parameters and metrics.
    members : int
        How many are planned.
    part_size : int
        Fixed when the dataset is made.
    version : str
        Of cosim.
    designs : str
    replay_designs : tuple of (str, str)
        As of StudySubject. Fixed when the dataset is made, so that a study which goes on elsewhere
        has the same; those of further logs come in addition.
    """

    name: str
    text: str
    digests: Mapping[str, str]
    columns: tuple[StudyColumn, ...]
    members: int
    part_size: int = PART_SIZE
    version: str = __version__
    designs: str = ""
    replay_designs: tuple[tuple[str, str], ...] = ()

    @property
    def sha256(self) -> str:
        """Return what tells its parts from those of another study."""
        types = {column.name: column.type for column in self.columns}
        return digest_of([self.version, dict(self.digests), types])


@dataclass(frozen=True, slots=True)
class DatasetDescription:
    """What ``study.json`` says.

    Parameters
    ----------
    identity : StudyIdentity
    sha256 : str
        Of the identity with which the dataset was made.
    layout : PartLayout
    """

    identity: StudyIdentity
    sha256: str
    layout: PartLayout

    @classmethod
    def of(cls, identity: StudyIdentity) -> DatasetDescription:
        """Return that of a new dataset."""
        layout = PartLayout(identity.part_size, (identity.members,))
        return cls(identity, identity.sha256, layout)

    @property
    def columns(self) -> tuple[StudyColumn, ...]:
        """Every column of a part, in order."""
        return all_columns(self.identity.columns)

    def grown(self, identity: StudyIdentity) -> DatasetDescription:
        """Return that of the same study with more members: columns and part size are kept."""
        before = self.identity
        replays = {**dict(identity.replay_designs), **dict(before.replay_designs)}
        merged = replace(
            identity,
            digests={**before.digests, **identity.digests},
            columns=before.columns,
            part_size=self.layout.size,
            designs=before.designs or identity.designs,
            replay_designs=tuple(replays.items()),
        )
        return replace(self, identity=merged, layout=self.layout.grown(identity.members))

    def to_json(self) -> bytes:
        """Return the content of the file."""
        identity = self.identity
        content = {
            "format": FORMAT,
            "cosim": identity.version,
            "name": identity.name,
            "sha256": self.sha256,
            "part_size": self.layout.size,
            "lengths": list(self.layout.lengths),
            "digests": dict(identity.digests),
            "columns": [asdict(column) for column in identity.columns],
            "study_sha256": hashlib.sha256(identity.text.encode()).hexdigest(),
            "study": identity.text,
            "designs": identity.designs,
            "replay_designs": [list(pair) for pair in identity.replay_designs],
        }
        content[_CHECKSUM] = digest_of(content)
        return (json.dumps(content, indent=1, ensure_ascii=False) + "\n").encode()

    @classmethod
    def from_json(cls, content: bytes, label: str) -> DatasetDescription:
        """Read the content of the file ``label``.

        Raises
        ------
        DatasetError
            If it is damaged, or of another version of the format.
        """
        try:
            found = read_json(content)
            checksum = found.pop(_CHECKSUM)
            version = found["format"]
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise _damaged(label) from error
        if version not in _READ:
            raise DatasetError(
                f"{label}: expected dataset format {FORMAT}, got {version!r}; read it with cosim "
                f"{found.get('cosim')}, or choose another folder"
            )
        if checksum != digest_of(found):
            raise _damaged(label)
        try:
            return cls._of_content(found)
        except (KeyError, TypeError, ValueError) as error:
            raise DatasetError(
                f"{label}: written by another revision of cosim {found.get('cosim')}; read it "
                "with that one, or choose another folder"
            ) from error

    @classmethod
    def _of_content(cls, content: Mapping[str, Any]) -> DatasetDescription:
        layout = TypeAdapter(PartLayout).validate_python(
            {"size": content["part_size"], "lengths": content["lengths"]}
        )
        identity = TypeAdapter(StudyIdentity).validate_python(
            {
                "name": content["name"],
                "text": content["study"],
                "digests": content["digests"],
                "columns": content["columns"],
                "members": layout.total,
                "part_size": layout.size,
                "version": content["cosim"],
                "designs": content["designs"],
                "replay_designs": content["replay_designs"],
            }
        )
        return cls(identity, str(content["sha256"]), layout)


def scenario_digests(tables: Mapping[str, Any]) -> dict[str, str]:
    """Return the SHA-256 of the value of each key in the tables of a scenario.

    They are named ``key components.plant``, ``key scenario.stop``; a table without keys, and a
    list, as a whole.
    """
    digests = {}
    for name, table in tables.items():
        if not isinstance(table, Mapping) or not table:
            digests[f"{OF_KEY}{name}"] = digest_of(table)
            continue
        for key, value in table.items():
            digests[f"{OF_KEY}{name}.{key}"] = digest_of(value)
    return digests


def differences(recorded: StudyIdentity, planned: StudyIdentity) -> str:
    """Return what makes two studies different ones, the first of it; empty: they are one.

    One that has grown is the same.
    """
    found = []
    if recorded.version != planned.version:
        found.append(f"it was made by cosim {recorded.version}, this is {planned.version}")
    found += _other_digests(recorded.digests, planned.digests)
    found += _other_parameters(_parameters(recorded), _parameters(planned))
    more = len(found) - _SHOWN
    if more > 0:
        found = [*found[:_SHOWN], f"and {more} other difference{'' if more == 1 else 's'}"]
    return "; ".join(found)


def _other_digests(recorded: Mapping[str, str], planned: Mapping[str, str]) -> list[str]:
    found = []
    for name, digest in recorded.items():
        if name not in planned:
            found.append(f"{name} is no longer part of it")
        elif planned[name] != digest:
            found.append(f"{name} changed")
    for name in planned:
        if name.startswith(OF_KEY) and name not in recorded:
            found.append(f"{name} is new")
    return found


def _other_parameters(before: Mapping[str, str], after: Mapping[str, str]) -> list[str]:
    """Return which parameters differ, given the types of their columns."""
    found = []
    for name in sorted(before.keys() - after.keys()):
        found.append(f"{name} is no longer varied")
    for name in sorted(after.keys() - before.keys()):
        found.append(f"{name} is varied now")
    for name in sorted(before.keys() & after.keys()):
        if before[name] != after[name]:
            found.append(f"the values of {name} were of type {before[name]}, are {after[name]}")
    return found


def _parameters(identity: StudyIdentity) -> dict[str, str]:
    columns = (column for column in identity.columns if column.role == "parameter")
    return {column.name: column.type for column in columns}


def check_is_dataset(content: bytes | None, label: str) -> None:
    """Check that a file may be the description of a dataset, whole or damaged: it is replaced.

    Raises
    ------
    DatasetError
        If it is another program's.
    """
    if content is None:
        return
    try:
        found = read_json(content)
    except ValueError:
        return
    if not isinstance(found, dict) or _CHECKSUM not in found:
        raise DatasetError(f"{label} is not that of a dataset; choose another folder, or remove it")


def _damaged(label: str) -> DatasetError:
    return DatasetError(
        f"{label} is damaged; restore it from a copy, or use {flag('new')} to start over without "
        "the recorded members"
    )
