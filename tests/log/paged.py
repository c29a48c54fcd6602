"""A file in memory that is looked at after every write within a page, and what is written to it."""

from __future__ import annotations

import errno
import io
import os
import zlib
from dataclasses import dataclass, field

from mcap import records
from mcap.reader import NonSeekingReader, make_reader

from cosim.log.live_file import PAGE, LiveFile
from cosim.log.mcap_records import MAGIC, FileSummary, IndexEntry, RecordGroup, encoded


class PagedStream(io.RawIOBase):
    """A file that takes at most the rest of a page at once, as a process that is killed leaves it.

    Parameters
    ----------
    look : callable
        Called with the content after every write.
    """

    def __init__(self, look=lambda content: None):
        super().__init__()
        self.content = bytearray()
        self.writes = 0
        self.failing = range(0)  # numbers of the writes that fail
        self.longest = None  # bytes that the file may have
        self._look = look
        self._position = 0

    def writable(self):
        return True

    def seekable(self):
        return True

    def seek(self, offset, whence=io.SEEK_SET):
        assert whence == io.SEEK_SET
        self._position = offset
        return offset

    def write(self, data):
        piece = bytes(memoryview(data)[: PAGE - self._position % PAGE])
        stop = self._position + len(piece)
        self._begin(stop)
        gap = self._position - len(self.content)
        self.content += bytes(max(gap, 0))
        self.content[self._position : stop] = piece
        self._position = stop
        self._look(bytes(self.content))
        return len(piece)

    def truncate(self, size=None):
        self._begin(0)
        del self.content[size:]
        self._look(bytes(self.content))
        return size

    def fileno(self):
        return -1  # no file of the system

    def _begin(self, stop):
        number = self.writes
        self.writes += 1
        if number in self.failing or (self.longest is not None and stop > self.longest):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def chunk(first, count, size):
    """Return messages of ``size`` bytes with the numbers from ``first`` on, as a chunk."""
    messages = []
    for number in range(first, first + count):
        message = records.Message(1, 5 * number, _data(number, size), 5 * number, number)
        messages.append(encoded(message))
    content = b"".join(messages)
    first_ns = 5 * first
    last_ns = 5 * (first + count - 1)
    record = records.Chunk("", content, last_ns, first_ns, zlib.crc32(content), len(content))
    data = encoded(record)
    index = records.ChunkIndex(
        chunk_length=len(data),
        chunk_start_offset=0,
        compression="",
        compressed_size=len(content),
        message_end_time=last_ns,
        message_index_length=0,
        message_index_offsets={1: len(data)},
        message_start_time=first_ns,
        uncompressed_size=len(content),
    )
    length = len(messages[0])
    entries = [(5 * (first + row), row * length) for row in range(count)]
    message_index = encoded(records.MessageIndex(1, entries))
    index.message_index_length = len(message_index)
    crc = zlib.crc32(data + message_index)
    return RecordGroup([data, message_index], [IndexEntry(index, {1: count})], crc)


def _data(number, size):
    return bytes([number % 251]) * size


def count_rows(content):
    """Return the numbers of messages that mcap's two readers find, and that the summary counts.

    All messages are there up to the last one, bit for bit.
    """
    counts = []
    for make in (make_reader, NonSeekingReader):
        reader = make(io.BytesIO(content), validate_crcs=True)
        rows = [(message.sequence, message.data) for _, _, message in reader.iter_messages()]
        assert all(data == _data(number, len(data)) for number, data in rows)
        assert [number for number, _ in rows] == list(range(len(rows)))
        counts.append(len(rows))
    counts.append(make_reader(io.BytesIO(content)).get_summary().statistics.message_count)
    return counts


@dataclass
class Recording:
    """A file of one topic that is written by random calls, and what has to be in it.

    Attributes
    ----------
    kept, tail : int
        Rows of the file, and of its tail.
    allowed : tuple of int
        Numbers of rows that a reader may find, in a call and after it.
    """

    random: object
    largest: int = 2000  # bytes of a message
    summary_bytes: int = 0  # of a schema that the summary repeats
    sync: bool = False  # wait for the disk
    kept: int = 0
    tail: int = 0
    allowed: tuple = ()
    looks: int = 0
    stream: PagedStream = field(init=False)

    def __post_init__(self):
        self.stream = PagedStream(self.look)
        data = bytes(self.summary_bytes)
        schemas = [records.Schema(data=data, encoding="protobuf", id=1, name="s1")]
        channels = [records.Channel(1, "/s1", "protobuf", {}, 1)]
        head = MAGIC + encoded(records.Header("", "x"), *schemas, *channels)
        self.file = LiveFile(self.stream, head, FileSummary.of(schemas, channels), sync=self.sync)
        self.allowed = (0,)

    def look(self, content):
        """Check what all readers see, from when the file is whole for the first time."""
        if self.allowed:
            self.looks += 1
            counts = count_rows(content)
            assert set(counts) <= set(self.allowed), (counts, self.allowed)

    def call(self):
        """Add some rows, to the tail or for good, or keep the tail."""
        method = self.random.choice(["commit", "replace_tail", "replace_tail", "keep_tail"])
        if method != "keep_tail":
            if method == "replace_tail" and self.tail > 500:
                self.keep_tail()
            count = self.random.randint(1, 30)
            self.replace_tail(count, self.random.choice([10, 100, self.largest]))
        if method != "replace_tail":
            self.keep_tail()

    def keep_tail(self):
        """Make the tail part of the data."""
        self.file.keep_tail()
        self.kept += self.tail
        self.tail = 0

    def close(self):
        """Close the file."""
        self.file.close()
        self.allowed = (self.kept + self.tail,)

    def replace_tail(self, count, size):
        """Add rows to the tail."""
        after = self.kept + self.tail + count
        self.allowed = (*self.allowed, after)
        self.file.replace_tail(chunk(self.kept, self.tail + count, size))
        self.tail += count
        self.allowed = (after,)
