"""The FMUs of a scenario: loaded, described or linearized for its components."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, final

from cosim.core.contracts import Component
from cosim.core.recording import Recording
from cosim.errors import LogError
from cosim.scenario.context.build_records import BuildRecords
from cosim.scenario.context.named_files import NamedFiles
from cosim.scenario.context.user_classes import NotImported
from cosim.scenario.record import LinearizationRecord, component_record

if TYPE_CHECKING:
    from cosim.fmi.component import Fmu
    from cosim.fmi.driving.model_exchange import ModelExchange
    from cosim.fmi.linearizing.linearization import Linearization
    from cosim.fmi.linearizing.moving import MovingLinearization
    from cosim.fmi.linearizing.request import LinearizationRequest
    from cosim.fmi.options import FmuOptions
    from cosim.fmi.unpacked import UnpackedFmus


@dataclass(frozen=True, slots=True)
class RecordedFmu:
    """The FMU of a recorded run, which is run again.

    Parameters
    ----------
    copy : Path
        A file with the bytes that the run had.
    path : str
        Where it was then.
    means : bool
        Whether every input with one value over a step had the mean of both ends, where it moved:
        in a log that does not tell which had it.
    """

    copy: Path
    path: str
    means: bool


NONE_AGAIN: Final[Mapping[str, RecordedFmu]] = MappingProxyType({})


@final
class ScenarioFmus:
    """The FMUs that the components of a scenario are made of.

    Parameters
    ----------
    files : NamedFiles
    records : BuildRecords
    resources : ExitStack
        Closes what is opened.
    recording : Recording or None
        Of a replay.
    describes : bool
        Run nothing: read descriptions only.
    again : mapping of component name to RecordedFmu
        Of a replay: those that are run again.
    unpacked : UnpackedFmus or None
        Where they are unpacked and loaded for all builds of a process; None: for this one.

    Attributes
    ----------
    paths : dict of SHA-256 to Path
        The files of those that were loaded for components.
    opened : dict of component name to Fmu
    model_exchange : dict of component name to ModelExchange
        What has the continuous states of a component.
    """

    def __init__(
        self,
        files: NamedFiles,
        records: BuildRecords,
        resources: ExitStack,
        *,
        recording: Recording | None,
        describes: bool,
        again: Mapping[str, RecordedFmu] = NONE_AGAIN,
        unpacked: UnpackedFmus | None = None,
    ) -> None:
        self.unpacked = unpacked
        self._files = files
        self._records = records
        self._resources = resources
        self._recording = recording
        self._describes = describes
        self._again = again
        self.paths: dict[str, Path] = {}
        self._linearized: dict[str, Linearization] = {}
        self.opened: dict[str, Fmu] = {}
        self.model_exchange: dict[str, ModelExchange] = {}

    def component(self, name: str, path: str, options: FmuOptions) -> Component:
        """Load an FMU; it is freed at the end of the run.

        Only its description is read where nothing is to run.
        """
        from cosim.fmi.component import describe

        if self._describes:
            described = describe(self._files.path(path), options)
            self._records.add_metadata(name, self._recorded(name, described.metadata))
            return described
        loaded = self._resources.enter_context(self._load(name, path, options))
        self._records.attachments[f"{name}/modelDescription.xml"] = loaded.model_description
        self._records.add_metadata(name, self._recorded(name, loaded.metadata))
        for note in loaded.notes:
            self._records.warn(name, note)
        self.opened[name] = loaded
        self.paths[loaded.metadata["sha256"]] = Path(loaded.metadata["path"])
        if loaded.model_exchange is not None:
            self.model_exchange[name] = loaded.model_exchange
        return loaded.component

    def _recorded(self, name: str, metadata: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the metadata of an FMU, its path from the working folder: a log is sent to others.

        That of a recorded run stays as it is.
        """
        if name in self._again:
            return metadata
        return {**metadata, "path": os.path.relpath(metadata["path"])}

    def _load(self, name: str, path: str, options: FmuOptions) -> Fmu:
        """Load an FMU, or the one of the recorded run, which is known by where it was then."""
        from cosim.fmi.component import load
        from cosim.fmi.reading.model_description import read

        again = self._again.get(name)
        if again is None:
            return load(self._files.path(path), options, instance_name=name, unpacked=self.unpacked)
        archive = replace(read(again.copy), path=Path(again.path))
        return load(again.copy, options, instance_name=name, archive=archive)

    def of(self, name: str) -> Fmu:
        """Return the FMU that was loaded for a component.

        Raises
        ------
        UsageError
            If only its description is read.
        """
        self._need_run(name)
        return self.opened[name]

    def linearization(self, name: str, path: str, request: LinearizationRequest) -> Linearization:
        """Linearize an FMU for a component, or take the recorded result of the same request.

        Raises
        ------
        NotImported
            If the FMU would have to be run where nothing is to run.
        UsageError
            If it is not to be opened; see :meth:`NamedFiles.path`.
        FmuError
            If it cannot be linearized as is asked for.
        RunError
            If it cannot go on.
        LogError
            If the recorded result cannot be understood.
        """
        from cosim.fmi.linearizing.linearization import Linearization

        if name not in self._linearized:
            self._need_run(path)
            request_record = {"fmu": path, **request.to_dict()}
            recorded = self._recorded_linearization(name)
            if recorded is not None and recorded.request == request_record:
                record = recorded.model_dump()
            else:
                record = {"request": request_record, **self._linearize(path, request)}
            try:
                linearization = Linearization.of(record["result"])
            except (KeyError, TypeError, ValueError, AttributeError) as error:
                raise LogError(
                    f"the recorded linearization of {path!r} is invalid: {error}"
                ) from error
            self._linearized[name] = linearization
            self._records.add_metadata(name, {"linearization": record})
            for note in linearization.notes:
                self._records.warn(name, note)
        return self._linearized[name]

    def moving_linearization(
        self, name: str, path: str, request: LinearizationRequest
    ) -> MovingLinearization:
        """Return an FMU that is linearized on the way; it is freed at the end of the run.

        Raises
        ------
        NotImported
            If only descriptions are read.
        UsageError
            If it is not to be opened; see :meth:`NamedFiles.path`.
        FmuError
            If it cannot be linearized as is asked for.
        RunError
            If it does not reach its operating point.
        """
        from cosim.fmi.linearizing.linearize import open_for_linearization
        from cosim.fmi.linearizing.moving import MovingLinearization
        from cosim.fmi.reading.model_description import read

        self._need_run(path)
        archive = read(self._files.path(path))
        opened = self._resources.enter_context(open_for_linearization(archive, request.start))
        self.opened[name] = opened
        return MovingLinearization(opened.instance, request)

    def _need_run(self, fmu: str) -> None:
        """Refuse what needs the code of an FMU, where nothing is to run.

        Raises
        ------
        NotImported
            If only descriptions are read.
        """
        if self._describes:
            raise NotImported(fmu)

    def _linearize(self, path: str, request: LinearizationRequest) -> dict[str, Any]:
        from cosim.fmi.linearizing.linearize import linearize_archive
        from cosim.fmi.reading.model_description import read

        archive = read(self._files.path(path))
        result = linearize_archive(archive, request)
        return {"sha256": archive.sha256, "result": result.to_dict()}

    def _recorded_linearization(self, name: str) -> LinearizationRecord | None:
        if self._recording is None:
            return None
        return component_record(self._recording, name).linearization
