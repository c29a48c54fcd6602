"""The files that a scenario names, as they are opened for its components."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import final

from cosim.arguments import check_path
from cosim.core.recording import Recording
from cosim.errors import UsageError, option, quoted
from cosim.files import expanded


@final
class NamedFiles:
    """The files that a scenario names.

    Parameters
    ----------
    folder : Path
        Of the scenario.
    recording : Recording or None
        Of a replay.
    allowed : collection of str
        What a replay may open.

    Attributes
    ----------
    paths : set of Path
        Those that are read.
    modules : set of Path
        Those of the classes of users.
    """

    def __init__(self, folder: Path, recording: Recording | None, allowed: Collection[str]) -> None:
        self._folder = folder
        self._recording = recording
        self._allowed = allowed
        self.paths: set[Path] = set()
        self.modules: set[Path] = set()

    def path(self, name: str) -> Path:
        """Return the path of a file, and record that it is read.

        Raises
        ------
        UsageError
            In a replay, if the log alone names it: a log from elsewhere must not choose the files
            that are opened here, the libraries in an FMU least of all. Or if no file can have it.
        """
        if self._recording is not None and name not in self._allowed:
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
        self.paths.add(path.resolve())
        return path
