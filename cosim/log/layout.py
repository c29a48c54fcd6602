"""How a component becomes MCAP channels, and how it is read back from their metadata.

A component's row is one protobuf message of doubles, every one always written. All messages of a
channel therefore have one size, and consecutive ones are a numpy structured array::

    opcode u1 | length u8 | channel id u2 | sequence u4 | log time u8 | publish time u8
    | tag, double | tag, double | ...

Tags are constant: one byte up to field 15, two up to 2047, three from 2048 on. Protobuf for Python
stops at 8190 doubles a message, so a component with more than 4096 elements is split into
``/<component>``, ``/<component>.2``, ...

Of a partial log the record ``cosim.record`` contains the selection and the names of all components;
the metadata of each component contain its declaration with all signals, in the form in which a
channel that holds them all would have it. The checksums of the records cover all of this.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
from mcap import records
from mcap.opcode import Opcode
from numpy.typing import NDArray

from cosim.arguments import READ_BY
from cosim.arrays import Matrix
from cosim.core.recorded.partial import PartialRecord, RecordSelection
from cosim.core.signals import Channel, Interface, Signal, element_names
from cosim.errors import GraphError, LogError, option, quoted
from cosim.instants import StepNs
from cosim.log.mcap_records import HEADER
from cosim.log.metadata import (
    add_checksum,
    compact,
    json_table,
    json_texts,
    read_json,
    verify_checksum,
)
from cosim.log.places import MALFORMED
from cosim.units import BaseUnit

RECORD: Final = "cosim.record"
DECLARED: Final = "cosim.declared"  # in the metadata of a component

_NO_COLUMNS: Final = slice(0, 0)


def partial_metadata(partial: PartialRecord) -> dict[str, str]:
    """Return the record of what is recorded of what."""
    selection = partial.selection
    items = {"every": str(selection.every), "components": compact(list(partial.declared))}
    if selection.signals is not None:
        items["signals"] = compact(list(selection.signals))
    return items


def declaration_json(channel: Channel, kind: str, step_ns: StepNs) -> str:
    """Return the declaration of a component with all of its signals."""
    return compact(dict(Part(channel, kind, step_ns, _NO_COLUMNS).metadata))


def read_partial(
    metadata: Mapping[str, Mapping[str, str]], channels: Mapping[str, Channel]
) -> tuple[PartialRecord, dict[str, str]] | None:
    """Return what a log is a part of, with the kinds of all components; None: it is whole.

    Parameters
    ----------
    metadata : mapping of record name to its items
    channels : mapping of component name to Channel
        Those recorded.

    Raises
    ------
    ValueError, KeyError, TypeError, GraphError
        If the metadata are damaged, or the channels have what they do not declare.
    """
    if RECORD not in metadata:
        return None
    items = metadata[RECORD]
    signals = json_texts(items["signals"]) if "signals" in items else None
    every = read_number(items["every"])
    declared: dict[str, Channel] = {}
    kinds: dict[str, str] = {}
    for name in json_texts(items["components"]):
        table: dict[str, Any] = json_table(metadata[f"cosim.component.{name}"][DECLARED])
        part = read_part(table)
        declared[name] = part.channel
        kinds[name] = part.kind
    for name, channel in channels.items():
        whole = declared[name]
        for signal in channel.signals:
            if whole.by_name.get(signal.name) != signal:
                raise ValueError(f"{name!r} does not declare the recorded signal {signal.name!r}")
        if channel.period % whole.period:
            raise ValueError(
                f"{name!r} has a row every {channel.period} steps, which is not a multiple of the "
                f"{whole.period} steps of its component"
            )
    selection = RecordSelection(None if signals is None else tuple(signals), every)
    return PartialRecord(selection, declared), kinds


MOST_ELEMENTS = 4096
_LARGEST_WHOLE = 2**63 - 1  # of a time in ns, a size
_MOST_DIGITS = 19  # of that
Records: TypeAlias = NDArray[np.void]  # shape (n,), of a dtype by record_dtype

_CHECKSUM_NAME = "cosim.channel"  # metadata of channels have no name of their own
_CACHED_SIZES = 64  # most components have one of few sizes
# fields of a signal that were there from the first log on
_ALWAYS_WRITTEN = ("name", "size", "unit", "variability", "optional", "type", "role")
# the nominal value only scales tolerances, the description is for people
_NOT_HASHED = ("nominal", "description")
_NAMED = ("delayed", "lagging", "left_limits", "jumping")  # of an interface: names of signals
_DOUBLE_WIRE_TYPE = 1  # of protobuf: 64 bits

# Groups of fields by the bytes of their tags, and those of a channel's elements that they have.
_TAG_BYTES = {"short": 1, "middle": 2, "long": 3}
_COLUMNS = {"short": (0, 15), "middle": (15, 2047), "long": (2047, MOST_ELEMENTS)}


@dataclass(frozen=True, slots=True)
class Part:
    """The elements of one component that share an MCAP channel.

    Parameters
    ----------
    channel : Channel
        The component.
    kind : str
        Kind of the component, as the scenario calls it.
    step_ns : int or Fraction
        Communication step [ns].
    columns : slice
        Which columns of the component's row.
    """

    channel: Channel
    kind: str
    step_ns: StepNs
    columns: slice

    @property
    def title(self) -> str:
        """Name of the component, numbered from the second part on."""
        name = self.channel.name
        number = self.columns.start // MOST_ELEMENTS + 1
        return name if number == 1 else f"{name}.{number}"

    @property
    def size(self) -> int:
        """Number of elements."""
        return int(self.columns.stop - self.columns.start)

    @property
    def elements(self) -> list[str]:
        """Names of the elements."""
        return element_names(self.channel.signals)[self.columns]

    @property
    def metadata(self) -> dict[str, str]:
        """What :func:`read_part` needs to build this part again."""
        channel = self.channel
        interface = channel.interface
        items = {"cosim.component": channel.name, "cosim.kind": self.kind}
        items["cosim.step_ns"] = str(self.step_ns)
        items["cosim.period_ns"] = str(self.step_ns * channel.period)  # may be a/b, as the step
        items["cosim.start"] = str(channel.start)
        items["cosim.columns"] = f"{self.columns.start}:{self.columns.stop}"
        items["cosim.signals"] = signals_json(interface)
        further: dict[str, Any] = {"initial": dict(interface.initial)}
        further |= {name: list(getattr(interface, name)) for name in _NAMED}
        further["continuous"] = interface.continuous
        further["descriptions"] = {s.name: s.description for s in channel.signals if s.description}
        for name, value in further.items():
            if value:
                items[f"cosim.{name}"] = compact(value)
        # Last: the checksum covers all items, and what came after it would be unprotected.
        return add_checksum(_CHECKSUM_NAME, items)


def split_channel(channel: Channel, *, kind: str, step_ns: StepNs) -> list[Part]:
    """Split a component into parts of at most 4096 elements.

    A component without signals has one empty part, so that it is in the log all the same.
    """
    width = channel.columns.stop - channel.columns.start
    parts = []
    for start in range(0, max(width, 1), MOST_ELEMENTS):
        stop = min(start + MOST_ELEMENTS, width)
        parts.append(Part(channel, kind, step_ns, slice(start, stop)))
    return parts


def read_part(metadata: Mapping[str, str]) -> Part:
    """Build a part from its channel's metadata.

    Raises
    ------
    ValueError, KeyError, TypeError, GraphError
        If the metadata is damaged or not ours.
    """
    # First: a damaged number may still parse, and would silently be another one.
    items = verify_checksum(_CHECKSUM_NAME, metadata)
    name = items["cosim.component"]
    if not name or "." in name:
        raise ValueError(f"expected a component name without a dot, got {quoted(name)}")
    step_ns = _read_step(items["cosim.step_ns"])
    period_ns = _read_step(items["cosim.period_ns"])
    start, stop = map(read_number, items["cosim.columns"].split(":"))
    is_periodic = step_ns >= 1 and period_ns >= step_ns and not period_ns % step_ns
    if not is_periodic or not 0 <= stop - start <= MOST_ELEMENTS:
        raise ValueError(
            f"period {period_ns} ns, step {step_ns} ns and columns {start}:{stop} are inconsistent"
        )
    declared = _read_interface(
        read_json(items["cosim.signals"]),
        json_table(items.get("cosim.initial", "{}")),
        json_table(items.get("cosim.descriptions", "{}")),
    )
    further: dict[str, Any] = {
        "continuous": bool(read_json(items.get("cosim.continuous", "false")))
    }
    further |= {own: tuple(read_json(items.get(f"cosim.{own}", "[]"))) for own in _NAMED}
    interface = replace(declared, **further)
    start_column = read_number(items["cosim.start"])
    channel = Channel(name, interface, start_column, period_ns // step_ns)
    return Part(channel, items["cosim.kind"], step_ns, slice(start, stop))


def _read_step(text: str) -> StepNs:
    """Read a time between rows [ns], a whole number or two: ``50000000/3``."""
    numerator, *denominator = map(read_number, text.split("/"))
    if not denominator:
        return numerator
    return Fraction(numerator, *denominator)


def read_number(text: str) -> int:
    """Read a whole number from 0 to 2**63 - 1.

    Raises
    ------
    ValueError
        If ``text`` is none.
    """
    if not (text.isascii() and text.isdigit()) or len(text) > _MOST_DIGITS:
        raise ValueError(f"expected a whole number, got {quoted(text)}")
    number = int(text)
    if number > _LARGEST_WHOLE:
        raise ValueError(f"expected a whole number up to {_LARGEST_WHOLE}, got {number}")
    return number


def signals_json(interface: Interface) -> str:
    """Describe all signals as JSON: the text that the content hash covers.

    Inputs come first. ``feedthrough`` lists the inputs an output depends on directly; null:
    unknown. A field that is not ``_ALWAYS_WRITTEN`` is left out where it has its default, so that
    one added later changes no hash of signals that do without it. What outputs depend on at
    initialization, and which inputs are delayed, only orders calls, which outputs lag
    only says what the order of the error is, which have left limits what a jump is, which jump and
    whether others are continuous by construction what FMUs get of them, and a description only what
    people read: that stands apart, in ``cosim.initial``, ``cosim.delayed``, ``cosim.lagging``,
    ``cosim.left_limits``, ``cosim.jumping``, ``cosim.continuous`` and ``cosim.descriptions``, and
    changes no hash; so do nominal values, which are not written at all.
    """
    # The hash covers this text byte by byte: neither the order of the signals nor that of the keys
    # in an entry may change, nor _ALWAYS_WRITTEN.
    entries = [_signal_entry(signal, "input") for signal in interface.inputs]
    entries += [_signal_entry(signal, "output") for signal in interface.outputs]
    for entry in entries:
        if entry["name"] in interface.feedthrough:
            entry["feedthrough"] = interface.feedthrough[entry["name"]]
    return compact(entries)


def _signal_entry(signal: Signal, causality: str) -> dict[str, Any]:
    entry: dict[str, Any] = {"causality": causality}
    values = asdict(signal)
    for field in fields(Signal):
        if field.name in _NOT_HASHED:
            continue
        if field.name in _ALWAYS_WRITTEN or getattr(signal, field.name) != field.default:
            entry[field.name] = values[field.name]
    return entry


def _read_interface(
    entries: Any, initial: Mapping[str, Any], descriptions: Mapping[str, Any]
) -> Interface:
    if not isinstance(entries, list):
        raise ValueError(f"expected a list of signals, got {quoted(entries)}")
    signals: dict[str, list[Signal]] = {"input": [], "output": []}
    feedthrough = {}
    for entry in entries:
        if not isinstance(entry, dict):
            raise ValueError(f"expected a signal, got {quoted(entry)}")
        # First: causality and feedthrough belong to the interface, and are no fields of a signal.
        values = {**entry, "description": descriptions.get(entry["name"], "")}
        own = signals[values.pop("causality")]
        if "feedthrough" in values:
            feedthrough[values["name"]] = _input_names(values.pop("feedthrough"))
        own.append(_read_signal(values))
    at_start = {output: _input_names(names) for output, names in initial.items()}
    inputs = {signal.name for signal in signals["input"]}
    outputs = {signal.name for signal in signals["output"]}
    for output, names in (*feedthrough.items(), *at_start.items()):
        if output not in outputs or not inputs.issuperset(names or ()):
            raise ValueError(
                f"{quoted(output)} is declared to depend on {quoted(names)}, which are not inputs"
            )
    return Interface(tuple(signals["input"]), tuple(signals["output"]), feedthrough, at_start)


def _read_signal(values: dict[str, Any]) -> Signal:
    # JSON has no tuples, and a list would make the signal differ from the one recorded.
    if "start" in values:
        values["start"] = _tuple("start", values["start"])
    if isinstance(values["unit"], list):
        values["unit"] = tuple(values["unit"])
    if isinstance(values.get("base"), list):
        values["base"] = tuple(base and _read_base(base) for base in values["base"])
    elif "base" in values:
        values["base"] = _read_base(values["base"])
    signal = Signal(**values)
    if signal.size > _LARGEST_WHOLE:
        raise ValueError(
            f"signal {quoted(signal.name)}: expected a size up to {_LARGEST_WHOLE}, got "
            f"{signal.size}"
        )
    return signal


def _read_base(values: Mapping[str, Any]) -> BaseUnit:
    return BaseUnit(**{**values, "exponents": _tuple("exponents", values["exponents"])})


def _tuple(name: str, values: Any) -> tuple[Any, ...]:
    if not isinstance(values, list):
        raise ValueError(f"{name}: expected a list, got {quoted(values)}")
    return tuple(values)


def _input_names(names: Any) -> tuple[str, ...] | None:
    if names is None:
        return None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"expected a list of inputs, got {quoted(names)}")
    return tuple(names)


@lru_cache(_CACHED_SIZES)
def record_dtype(size: int) -> np.dtype[np.void]:
    """Return the dtype of a whole message record of ``size`` doubles."""
    # The order of the fields is the order of the bytes in the file; numpy adds no padding.
    fields: list[Any] = [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel_id", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
    for name, columns in group_columns(size).items():
        element = [("tag", "u1", (_TAG_BYTES[name],)), ("value", "<f8")]
        fields.append((name, element, (columns.stop - columns.start,)))
    return np.dtype(fields)


def blank_records(channel_id: int, size: int, count: int) -> Records:
    """Return ``count`` message records with everything constant filled in."""
    dtype = record_dtype(size)
    records = np.zeros(count, dtype)
    records["opcode"] = Opcode.MESSAGE
    records["length"] = dtype.itemsize - HEADER
    records["channel_id"] = channel_id
    for name, tags in field_tags(size).items():
        records[name]["tag"] = tags
    return records


@lru_cache(_CACHED_SIZES)
def field_tags(size: int) -> Mapping[str, NDArray[np.uint8]]:
    """Return the tags of each group of fields, shape (fields, bytes); read-only.

    A tag is ``number << 3 | wire type`` as a varint: seven bits a byte, the lowest first, with the
    highest bit set in every byte but the last.
    """
    tags = {}
    for name, columns in group_columns(size).items():
        numbers = np.arange(columns.start + 1, columns.stop + 1, dtype=np.int64)
        keys = (numbers << 3) | _DOUBLE_WIRE_TYPE
        varint = ((keys[:, None] >> 7 * np.arange(_TAG_BYTES[name])) & 0x7F).astype(np.uint8)
        varint[:, :-1] |= 0x80
        varint.setflags(write=False)
        tags[name] = varint
    return tags


def group_columns(size: int) -> Mapping[str, slice]:
    """Return which elements of a part stand in which group of fields."""
    found = {name: slice(start, min(size, stop)) for name, (start, stop) in _COLUMNS.items()}
    return {name: own for name, own in found.items() if own.start < own.stop}


def fill_values(records: Records, values: Matrix) -> None:
    """Fill the doubles of message records with ``values``, shape (n, size)."""
    for name, columns in group_columns(values.shape[1]).items():
        records[name]["value"] = values[:, columns]


def copy_columns(records: Records, target: Matrix, *, size: int, columns: slice) -> None:
    """Copy some doubles of message records of ``size`` doubles to ``target``, shape (n, columns).

    Raises
    ------
    ValueError
        If the records have other fields than ours.
    """
    tags = field_tags(size)
    for name, in_group in group_columns(size).items():
        # Before the values: the same bytes after other tags are other fields, or another type.
        group = records[name]
        if (group["tag"] != tags[name]).any():
            raise ValueError(
                "the fields of the messages differ from those declared: written or re-encoded by "
                "another tool"
            )
        start = max(columns.start, in_group.start)
        stop = min(columns.stop, in_group.stop)
        if start < stop:
            values = group["value"][:, start - in_group.start : stop - in_group.start]
            target[:, start - columns.start : stop - columns.start] = values


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
        joined = ", ".join(topics) or "none"
        raise LogError(
            f"{path}: expected a log of cosim, got an MCAP file of another tool (channels: "
            f"{joined}); {READ_BY}, and {option('swap')} takes its samples"
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
    columns: dict[str, list[tuple[int, int]]] = {name: [] for name in channels}
    for part in in_order:
        name = part.channel.name
        if part.channel != channels[name] or part.step_ns != in_order[0].step_ns:
            raise LogError(f"{path}: the channels of {name!r} contradict each other")
        columns[name].append((part.columns.start, part.columns.stop))
    for name, channel in channels.items():
        spans = sorted(columns[name])
        width = channel.columns.stop - channel.start
        starts = [0, *(stop for _, stop in spans)]
        if starts != [*(start for start, _ in spans), width]:
            raise LogError(
                f"{path}: component {name!r} is incomplete: expected columns 0 to {width} once, "
                f"got {spans}"
            )
    return channels
