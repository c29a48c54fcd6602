"""The log of a run as one file or, where it is rotated, as several.

A next file begins before the first rows that belong there. So each has rows, and a run that ends
within the limit leaves an ordinary log. Its name is taken when the file before is closed: whenever
the run is killed, all files but the last are closed, and that one is whole.
"""

from __future__ import annotations

import errno
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, final

from cosim.core.recorders import EndOfRun
from cosim.errors import LogError
from cosim.log.mcap_file.head import FileHead
from cosim.log.mcap_file.live_file import LiveFile
from cosim.log.mcap_file.rotation import Rotation, part_path
from cosim.log.mcap_file.unfinished import UnfinishedLog
from cosim.log.writing.buffer import RunContent
from cosim.log.writing.replaced_parts import replaced_parts
from cosim.log.writing.store import LogStore

_PIECES: Final = 8  # of a file, before compression: it becomes no larger by more than one


@final
class RotatingLog:
    """Writes the contents of a run to the files of its log.

    Parameters
    ----------
    file : UnfinishedLog
        The first one.
    force : bool
        Remove the further files of a log that it replaces.
    head : FileHead
        What every file begins with.
    store : LogStore
    rotation : Rotation or None
        None: there is one file.
    sync : bool
        Wait for the disk at every flush.

    Raises
    ------
    OSError
        From every method that writes; what was written before stays whole.
    """

    def __init__(
        self,
        file: UnfinishedLog,
        head: FileHead,
        store: LogStore,
        *,
        force: bool,
        rotation: Rotation | None,
        sync: bool,
    ) -> None:
        self._first = file
        self._file = file
        self._published = file
        self._force = force
        self._head = head
        self._store = store
        self._rotation = rotation
        self._sync = sync
        self._count = 1
        self._next_ns: int | None = None  # at which rows belong to a next file

    @property
    def path(self) -> Path:
        """Where the file is that is written."""
        return self._file.path

    @property
    def last(self) -> UnfinishedLog:
        """The last file that is at its path, or will be."""
        return self._published

    def begin(self, start_ns: int) -> None:
        """Take the time of the first row, and publish the first file."""
        self._store.begin(start_ns)
        if self._rotation is not None and self._rotation.span_ns is not None:
            self._next_ns = start_ns + self._rotation.span_ns
        self.publish()

    def publish(self) -> None:
        """Rename the first file to its path, the first time this is called.

        Raises
        ------
        LogError
            If that cannot be done, or a file that would be replaced or removed is written, or is
            no part of a log.
        """
        if self._first.published:
            return
        replaced = replaced_parts(self._first.path) if self._force else []
        self._first.publish()
        for path in replaced:
            with suppress(OSError):  # the next file of this log cannot get its name then
                path.unlink()

    def add(self, content: RunContent) -> None:
        """Write a flush; its memory may be used again afterwards."""
        for part in self._by_file(content):
            self._file.check()
            self._store.add(part)

    def finish(self, last: RunContent | None, end: EndOfRun, values: Mapping[str, Any]) -> None:
        """Write the last flush, the result and the end of the file."""
        if self._rotation is not None and last is not None and not last.is_empty:
            self.add(last)
            last = None
        self._store.finish(last, end, values)

    def discard(self) -> None:
        """Remove the file that is written if it was not published."""
        self._file.discard()

    def _by_file(self, content: RunContent) -> Iterator[RunContent]:
        """Yield a content as it belongs to files; begin a next one before what belongs there."""
        while self._next_ns is not None and self._reaches(content, self._next_ns):
            early, content = content.split(self._next_ns)
            if not early.is_empty:
                yield early
            if self._store.has_rows:
                self._go_on()
            assert self._rotation is not None
            assert self._rotation.span_ns is not None
            self._next_ns += self._rotation.span_ns
        for piece in self._pieces(content):
            if self._is_large and len(piece.rows.steps):
                self._go_on()
            yield piece

    def _pieces(self, content: RunContent) -> Iterator[RunContent]:
        """Yield a content in pieces that are small beside the size of a file."""
        if self._rotation is not None and self._rotation.size is not None:
            most = self._rotation.size / _PIECES
            rows = max(int(most / max(self._store.row_bytes, 1.0)), 1)
            while len(content.rows.steps) > rows:
                piece, content = content.split(int(content.rows.time_ns[rows]))
                yield piece
        yield content

    @staticmethod
    def _reaches(content: RunContent, time_ns: int) -> bool:
        times = content.rows.time_ns
        return len(times) > 0 and int(times[-1]) >= time_ns

    @property
    def _is_large(self) -> bool:
        """Whether the file has rows, and is as large as it may be."""
        if self._rotation is None or self._rotation.size is None:
            return False
        return self._store.has_rows and self._store.size >= self._rotation.size

    def _go_on(self) -> None:
        """Close the file and begin the next one, under its path at once."""
        self._file.check()
        path = part_path(self._first.path, self._count + 1)
        following = UnfinishedLog(path, force=False)
        try:
            stream = following.create()
            file = LiveFile(stream, self._head.data, self._head.summary(), sync=self._sync)
            self._store.go_on_in(file)
        except (LogError, OSError) as error:
            following.discard()
            raise _as_os_error(error) from error
        self._file = following
        self._count += 1
        try:
            following.publish()
        except LogError as error:
            raise _as_os_error(error) from error
        self._published = following


def _as_os_error(error: LogError | OSError) -> OSError:
    """Return what the run is told of, as of any write that fails."""
    return error if isinstance(error, OSError) else OSError(errno.EIO, str(error))
