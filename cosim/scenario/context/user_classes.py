"""The classes of users in a scenario, and in a replay the check that they are those of the run."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

from cosim.core.recording import Recording
from cosim.errors import UsageError, option
from cosim.scenario.context.build_records import BuildRecords
from cosim.scenario.context.named_files import NamedFiles
from cosim.scenario.kinds import Kind
from cosim.scenario.problems import TableProblems
from cosim.scenario.record import CodeRecord, component_record
from cosim.scenario.text import short

if TYPE_CHECKING:
    from cosim.scenario.user_kinds.user_code import UserClass

_NOT_IMPORTED: Final = (
    "defined by its class, which is not imported here; 'cosim run SCENARIO --dry-run' imports it "
    "in a separate process"
)


class NotImported(UsageError):
    """A component is of code that does not run here, so that nobody knows its ports."""


@final
class UserClasses:
    """The classes of users that components are made of.

    Parameters
    ----------
    folder : Path
        Of the scenario.
    specs : mapping of component name to Kind
    files : NamedFiles
    records : BuildRecords
    recording : Recording or None
        Of a replay.
    allowed : collection of str
        The classes that a replay takes as they are now.
    describes : bool
        Import nothing.
    """

    def __init__(
        self,
        folder: Path,
        specs: Mapping[str, Kind],
        files: NamedFiles,
        records: BuildRecords,
        *,
        recording: Recording | None,
        allowed: Collection[str],
        describes: bool,
    ) -> None:
        self._folder = folder
        self._specs = specs
        self._files = files
        self._records = records
        self._recording = recording
        self._allowed = allowed
        self._describes = describes

    def load(self, name: str, class_name: str, package: str | None) -> UserClass:
        """Import the class of a component, and record its source.

        Parameters
        ----------
        name : str
            Of the component.
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
        from cosim.scenario.user_kinds.user_code import OtherSource, load_class

        if self._describes:
            self._records.add_metadata(name, {"class": class_name, "ports": _NOT_IMPORTED})
            raise NotImported(class_name)
        folder = self._folder if package is None else None
        needed = None
        recorded: CodeRecord | None = None
        is_replayed = self._recording is not None and self._specs[name].code not in self._allowed
        if self._recording is not None and is_replayed:
            recorded = component_record(self._recording, name).code
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
        code = {
            "class": class_name,
            "sources": dict(user_class.sources),
            "distribution": user_class.distribution,
        }
        own = CodeRecord.model_validate(code)
        if is_replayed and own != recorded:
            raise _other_code(name, recorded, own)
        self._records.add_metadata(name, {"code": code})
        self._files.modules.update(user_class.files)
        return user_class


def _other_code(name: str, recorded: CodeRecord | None, own: CodeRecord) -> UsageError:
    """Return the error about code in a replay that is not that of the recorded run."""
    entry = option("set", short(f"components.{name}.class"), own.class_name)
    return UsageError(
        f"expected the recorded code, got {own.difference(recorded)}; {entry} uses the code as "
        "it is now (no longer a replay of the recorded run)"
    )
