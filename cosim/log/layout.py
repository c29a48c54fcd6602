"""How a component becomes MCAP channels, and how it is found again from their metadata.

A component's row is one protobuf message of doubles, every one always written. All messages of a channel therefore have one
size, and a run of them is a numpy structured array::

    opcode u1 | length u8 | channel id u2 | sequence u4 | log time u8 | publish time u8 | tag, double | tag, double | ...

Tags are constant: one byte up to field 15, two up to 2047, three from 2048 on. Protobuf for Python stops at 8190 doubles a
message, so a component with more than 4096 elements is split into ``/<component>``, ``/<component>.2``, ...
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, TypeAlias

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from cosim.arrays import Matrix
from cosim.core.signals import Channel, Interface, Signal
from cosim.log.metadata import compact, seal, unseal
from cosim.units import BaseUnit

MOST_ELEMENTS = 4096
HEADER = 9  # bytes: opcode u1, length u8
Records: TypeAlias = NDArray[np.void]  # shape (n,), of a dtype by record_dtype

_SEALED_AS = "cosim.channel"
_GROUPS = (
    ("short", 1, 16),
    ("middle", 16, 2048),
    ("long", 2048, MOST_ELEMENTS + 1),
)  # fields whose tags have 1, 2, 3 bytes


@dataclass(frozen=True, slots=True)
class Part:
    """The elements of one component that share an MCAP channel.

    Parameters
    ----------
    channel : Channel
        The component.
    kind : str
        Kind of the component, as the scenario calls it.
    step_ns : int
        Communication step [ns].
    columns : slice
        Which columns of the component's row.
    """

    channel: Channel
    kind: str
    step_ns: int
    columns: slice

    @property
    def title(self) -> str:
        """Name of the component, numbered from the second part on."""
        number = self.columns.start // MOST_ELEMENTS + 1
        return self.channel.name if number == 1 else f"{self.channel.name}.{number}"

    @property
    def size(self) -> int:
        """Number of elements."""
        return int(self.columns.stop - self.columns.start)

    @property
    def elements(self) -> list[str]:
        """Names of the elements."""
        return [name for signal in self.channel.signals for name in signal.elements][self.columns]

    @property
    def metadata(self) -> dict[str, str]:
        """What :func:`read_part` needs to give this part back."""
        items = {
            "cosim.component": self.channel.name,
            "cosim.kind": self.kind,
            "cosim.step_ns": str(self.step_ns),
            "cosim.period_ns": str(self.step_ns * self.channel.period),
            "cosim.start": str(self.channel.start),
            "cosim.columns": f"{self.columns.start}:{self.columns.stop}",
            "cosim.signals": signals_json(self.channel.interface),
        }
        if self.channel.interface.initial:
            items["cosim.initial"] = compact(dict(self.channel.interface.initial))
        return seal(_SEALED_AS, items)


def split(channel: Channel, *, kind: str, step_ns: int) -> list[Part]:
    """Split a component into parts of at most 4096 elements; one without signals has one empty part."""
    width = channel.columns.stop - channel.columns.start
    starts = range(0, max(width, 1), MOST_ELEMENTS)
    return [
        Part(channel, kind, step_ns, slice(start, min(start + MOST_ELEMENTS, width)))
        for start in starts
    ]


def read_part(metadata: Mapping[str, str]) -> Part:
    """Give the part back from a channel's metadata.

    Raises
    ------
    ValueError, KeyError, TypeError, GraphError
        If the metadata is damaged or not ours.
    """
    items = unseal(_SEALED_AS, metadata)
    step_ns, period_ns = int(items["cosim.step_ns"]), int(items["cosim.period_ns"])
    start, stop = (int(text) for text in items["cosim.columns"].split(":"))
    if step_ns < 1 or period_ns % step_ns or not 0 <= stop - start <= MOST_ELEMENTS:
        raise ValueError(
            f"period {period_ns} ns, step {step_ns} ns, columns {start}:{stop} do not fit together"
        )
    interface = _interface(
        json.loads(items["cosim.signals"]), json.loads(items.get("cosim.initial", "{}"))
    )
    channel = Channel(
        items["cosim.component"], interface, int(items["cosim.start"]), period_ns // step_ns
    )
    return Part(channel, items["cosim.kind"], step_ns, slice(start, stop))


def signals_json(interface: Interface) -> str:
    """Describe all signals, inputs first: the text that the content hash covers.

    ``feedthrough`` lists the inputs an output depends on directly; null: unknown. What stands at its default is left out.
    What outputs depend on at the start only orders the start: it stands beside, in ``cosim.initial``, and changes no hash.
    """
    entries = []
    for signal in (*interface.inputs, *interface.outputs):
        entry: dict[str, Any] = {
            "causality": "input" if signal in interface.inputs else "output",
            **asdict(signal),
        }
        for name in ("base", "start"):
            if not entry[name]:
                del entry[name]
        if signal.name in interface.feedthrough:
            entry["feedthrough"] = interface.feedthrough[signal.name]
        entries.append(entry)
    return compact(entries)


def _interface(entries: list[dict[str, Any]], initial: Mapping[str, Any]) -> Interface:
    sides: dict[str, list[Signal]] = {"input": [], "output": []}
    feedthrough = {}
    for entry in entries:
        signal = dict(entry)
        side = signal.pop("causality")
        if "feedthrough" in signal:
            feedthrough[signal["name"]] = _names(signal.pop("feedthrough"))
        if "base" in signal:
            signal["base"] = BaseUnit(
                **signal["base"] | {"exponents": tuple(signal["base"]["exponents"])}
            )
        sides[side].append(Signal(**signal | {"start": tuple(signal.get("start", ()))}))
    known = {output: _names(names) for output, names in initial.items()}
    return Interface(tuple(sides["input"]), tuple(sides["output"]), feedthrough, known)


def _names(names: list[str] | None) -> tuple[str, ...] | None:
    return None if names is None else tuple(names)


def record_dtype(size: int) -> np.dtype[np.void]:
    """Describe a whole message record of ``size`` doubles."""
    head: list[Any] = [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel_id", "<u2"),
        ("sequence", "<u4"),
    ]
    head += [("log_time", "<u8"), ("publish_time", "<u8")]
    for width, (name, first, stop) in enumerate(_GROUPS, start=1):
        count = min(size + 1, stop) - first
        if count > 0:
            head.append((name, [("tag", "u1", (width,)), ("value", "<f8")], (count,)))
    return np.dtype(head)


def blank_records(channel_id: int, size: int, count: int) -> Records:
    """Make ``count`` message records with everything constant filled in."""
    dtype = record_dtype(size)
    records = np.zeros(count, dtype)
    records["opcode"], records["length"], records["channel_id"] = (
        Opcode.MESSAGE,
        dtype.itemsize - HEADER,
        channel_id,
    )
    for name, tags in tags_of(size).items():
        records[name]["tag"] = tags
    return records


def tags_of(size: int) -> dict[str, NDArray[np.uint8]]:
    """Give the tag bytes of each group of fields, shape (fields, bytes): ``number << 3 | 1`` as varints."""
    tags = {}
    for width, (name, first, stop) in enumerate(_GROUPS, start=1):
        keys = np.arange(first, min(size + 1, stop), dtype=np.int64) << 3 | 1
        if len(keys):
            varint = np.stack(
                [keys >> 7 * i & 0x7F | (0x80 if i < width - 1 else 0) for i in range(width)],
                axis=1,
            )
            tags[name] = varint.astype(np.uint8)
    return tags


def group_columns(size: int) -> dict[str, slice]:
    """Say which elements of a part stand in which group of fields."""
    return {
        name: slice(first - 1, min(size + 1, stop) - 1)
        for name, first, stop in _GROUPS
        if size >= first
    }


def copy_values(records: Records, into: Matrix) -> None:
    """Copy the doubles of message records to ``into``, shape (n, size).

    Raises
    ------
    ValueError
        If the records have other fields than ours.
    """
    size = into.shape[1]
    tags = tags_of(size)
    for name, columns in group_columns(size).items():
        if not np.array_equal(
            records[name]["tag"], np.broadcast_to(tags[name], records[name]["tag"].shape)
        ):
            raise ValueError(
                "messages with other fields than declared: written or re-encoded by another tool"
            )
        into[:, columns] = records[name]["value"]
