"""What the workers of a cluster are told of a study."""

from __future__ import annotations

import os
import secrets
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Self

from cosim.studies.cluster.file_copies import named_files
from cosim.studies.cluster.opening import TRIAL
from cosim.studies.contracts import StudyMember, StudySubject
from cosim.studies.document.scenario_of_study import is_log, load_scenario


@dataclass(frozen=True, slots=True)
class DatasetProbe:
    """A file in the dataset, and what is in it: who reads and writes it reaches the dataset."""

    name: str
    content: bytes


@dataclass(frozen=True, slots=True)
class ClusterStudy:
    """What the workers of a cluster are told of a study; paths are those of the planner.

    Parameters
    ----------
    name : str
        No other study on the cluster has it.
    subject : StudySubject
        With absolute paths.
    files : mapping of absolute path to SHA-256
        Of every file that the scenario and its members read.
    named : mapping of path to path
        As of :func:`named_files`, of the scenario.
    trial : StudyMember
        That is built on each worker before it is used.
    timeout : float or None
        Wall time that a member may take [s], as of :class:`WorkerPool`.
    place : str
        Where the dataset is.
    sha256 : str
        Of the study that the dataset is of.
    probe : DatasetProbe
    opener : str
        As of :class:`WorkerPool`.
    """

    name: str
    subject: StudySubject
    files: Mapping[str, str]
    named: Mapping[str, str]
    trial: StudyMember
    timeout: float | None
    place: str
    sha256: str
    probe: DatasetProbe
    opener: str

    @classmethod
    def planned(
        cls,
        subject: StudySubject,
        first: StudyMember,
        *,
        files: Mapping[str, str],
        timeout: float | None,
        place: str,
        sha256: str,
        opener: str,
    ) -> Self:
        """Return what workers are told, under a new name.

        Parameters
        ----------
        first : StudyMember
            Whose values are tried.
        """
        name = f"cosim-study-{secrets.token_hex(6)}"
        scenario = _scenario(subject, files)
        return cls(
            name=name,
            subject=replace(subject, scenario=scenario),
            files=dict(files),
            named=_named(scenario, files),
            trial=replace(first, number=TRIAL, designs=""),
            timeout=timeout,
            place=place if "://" in place else os.path.abspath(place),
            sha256=sha256,
            probe=DatasetProbe(f"_{name}", secrets.token_bytes(16)),
            opener=opener,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain values: nothing else is sent to workers."""
        return asdict(self)

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Self:
        """Return the study of :meth:`to_dict`."""
        parts = {
            "subject": StudySubject(**content["subject"]),
            "trial": StudyMember(**content["trial"]),
            "probe": DatasetProbe(**content["probe"]),
        }
        return cls(**{**content, **parts})


def _scenario(subject: StudySubject, files: Mapping[str, str]) -> str:
    """Return the scenario under the name that it has among the files, which may have no links."""
    real = os.path.realpath(subject.scenario)
    return real if real in files and subject.scenario not in files else subject.scenario


def _named(scenario: str, files: Mapping[str, str]) -> dict[str, str]:
    """Return the files that the text of a scenario names by absolute paths."""
    if scenario not in files or is_log(scenario):
        return {}
    return named_files(load_scenario(scenario).tree, files)
