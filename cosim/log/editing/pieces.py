"""Everything that a log consists of except rows and messages, to be written to another log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
from mcap import records

from cosim.errors import GraphError, LogError
from cosim.instants import Grid
from cosim.log.contents.layout import Part, read_part, record_dtype
from cosim.log.contents.metadata import verify_checksum
from cosim.log.contents.result import PARTIAL, PARTIAL_STATUS, RESULT, RESULT_FILE
from cosim.log.contents.run_start import recorded_start_ns
from cosim.log.mcap_file.paths import open_file
from cosim.log.reading.container import MALFORMED

OF_THE_END: Final = (RESULT, PARTIAL)  # metadata that a part has of its own


@dataclass(frozen=True)
class LogPieces:
    """Everything but rows and messages, as it stands in a file.

    Parameters
    ----------
    schemas : sequence of Schema
    channels : sequence of Channel
    metadata : mapping of name to items
        With their checksums.
    attachments : sequence of Attachment
    """

    schemas: Sequence[records.Schema]
    channels: Sequence[records.Channel]
    metadata: Mapping[str, Mapping[str, str]]
    attachments: Sequence[records.Attachment]

    @cached_property
    def parts(self) -> dict[int, Part]:
        """The parts of components by channel id."""
        parts = {}
        for channel in self.channels:
            if "cosim.component" in channel.metadata:
                parts[channel.id] = read_part(channel.metadata)
        return parts

    @cached_property
    def dtypes(self) -> dict[int, np.dtype[np.void]]:
        """The dtypes of message records of components by channel id."""
        return {number: record_dtype(part.size) for number, part in self.parts.items()}

    @property
    def run_result(self) -> dict[str, str]:
        """How the whole run ended, with its content hash; empty: that is not known."""
        for name in (PARTIAL, RESULT):
            if name in self.metadata:
                result = verify_checksum(name, self.metadata[name])
                return {} if result.get("status") == PARTIAL_STATUS else result
        return {}

    @property
    def start_ns(self) -> int:
        """Where the rows of the run begin [ns]; 0 if that is not recorded."""
        return recorded_start_ns(self.metadata) or 0

    @property
    def grid(self) -> Grid:
        """The communication points of the run."""
        return Grid(self.start_ns, next(iter(self.parts.values())).step_ns)

    def row_after(self, time_ns: int, part: Part) -> int:
        """Return where a component has its next row [ns]."""
        return self.grid.stamp(self.grid.number(time_ns) + part.channel.period)

    def steps_to(self, time_ns: int) -> int:
        """Return the number of the communication step that ends at a time [ns]."""
        return max(self.grid.number(time_ns), 0)

    def point_before(self, time_ns: int) -> int:
        """Return the last communication point at or before a time [ns]."""
        return self.grid.stamp(self.grid.number(time_ns))

    @property
    def kept_metadata(self) -> dict[str, Mapping[str, str]]:
        """The metadata that every part of the run has."""
        names = [name for name in self.metadata if name not in OF_THE_END]
        return {name: self.metadata[name] for name in names}

    @property
    def kept_attachments(self) -> list[records.Attachment]:
        """The attachments that every part of the run has."""
        return [item for item in self.attachments if item.name != RESULT_FILE]

    @property
    def result_file(self) -> bytes | None:
        """What was recorded of the end of the run; None: nothing."""
        contents = [item.data for item in self.attachments if item.name == RESULT_FILE]
        return contents[-1] if contents else None


def read_pieces(path: Path) -> LogPieces:
    """Read the pieces of a log that can be opened.

    Raises
    ------
    LogError
        If it is damaged, or has no summary.
    """
    from mcap.reader import make_reader  # loads every compressor

    try:
        with open_file(path) as stream:
            reader = make_reader(stream, validate_crcs=True)
            summary = reader.get_summary()
            if summary is None:
                raise LogError(f"{path} has no summary; 'cosim recover' writes a log that has one")
            metadata = {item.name: item.metadata for item in reader.iter_metadata()}
            attachments = list(reader.iter_attachments())
            pieces = LogPieces(
                list(summary.schemas.values()),
                list(summary.channels.values()),
                metadata,
                attachments,
            )
            assert pieces.parts
    except (*MALFORMED, GraphError) as error:
        raise LogError(f"{path} is damaged: {error}") from error
    return pieces
