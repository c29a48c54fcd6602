"""An MCAP file that is whole at any instant: also when its writer is killed within a write.

While it is written a file is::

    magic, header, schemas, ... | chunk, indexes | ... | HOLE | DataEnd | SLOT | SLOT | footer magic
                                                     end        room for the summary, twice

HOLE, SLOT and PAD are private records, which readers skip. The file is sparse: a hole takes no
space on the disk. A slot holds ``DataEnd, summary, PAD``, and its PAD reaches to the footer: what
reads from the place that the footer names finds a summary and then the footer; what reads from the
front finds the hole, the end of the data and two records to skip.

The death of a process tears a long write, but not one within a page. So everything new is written
where no reader looks, into the hole and into the slot that the footer does not name, and then two
writes within a page each switch to it: 9 bytes at the end of the data (the header of the hole
becomes that of the first new record), and the footer. Between the two, one way of reading sees the
new rows already and the other not yet; both see a whole file.

Rows that are too few for a chunk of their own make the *tail*: a chunk that is written again with
every flush, longer each time, until it is large enough to stay. It changes sides, so that the old
one stands until the new one is switched to: at the end of the data, or further into the hole, where
a PAD leads to it.

The length of the file cannot be switched together with what leads to its end: between the write
that lengthens it and the next one, and before the truncation of a file that is closed, bytes follow
the footer that a reader from the front finds, and those that insist on its being the last refuse
the file. Those that go by the indexes do not.

The summary of a file that is still written has no CRC in the footer, where it would cover both
slots; its own stands in the PAD after it.
"""

from __future__ import annotations

import errno
import io
import os
import struct
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, final

from isal import isal_zlib

from cosim.log.mcap_records import (
    DATA_END_SIZE,
    END_SIZE,
    HEADER,
    HOLE,
    MAGIC,
    PAD,
    SLOT,
    EncodedSummary,
    FileSummary,
    IndexEntry,
    RecordGroup,
    data_end,
    footer,
    record_header,
)

PAGE: Final = 4096  # bytes; a write within one is not torn
LARGEST_HOLE: Final = 2**24  # bytes: readers load records that they do not know whole
_SMALLEST_HOLE: Final = 2**16
_SMALLEST_SLOT: Final = 2**12
_RESERVE: Final = 2**14  # bytes of the hole that are kept for the end of the file
_CRC_SIZE: Final = 4
SEAL: Final = struct.Struct("<QQI")  # of a summary: its start, its length, its CRC


@dataclass(frozen=True, slots=True)
class _Frame:
    """What stands after the hole."""

    data_end: int  # position of the record DataEnd
    slot_size: int
    footer: int  # position

    def slot(self, number: int) -> int:
        """Return the position of slot 0 or 1."""
        return self.data_end + DATA_END_SIZE + number * self.slot_size

    @property
    def capacity(self) -> int:
        """The longest summary that a slot has room for."""
        return self.slot_size - HEADER - DATA_END_SIZE - HEADER - SEAL.size


def _frame(position: int, summary: int) -> _Frame:
    """Return the frame whose DataEnd is at ``position`` or after, for summaries twice as long."""
    overhead = HEADER + DATA_END_SIZE + HEADER + SEAL.size
    slot_size = max(2 * summary + overhead, _SMALLEST_SLOT)
    content = DATA_END_SIZE + 2 * slot_size
    footer_start = _next_page(position + content)  # so that the footer is within one
    return _Frame(footer_start - content, slot_size, footer_start)


def _next_page(position: int) -> int:
    return -(-position // PAGE) * PAGE


def _padding(position: int) -> bytes:
    """Return what stands between ``position`` and the next header that is within a page."""
    if position % PAGE <= PAGE - HEADER:
        return b""
    return record_header(PAD, 0)


def _differences(known: bytes, content: bytes) -> Iterator[slice]:
    """Yield the pages of a content that differ from what is known, adjacent ones together."""
    start = 0
    for position in range(0, len(content), PAGE):
        page = slice(position, position + PAGE)
        if known[page] == content[page]:
            if start < position:
                yield slice(start, position)
            start = position + PAGE
    if start < len(content):
        yield slice(start, len(content))


@dataclass(frozen=True, slots=True)
class _Tail:
    """The chunk that is written again with every flush."""

    start: int
    group: RecordGroup
    hole: int  # position of the header after it


@final
class LiveFile:
    """A file that rows are added to, and that every MCAP reader can open at any instant.

    Parameters
    ----------
    stream : io.RawIOBase
        Writable, seekable, unbuffered, empty.
    head : bytes
        Everything before the first row: magic, header, schemas, channels, metadata, attachments.
    summary : FileSummary
        Of the head.
    sync : bool
        Wait for the disk before and after each switch: then also a loss of power leaves what was
        flushed.

    Raises
    ------
    OSError
        From every method: if the file cannot be written to. What was written stays whole, and
        :meth:`close` may be tried.
    """

    def __init__(
        self, stream: io.RawIOBase, head: bytes, summary: FileSummary, *, sync: bool = False
    ) -> None:
        self._stream = stream
        self._summary = summary
        self._sync = sync
        self._tail: _Tail | None = None
        self._is_switching = False
        self._slots: dict[int, bytes] = {}  # what has been written to them, by position
        head += _padding(len(head))
        self._crc = isal_zlib.crc32(head)
        self._end = len(head)
        self._active = 0
        self._frame = _frame(self._end + _SMALLEST_HOLE, len(summary.encoded(0).data))
        # Nobody knows the file yet: any order will do.
        self._write(0, head)
        self._write_hole(self._end, self._frame)
        place = self._write_frame(self._frame)
        self._write(self._frame.footer, footer(*place) + MAGIC)

    @property
    def size(self) -> int:
        """What the file holds, without its hole and the room for the summary [bytes]."""
        return self._end if self._tail is None else self._end + self._tail.group.size

    def commit(self, group: RecordGroup) -> None:
        """Add records for good, in place of the tail if there is one."""
        self.replace_tail(group)
        self.keep_tail()

    def replace_tail(self, group: RecordGroup) -> None:
        """Put records in place of the tail, or begin one; their memory stays in use for it."""
        tail = self._tail
        if tail is None or self._fits_before(tail, group):
            self._put(self._end, group)
            return
        behind_tail = tail.hole + HEADER
        # Twice as far into the hole as it is long: before that there is room for it, to be kept.
        with_room = self._end + 2 * (group.size + 2 * HEADER)
        self._put(max(behind_tail, with_room), group)

    def keep_tail(self) -> None:
        """Make the tail part of the data, if there is one."""
        tail = self._tail
        if tail is None:
            return
        group = tail.group
        if tail.start != self._end:
            self._put(self._end, group)
        padding = _padding(self._end + group.size)
        self._summary = self._summary.with_entries(group.placed(self._end))
        crc = isal_zlib.crc32_combine(self._crc, group.crc, group.size)
        self._crc = isal_zlib.crc32(padding, crc)
        self._end += group.size + len(padding)
        self._tail = None

    def close(self) -> None:
        """Write the end of an ordinary, compact file."""
        self._check_switched()
        self.keep_tail()
        start = self._end + DATA_END_SIZE
        encoded = self._summary.encoded(start)
        size = DATA_END_SIZE + len(encoded.data) + END_SIZE
        if self._end + size > self._frame.data_end:
            self._grow(self._end + size, len(encoded.data))
        # The CRC covers the summary, and the footer up to the CRC itself.
        footer_head = footer(start, encoded.offset_start)[:-_CRC_SIZE]
        crc = isal_zlib.crc32(footer_head, isal_zlib.crc32(encoded.data))
        end = data_end(self._crc)
        rest = end[HEADER:] + encoded.data + footer(start, encoded.offset_start, crc) + MAGIC
        self._write(self._end + HEADER, rest)
        self._synchronize()
        self._write(self._end, end[:HEADER])
        self._stream.truncate(self._end + size)
        self._synchronize()
        self._stream.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._stream.close()

    def _fits_before(self, tail: _Tail, group: RecordGroup) -> bool:
        return self._end + group.size + 2 * HEADER <= tail.start

    def _put(self, position: int, group: RecordGroup) -> None:
        """Write records into the hole and switch to them; they are the tail then."""
        self._check_switched()
        padding = _padding(position + group.size)
        hole = position + group.size + len(padding)
        entries = group.placed(position)
        encoded = self._encoded(entries)
        has_room = hole + HEADER + _RESERVE <= self._frame.data_end
        if not has_room or len(encoded.data) > self._frame.capacity:
            self._grow(hole + HEADER, len(encoded.data))
            encoded = self._encoded(entries)
        # First all that may need space on the disk, where no reader looks.
        is_at_end = position == self._end
        hidden = HEADER if is_at_end else 0
        first_part, *others = group.parts
        self._write(position + hidden, memoryview(first_part)[hidden:], *others)
        if padding:
            self._write(hole - len(padding), padding)
        self._write_hole(hole, self._frame)
        other = 1 - self._active
        place = self._write_slot(self._frame, other, encoded, footer_start=self._frame.footer)
        self._synchronize()
        # Then the switches. Where the footer leads, a whole record has to stand before and after.
        self._is_switching = True
        if is_at_end:
            self._write(self._end, first_part[:HEADER])
            self._write(self._frame.footer, footer(*place))
        else:
            self._write(self._frame.footer, footer(*place))
            self._write(self._end, record_header(PAD, position - self._end - HEADER))
        self._synchronize()
        self._is_switching = False
        self._active = other
        self._tail = _Tail(position, group, hole)

    def _encoded(self, entries: Sequence[IndexEntry]) -> EncodedSummary:
        """Encode the summary for the slot that the footer does not name."""
        slot = self._frame.slot(1 - self._active)
        return self._summary.with_entries(entries).encoded(slot + HEADER + DATA_END_SIZE)

    def _grow(self, needed: int, summary: int) -> None:
        """Lengthen the file, so that the hole reaches beyond byte ``needed``.

        Where the file may not become that long, only as far as needed.
        """
        footer_before = self._frame.footer
        # What readers see now stands up to here, and must not be written over.
        old_end = footer_before + END_SIZE
        room = LARGEST_HOLE - (needed - self._end)
        generous = min(max(needed, _SMALLEST_HOLE), max(room, _RESERVE))
        try:
            self._extend(_frame(max(needed + generous, old_end), summary))
        except OSError:
            if self._frame.footer != footer_before:
                raise
            self._extend(_frame(max(needed + _RESERVE, old_end), summary))

    def _extend(self, frame: _Frame) -> None:
        _check_limit(frame.footer + END_SIZE)
        old = self._frame
        published = () if self._tail is None else self._tail.group.placed(self._tail.start)
        other = 1 - self._active
        encoded = self._encoded(published)
        place = self._write_slot(old, other, encoded, footer_start=frame.footer)
        self._synchronize()
        # This makes the file longer, and is a whole end of it at once.
        self._write(frame.footer, footer(*place) + MAGIC)
        self._frame = replace(old, footer=frame.footer)
        self._active = other
        # At once: who reads from the front would stop at the old end, and goes on to the new one;
        # and a file that is cut there does not look like a whole one, as it was before.
        skip = record_header(PAD, frame.footer - old.footer - HEADER)
        self._write(old.footer, skip + bytes(END_SIZE - HEADER))
        place = self._write_frame(frame)
        self._synchronize()
        self._write(frame.footer, footer(*place))
        self._write_hole(self._end if self._tail is None else self._tail.hole, frame)
        self._frame = frame
        self._active = 0
        self._slots.pop(old.slot(0) + HEADER, None)
        self._slots.pop(old.slot(1) + HEADER, None)

    def _write_frame(self, frame: _Frame) -> tuple[int, int]:
        """Write what stands after the hole but for the footer; return the places for that."""
        tail = self._tail
        published = () if tail is None else tail.group.placed(tail.start)
        self._write(frame.data_end, data_end())
        for number in (0, 1):
            self._write(frame.slot(number), record_header(SLOT, frame.slot_size - HEADER))
        start = frame.slot(0) + HEADER + DATA_END_SIZE
        encoded = self._summary.with_entries(published).encoded(start)
        return self._write_slot(frame, 0, encoded, footer_start=frame.footer)

    def _write_slot(
        self, frame: _Frame, number: int, encoded: EncodedSummary, *, footer_start: int
    ) -> tuple[int, int]:
        """Write a summary into a slot; return where it and its offsets begin."""
        position = frame.slot(number) + HEADER
        start = position + DATA_END_SIZE
        pad_start = start + len(encoded.data)
        pad = record_header(PAD, footer_start - pad_start - HEADER)
        seal = SEAL.pack(start, len(encoded.data), isal_zlib.crc32(encoded.data))
        content = data_end() + encoded.data + pad + seal
        # Only what has changed is written. After a write that failed, what stands there is unknown.
        known = self._slots.pop(position, b"")
        for piece in _differences(known, content):
            self._write(position + piece.start, memoryview(content)[piece])
        self._slots[position] = content
        return start, encoded.offset_start

    def _write_hole(self, position: int, frame: _Frame) -> None:
        self._write(position, record_header(HOLE, frame.data_end - position - HEADER))

    def _check_switched(self) -> None:
        """Check that no switch has failed: one way of reading is at what would be written next.

        Raises
        ------
        OSError
            If one has. That takes a defect of the disk: a switch needs no space.
        """
        if self._is_switching:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    def _write(self, position: int, *parts: bytes | memoryview) -> None:
        """Write parts one after the other."""
        self._stream.seek(position)
        for part in parts:
            remaining = memoryview(part)
            while remaining:
                written = self._stream.write(remaining)
                if not written:
                    raise OSError(errno.ENOSPC, "the file takes no more bytes")
                remaining = remaining[written:]

    def _synchronize(self) -> None:
        if self._sync:
            _fdatasync(self._stream.fileno())


def _check_limit(size: int) -> None:
    """Check that the process may write files of this size: a limit would cut a write short.

    Raises
    ------
    OSError
        If it may not.
    """
    if sys.platform == "win32":
        return
    import resource

    limit, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
    if limit != resource.RLIM_INFINITY and size > limit:
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))


_fdatasync = getattr(os, "fdatasync", os.fsync)  # Windows and macOS have none
