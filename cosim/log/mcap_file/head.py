"""What precedes the first row of a log, gathered in memory: it is written at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

from isal import isal_zlib
from mcap import records

from cosim.log.mcap_file.records import MAGIC, encoded
from cosim.log.mcap_file.summary import FileSummary, IndexEntry, RecordGroup


@final
class FileHead:
    """The records up to the first row.

    Parameters
    ----------
    library : str
        Name of the program that writes the file.
    """

    def __init__(self, *, library: str) -> None:
        self._parts = [MAGIC, encoded(records.Header(profile="", library=library))]
        self._size = sum(map(len, self._parts))
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        self._entries: list[IndexEntry] = []

    @property
    def data(self) -> bytes:
        """The bytes."""
        return b"".join(self._parts)

    def summary(self) -> FileSummary:
        """Return the summary of what is here."""
        summary = FileSummary(self._schemas, self._channels)
        summary.add(self._entries)
        return summary

    def channel(self, topic: str, *, schema: tuple[str, bytes], metadata: dict[str, str]) -> int:
        """Add a channel with its own protobuf schema; return the channel's id.

        Parameters
        ----------
        topic : str
        schema : (str, bytes)
            Name of the message and serialized FileDescriptorSet.
        metadata : dict
        """
        number = len(self._channels) + 1
        name, descriptors = schema
        schema_record = records.Schema(id=number, data=descriptors, encoding="protobuf", name=name)
        channel_record = records.Channel(number, topic, "protobuf", metadata, number)
        self.copy([schema_record], [channel_record])
        return number

    def copy(self, schemas: Sequence[records.Schema], channels: Sequence[records.Channel]) -> None:
        """Add schemas and channels with the ids that they have."""
        self._schemas += schemas
        self._channels += channels
        self._append(encoded(*schemas, *channels))

    def metadata(self, name: str, items: dict[str, str]) -> None:
        """Add a metadata record."""
        self._add(metadata_group(name, items))

    def attachment(self, name: str, media_type: str, content: bytes) -> None:
        """Add an attachment, at time 0."""
        self._add(attachment_group(name, media_type, content))

    def _add(self, group: RecordGroup) -> None:
        self._entries += group.placed(self._size)
        self._append(b"".join(group.parts))

    def _append(self, data: bytes) -> None:
        self._parts.append(data)
        self._size += len(data)


def metadata_group(name: str, items: dict[str, str]) -> RecordGroup:
    """Return a metadata record."""
    data = encoded(records.Metadata(name=name, metadata=items))
    index = records.MetadataIndex(offset=0, length=len(data), name=name)
    return RecordGroup([data], [IndexEntry(index, {})], isal_zlib.crc32(data))


def attachment_group(name: str, media_type: str, content: bytes) -> RecordGroup:
    """Return an attachment, at time 0."""
    attachment = records.Attachment(
        create_time=0, log_time=0, name=name, media_type=media_type, data=content
    )
    data = encoded(attachment)
    index = records.AttachmentIndex(
        offset=0,
        length=len(data),
        log_time=0,
        create_time=0,
        data_size=len(content),
        name=name,
        media_type=media_type,
    )
    return RecordGroup([data], [IndexEntry(index, {})], isal_zlib.crc32(data))
