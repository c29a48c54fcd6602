"""The metadata of a partial log: what was selected, and what the run had.

The record ``cosim.record`` contains the selection and the names of all components. The metadata of
each component contain its declaration with all signals, in the form in which a channel that holds
them all would have it. The checksums of the records cover all of this.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from cosim.core.recorded.partial import PartialRecord, RecordSelection
from cosim.core.signals import Channel
from cosim.instants import StepNs
from cosim.log.contents.layout import Part, read_number, read_part
from cosim.log.contents.metadata import compact, json_table, json_texts

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
        _check_declared(channel, declared[name])
    selection = RecordSelection(None if signals is None else tuple(signals), every)
    return PartialRecord(selection, declared), kinds


def _check_declared(channel: Channel, declared: Channel) -> None:
    """Check that a channel holds what its component declares.

    Raises
    ------
    ValueError
        If it does not.
    """
    for signal in channel.signals:
        if declared.by_name.get(signal.name) != signal:
            raise ValueError(
                f"{channel.name!r} does not declare the recorded signal {signal.name!r}"
            )
    if channel.period % declared.period:
        raise ValueError(
            f"{channel.name!r} has a row every {channel.period} steps, which is not a multiple of "
            f"the {declared.period} steps of its component"
        )
