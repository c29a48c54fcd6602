"""The components of a log, as the metadata of its channels declare them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from mcap import records

from cosim.core.signals import Channel
from cosim.errors import GraphError, LogError, option
from cosim.log.contents.layout import Part, read_part
from cosim.log.mcap_file.places import MALFORMED


def read_parts(path: Path, channels: Mapping[int, records.Channel]) -> dict[int, Part]:
    """Read the parts of the components from their channels' metadata, by channel id.

    Raises
    ------
    LogError
        If one cannot be parsed, or there are none.
    """
    parts = {}
    for number, channel in channels.items():
        if "cosim.component" not in channel.metadata:
            continue
        try:
            parts[number] = read_part(channel.metadata)
        except (*MALFORMED, GraphError) as error:
            raise LogError(
                f"{path}: channel {channel.topic!r} cannot be parsed: {error}"
            ) from error
    if not parts:
        topics = [channel.topic for channel in channels.values()]
        joined = ", ".join(topics) or "no channels at all"
        raise LogError(
            f"{path} has no channels of cosim (with 'cosim.component'); available: {joined}. For "
            "recordings of other tools, 'cosim info' lists the fields and "
            f"{option('swap')} reads them"
        )
    return parts


def read_channels(path: Path, parts: Iterable[Part]) -> dict[str, Channel]:
    """Return the components in the order of the row, each checked to be whole.

    Raises
    ------
    LogError
        If parts of one contradict each other, or are not the whole of it.
    """
    # By name too: a component without signals starts where the next one does.
    in_order = sorted(parts, key=lambda part: (part.channel.start, part.channel.name))
    channels = {part.channel.name: part.channel for part in in_order}
    columns: dict[str, list[slice]] = {name: [] for name in channels}
    for part in in_order:
        name = part.channel.name
        if part.channel != channels[name] or part.step_ns != in_order[0].step_ns:
            raise LogError(f"{path}: the channels of {name!r} contradict each other")
        columns[name].append(part.columns)
    for name, channel in channels.items():
        _check_whole(path, channel, columns[name])
    return channels


def _check_whole(path: Path, channel: Channel, columns: list[slice]) -> None:
    """Check that the parts of a component tile its row.

    Raises
    ------
    LogError
        If some columns are missing, or recorded more than once.
    """
    spans = sorted((span.start, span.stop) for span in columns)
    column = 0
    is_contiguous = True
    for start, stop in spans:
        is_contiguous &= start == column
        column = stop
    width = channel.columns.stop - channel.start
    if not is_contiguous or column != width:
        raise LogError(
            f"{path}: component {channel.name!r} is incomplete: expected columns 0 to {width} "
            f"once, got {spans}"
        )
