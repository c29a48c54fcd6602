"""Where the components of a build come from, and what is recorded while they are built."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

from cosim.arguments import check_path
from cosim.core.recording import Recording
from cosim.errors import UsageError, option, quoted
from cosim.files import expanded

if TYPE_CHECKING:
    from cosim.fmi.component import Fmu
    from cosim.fmi.driving.model_exchange import ModelExchange
    from cosim.fmi.unpacked import UnpackedFmus

T = TypeVar("T")


class DependsOnInvalid(UsageError):
    """A component cannot be checked because something that it reads is wrong and reported."""


class NotImported(UsageError):
    """A component is of code that does not run here, so that nobody knows its ports."""


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Origins:
    """Where the components of a scenario come from, beside its tables.

    Parameters
    ----------
    recording : Recording or None
        Every component that cannot be computed again from the log is taken from it: plants, FMUs,
        files.
    named : collection of str
        With a recording: the files that may be opened, and the classes that are taken as they are
        now, all the same.
    left_out : collection of str
        With a recording: components that are taken from it although they could be computed.
    fmus_again : mapping of component name to RecordedFmu
        With a recording: FMUs of its run that are run again.
    describes : bool
        Nothing of an FMU or a user's class runs: what is built shows what there is, and cannot run.
    unpacked : UnpackedFmus or None
        Where FMUs are unpacked and loaded for all builds of a process; None: for this one.
    """

    recording: Recording | None = None
    named: Collection[str] = ()
    left_out: Collection[str] = ()
    fmus_again: Mapping[str, RecordedFmu] = field(default_factory=dict)
    describes: bool = False
    unpacked: UnpackedFmus | None = None


TABLES_ALONE: Final = Origins()


class BuildRecord:
    """What a build records: what each component reads, opens and says.

    Parameters
    ----------
    folder : Path
        That paths of the scenario start from.
    resources : ExitStack
        Closes what is opened.
    origins : Origins
        Where components come from, beside their tables.

    Attributes
    ----------
    current : str
        The component that is being built.
    metadata : dict of component name to plain values
    warnings : list of (component, text)
    reads : dict of component name to names of tables
        That were read to build the component, and its design rests on.
    attachments : dict of file name to text
        For the log.
    files : set of Path
        Those that are read.
    modules : set of Path
        Those of the classes of users.
    model_records : dict of name to plain values
        For the log, of the models that were read from files.
    fmus : dict of component name to Fmu
        Those that were loaded.
    fmu_files : dict of SHA-256 to Path
        Of those that were loaded for components.
    model_exchange : dict of component name to ModelExchange
        What has the continuous states of a component.
    identified : dict of identifier to IdentifiedPlant
    """

    def __init__(self, folder: Path, resources: ExitStack, origins: Origins) -> None:
        self.origins = origins
        self._folder = folder
        self._resources = resources
        self.current = ""
        self.metadata: dict[str, dict[str, Any]] = {}
        self.warnings: list[tuple[str, str]] = []
        self.reads: dict[str, frozenset[str]] = {"": frozenset()}
        self.attachments: dict[str, str] = {}
        self.files: set[Path] = set()
        self.modules: set[Path] = set()
        self.model_records: dict[str, dict[str, Any]] = {}
        self.fmus: dict[str, Fmu] = {}
        self.fmu_files: dict[str, Path] = {}
        self.model_exchange: dict[str, ModelExchange] = {}
        self.identified: dict[str, Any] = {}  # IdentifiedPlant stands above this file
        self._kept: dict[tuple[str, str], tuple[Any, frozenset[str]]] = {}

    def begin(self, name: str) -> None:
        """Record what is read from now on for a component."""
        self.current = name
        self.reads[name] = frozenset()

    def read(self, *tables: str) -> None:
        """Record that tables are read."""
        self.reads[self.current] |= set(tables)

    def made_once(self, what: str, name: str, make: Callable[[], T]) -> T:
        """Make something of a component or table, once in a build, and return it.

        The tables that are read for it count as read by every component that asks for it.
        """
        if (what, name) not in self._kept:
            current = self.current
            before = self.reads[current]
            self.reads[current] = frozenset()
            try:
                made = make()
                self._kept[what, name] = made, self.reads[current]
            finally:
                self.reads[current] |= before
        kept, reads = self._kept[what, name]
        self.read(*reads)
        answer: T = kept
        return answer

    def add_metadata(self, name: str, metadata: Mapping[str, Any]) -> None:
        """Record metadata of a component."""
        self.metadata.setdefault(name, {}).update(metadata)

    def warn(self, name: str, text: str) -> None:
        """Record a warning about a component; the log, which is sent to others, has it too."""
        text = text.replace(f"{self._folder}{os.sep}", "")
        self.warnings.append((name, text))

    def file(self, name: str) -> Path:
        """Return the path of a file, and record that it is read.

        Raises
        ------
        UsageError
            In a replay, if the log alone names it: a log from elsewhere must not choose the files
            that are opened here, the libraries in an FMU least of all. Or if no file can have it.
        """
        if self.origins.recording is not None and name not in self.origins.named:
            raise UsageError(
                f"{quoted(name)}: a replay opens no files that only the log names; name it "
                f"yourself by {option('set')}, or run the scenario"
            )
        check_path(name)
        path = self._folder / expanded(name)
        if ".." in path.parts:  # of a swap beside the folder
            path = path.parent.resolve() / path.name
        if not name.isprintable() and not path.exists():
            raise UsageError(
                f"there is no file {quoted(name)}; in double quotes a backslash begins an escape: "
                "write a path in single quotes"
            )
        self.files.add(path.resolve())
        return path
