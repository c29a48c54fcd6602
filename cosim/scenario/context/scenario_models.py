"""The models of a scenario, each made once: of its table, its file, or the log of a replay."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, final

from cosim.arrays import Matrix
from cosim.core.recording import Recording
from cosim.documents import plain
from cosim.errors import UsageError, nearest
from cosim.scenario.context.models import LETTERS, system_of, system_of_file
from cosim.scenario.context.named_files import NamedFiles
from cosim.scenario.record import recorded_models
from cosim.scenario.schema import ModelTable
from cosim.theory.plants.descriptor import DescriptorSystem


@final
class ScenarioModels:
    """The models of [models].

    Parameters
    ----------
    tables : mapping of name to ModelTable
    files : NamedFiles
    recording : Recording or None
        Of a replay.

    Attributes
    ----------
    records : dict of name to plain values
        For the log, of those that were read from files.
    """

    def __init__(
        self, tables: Mapping[str, ModelTable], files: NamedFiles, recording: Recording | None
    ) -> None:
        self._tables = tables
        self._files = files
        self._recording = recording
        self._systems: dict[str, DescriptorSystem] = {}
        self.records: dict[str, dict[str, Any]] = {}

    def check_known(self, name: str) -> None:
        """Check that there is a model.

        Raises
        ------
        UsageError
            If there is none of that name.
        """
        if name not in self._tables:
            known = nearest(name, self._tables)
            raise UsageError(f"unknown model {name!r} in [models]; {known}")

    def system(self, name: str) -> DescriptorSystem:
        """Return a model that there is.

        Raises
        ------
        UsageError
            If its matrices do not fit together, or its file cannot be read, or is not to be opened;
            see :meth:`NamedFiles.path`.
        LogError
            If the recorded matrices cannot be understood.
        """
        if name not in self._systems:
            table = self._tables[name]
            if table.file is None:
                self._systems[name] = system_of(table)
            else:
                self._systems[name] = system_of_file(table, self._matrices(name, table.file))
        return self._systems[name]

    def _matrices(self, name: str, path: str) -> Mapping[str, Matrix]:
        """Return the matrices of a model's file, and record them; a replay takes them from there.

        Raises
        ------
        UsageError
            If the file cannot be read, or is not to be opened.
        LogError
            If the recorded matrices cannot be understood.
        """
        if self._recording is not None:
            record = recorded_models(self._recording).get(name)
            if record is not None and record.file == path:
                self.records[name] = plain(record)
                return record.arrays
        from cosim.scenario.data_files.model_file import (  # rarely needed
            missing_text,
            read_model_file,
        )

        content = read_model_file(self._files.path(path), LETTERS)
        missing = [letter for letter in ("A", "C") if letter not in content.matrices]
        if missing:
            raise UsageError(missing_text(path, content, missing))
        matrices = {letter: rows.tolist() for letter, rows in content.matrices.items()}
        self.records[name] = {"file": path, "sha256": content.sha256, "matrices": matrices}
        return content.matrices
