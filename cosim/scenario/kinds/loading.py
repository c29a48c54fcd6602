"""Code in a build: classes of users, FMUs, and their linearizations."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from cosim.core.contracts import Component
from cosim.core.port import Port
from cosim.core.signals import Signal
from cosim.errors import LogError, UsageError, option
from cosim.scenario.document.document import short
from cosim.scenario.document.problems import TableProblems
from cosim.scenario.kinds.build_record import BuildRecord, NotImported, Origins
from cosim.scenario.record import CodeRecord, component_record

if TYPE_CHECKING:
    from cosim.fmi.component import Fmu
    from cosim.fmi.linearizing.linearization import Linearization
    from cosim.fmi.linearizing.moving import MovingLinearization
    from cosim.fmi.linearizing.request import LinearizationRequest
    from cosim.fmi.options import FmuOptions
    from cosim.scenario.kinds.user_code import UserClass

_NOT_IMPORTED: Final = (
    "defined by its class, which is not imported here; 'cosim run SCENARIO --dry-run' imports it "
    "in a separate process"
)


class CodeLoading(BuildRecord):
    """Loads what of other people runs in a build, and records what that was.

    Parameters
    ----------
    folder, resources, origins
        See :class:`BuildRecord`.
    connected : iterable of Port
        The inputs that the scenario connects.
    """

    def __init__(
        self, folder: Path, resources: ExitStack, origins: Origins, connected: Iterable[Port]
    ) -> None:
        super().__init__(folder, resources, origins)
        self._connected = connected

    def user_class(
        self, name: str, code: str, class_name: str, package: str | None = None
    ) -> UserClass:
        """Import the class of a component, and record its source.

        Parameters
        ----------
        name : str
            Of the component.
        code : str
            What names the class in the component's table.
        class_name : str
            ``package.module:Class``.
        package : str or None
            The installed one that declares it; None: it is looked for in the folder first.

        Raises
        ------
        NotImported
            If only descriptions are read.
        TableProblems
            If it cannot be imported; what was raised is the cause.
        UsageError
            In a replay, if its source is not that of the recorded run: what is computed would be of
            another component than the log says.
        """
        from cosim.scenario.kinds.user_code import OtherSource, load_class

        if self.origins.describes:
            self.add_metadata(name, {"class": class_name, "ports": _NOT_IMPORTED})
            raise NotImported(class_name)
        folder = self._folder if package is None else None
        needed = None
        recorded: CodeRecord | None = None
        recording = self.origins.recording
        is_replayed = recording is not None and code not in self.origins.named
        if recording is not None and is_replayed:
            recorded = component_record(recording, name).code
            needed = {} if recorded is None else recorded.sources
        try:
            user_class = load_class(class_name, folder, distribution=package, needed=needed)
        except OtherSource as other:
            sources = {other.file: other.found}
            own = CodeRecord.model_validate({"class": class_name, "sources": sources})
            raise _other_code(name, recorded, own) from other
        except UsageError as error:
            key = "class" if package is None else "kind"
            raise TableProblems([((key,), str(error))]) from error.__cause__
        metadata = {
            "class": class_name,
            "sources": dict(user_class.sources),
            "distribution": user_class.distribution,
        }
        own = CodeRecord.model_validate(metadata)
        if is_replayed and own != recorded:
            raise _other_code(name, recorded, own)
        self.add_metadata(name, {"code": metadata})
        self.modules.update(user_class.files)
        return user_class

    def fmu(self, name: str, path: str, options: FmuOptions) -> Component:
        """Load an FMU; it is freed at the end of the run.

        Only its description is read where nothing is to run. What a recording has as signals of
        their own is no vector: of different units, it once was none. An input has the one of its
        names that is connected.
        """
        from cosim.fmi.component import describe

        connected = [port for port in self._connected if port.component == name]
        called = {text for port in connected for text in (port.name, port.signal)}
        options = replace(options, apart=self.recorded_signals(name), called=called)

        if self.origins.describes:
            described = describe(self.file(path), options)
            self.add_metadata(name, self._with_path(name, described.metadata))
            return described
        loaded = self._resources.enter_context(self._load(name, path, options))
        self.attachments[f"{name}/modelDescription.xml"] = loaded.model_description
        self.add_metadata(name, self._with_path(name, loaded.metadata))
        for note in loaded.notes:
            self.warn(name, note)
        self.fmus[name] = loaded
        self.fmu_files[loaded.metadata["sha256"]] = Path(loaded.metadata["path"])
        if loaded.model_exchange is not None:
            self.model_exchange[name] = loaded.model_exchange
        return loaded.component

    def recorded_signals(self, name: str) -> Mapping[str, Signal]:
        """Return the signals that the recording has of a component, also of one computed again."""
        channel = (
            None if self.origins.recording is None else self.origins.recording.channels.get(name)
        )
        return {} if channel is None else channel.by_name

    def _with_path(self, name: str, metadata: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the metadata of an FMU, its path from the working folder: a log is sent to others.

        That of a recorded run stays as it is.
        """
        if name in self.origins.fmus_again:
            return metadata
        return {**metadata, "path": os.path.relpath(metadata["path"])}

    def _load(self, name: str, path: str, options: FmuOptions) -> Fmu:
        """Load an FMU, or the one of the recorded run, which is known by where it was then."""
        from cosim.fmi.component import load
        from cosim.fmi.reading.model_description import read

        again = self.origins.fmus_again.get(name)
        if again is None:
            return load(
                self.file(path), options, instance_name=name, unpacked=self.origins.unpacked
            )
        archive = replace(read(again.copy), path=Path(again.path))
        return load(again.copy, options, instance_name=name, archive=archive)

    def opened(self, name: str) -> Fmu:
        """Return the FMU that was loaded for a component.

        Raises
        ------
        UsageError
            If only its description is read.
        """
        self._need_run(name)
        return self.fmus[name]

    def linearization(self, name: str, path: str, request: LinearizationRequest) -> Linearization:
        """Linearize an FMU for a component, or take the recorded result of the same request.

        Raises
        ------
        NotImported
            If the FMU would have to be run where nothing is to run.
        UsageError
            If it is not to be opened; see :meth:`file`.
        FmuError
            If it cannot be linearized as is asked for.
        RunError
            If it cannot go on.
        LogError
            If the recorded result cannot be understood.
        """
        from cosim.fmi.linearizing.linearization import Linearization
        from cosim.fmi.linearizing.linearize import linearize_archive
        from cosim.fmi.reading.model_description import read

        def make() -> Linearization:
            self._need_run(path)
            asked = {"fmu": path, **request.to_dict()}
            recorded = None
            if self.origins.recording is not None:
                recorded = component_record(self.origins.recording, name).linearization
            if recorded is not None and recorded.request == asked:
                record = recorded.model_dump()
            else:
                archive = read(self.file(path))
                result = linearize_archive(archive, request).to_dict()
                record = {"request": asked, "sha256": archive.sha256, "result": result}
            try:
                linearization = Linearization.of(record["result"])
            except (KeyError, TypeError, ValueError, AttributeError) as error:
                raise LogError(
                    f"the recorded linearization of {path!r} is invalid: {error}"
                ) from error
            self.add_metadata(name, {"linearization": record})
            for note in linearization.notes:
                self.warn(name, note)
            return linearization

        return self.made_once("linearization", name, make)

    def moving_linearization(
        self, name: str, path: str, request: LinearizationRequest
    ) -> MovingLinearization:
        """Return an FMU that is linearized on the way; it is freed at the end of the run.

        Raises
        ------
        NotImported
            If only descriptions are read.
        UsageError
            If it is not to be opened; see :meth:`file`.
        FmuError
            If it cannot be linearized as is asked for.
        RunError
            If it does not reach its operating point.
        """
        from cosim.fmi.linearizing.linearize import open_for_linearization
        from cosim.fmi.linearizing.moving import MovingLinearization
        from cosim.fmi.reading.model_description import read

        self._need_run(path)
        archive = read(self.file(path))
        opened = self._resources.enter_context(open_for_linearization(archive, request.start))
        self.fmus[name] = opened
        return MovingLinearization(opened.instance, request)

    def _need_run(self, fmu: str) -> None:
        """Refuse what needs the code of an FMU, where nothing is to run.

        Raises
        ------
        NotImported
            If only descriptions are read.
        """
        if self.origins.describes:
            raise NotImported(fmu)


def _other_code(name: str, recorded: CodeRecord | None, own: CodeRecord) -> UsageError:
    """Return the error about code in a replay that is not that of the recorded run."""
    entry = option("set", short(f"components.{name}.class"), own.class_name)
    return UsageError(
        f"expected the recorded code, got {own.difference(recorded)}; {entry} uses the code as "
        "it is now (no longer a replay of the recorded run)"
    )
