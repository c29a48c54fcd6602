"""What a log begins and ends with: schemas, channels, metadata, attachments; how the run ended.

The record ``cosim.result`` says how, and so does the attachment ``result.json``, which has the
values that the caller adds, too.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any, TypeAlias

import numpy as np
from isal import isal_zlib

from cosim.core.recorders import EndOfRun
from cosim.core.recording import Plan
from cosim.instants import NANOSECONDS
from cosim.log.checksum import add_checksum
from cosim.log.layout import DECLARED, RECORD, Part, declaration_json, partial_metadata
from cosim.log.mcap_records import FileHead, RecordGroup, attachment_group, metadata_group
from cosim.log.messages import EVENT_SCHEMA, LOG_SCHEMA, STEP_SCHEMA, MessageSchema
from cosim.log.metadata import WRITTEN, compact, encode_design, environment
from cosim.log.schema import component_schema, element_comments, identifiers, part_comment
from cosim.log.viewer_layout import LAYOUT_FILE, layout_json, output_panels

RESULT = "cosim.result"
RESULT_FILE = "result.json"
PARTIAL = "cosim.partial"  # the result of the whole run, in the log of a part of it
WHOLE = "whole"  # in the result file of a part: what the one of the whole run has
PARTIAL_STATUS = "partial"  # of a log that lacks rows of its run
PART_REASON = "part "  # what the reason of a file of several begins with, before its number

ResultItems: TypeAlias = Mapping[str, str | int]


@dataclass(frozen=True, slots=True)
class LastRow:
    """The last row of a run."""

    steps: int = 0
    end_ns: int = 0


def result_items(end: EndOfRun, last_row: LastRow, *, content_hash: str) -> ResultItems:
    """Return what is recorded of the end of a run."""
    return {**asdict(end), **asdict(last_row), "content_hash": content_hash}


def with_whole(part: RecordGroup, whole: ResultItems) -> RecordGroup:
    """Return the end of the last file of a log of several behind that of the whole run."""
    return _joined(result_record(PARTIAL, whole), part)


def part_items(
    number: int, first_ns: int | None, last_row: Mapping[str, Any], content_hash: str
) -> ResultItems:
    """Return what is recorded of the end of a file of several.

    Parameters
    ----------
    number : int
        Of the file, from 1.
    first_ns : int or None
        Its first row [ns]; None: there is none.
    last_row : mapping
        Its ``steps`` and ``end_ns``.
    content_hash : str
        Of the rows of the file.
    """
    end_ns = last_row["end_ns"]
    where = "without rows" if first_ns is None else span_text(first_ns, end_ns)
    return {
        "status": PARTIAL_STATUS,
        "reason": f"{PART_REASON}{number} of its log, {where}",
        "steps": last_row["steps"],
        "end_ns": end_ns,
        "content_hash": content_hash,
    }


def span_text(first_ns: int, last_ns: int) -> str:
    """Return from when to when some rows are, in words."""
    return f"from {first_ns / NANOSECONDS} s to {last_ns / NANOSECONDS} s"


def end_group(items: ResultItems, values: Mapping[str, Any]) -> RecordGroup:
    """Return the record and the attachment; ``values`` go to the attachment only."""
    # Ours after the caller's: no caller may overwrite how the run ended.
    text = json.dumps({**values, **items}, default=_to_json, indent=2)
    attachment = attachment_group(RESULT_FILE, "application/json", text.encode())
    return _joined(result_record(RESULT, items), attachment)


def result_record(name: str, items: ResultItems) -> RecordGroup:
    """Return the metadata record ``name``: how a run or a part of it ended."""
    texts = {key: str(value) for key, value in items.items()}
    return metadata_group(name, add_checksum(name, texts))


def _joined(first: RecordGroup, second: RecordGroup) -> RecordGroup:
    entries = [*first.entries, *second.placed(first.size)]
    crc = isal_zlib.crc32_combine(first.crc, second.crc, second.size)
    return RecordGroup([*first.parts, *second.parts], entries, crc)


def _to_json(value: object) -> object:
    """Return numpy values as numbers and lists, and all others, such as paths, as text."""
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    return str(value)


FORMAT = "2"
LOG_TOPIC = "/cosim/log"
EVENT_TOPIC = "/cosim/event"
STEP_TOPIC = "/cosim/step"


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file that goes into the log."""

    name: str
    media_type: str
    data: bytes


def part_schemas(parts: Sequence[Part]) -> list[tuple[str, bytes]]:
    """Return name and FileDescriptorSet of the messages of all parts of a log."""
    messages = identifiers([part.title for part in parts])
    schemas = []
    for part, message in zip(parts, messages, strict=True):
        schemas.append((f"cosim.{message}", part_schema(part, message)))
    return schemas


def part_schema(part: Part, message: str) -> bytes:
    """Return the schema of a part's messages, ``cosim.<message>``."""
    title = part_comment(part)
    comments = element_comments(part)
    return component_schema(message, part.elements, title=title, comments=comments)


def add_parts(head: FileHead, parts: Sequence[Part]) -> list[int]:
    """Add schema and channel of every part; return the channels' ids."""
    channel_ids = []
    for part, schema in zip(parts, part_schemas(parts), strict=True):
        topic = f"/{part.title}"
        channel_id = head.channel(topic, schema=schema, metadata=part.metadata)
        channel_ids.append(channel_id)
    return channel_ids


def add_event_channel(head: FileHead) -> int:
    """Add the channel of the jumps of signals; return its id."""
    return _add_channel(head, EVENT_TOPIC, EVENT_SCHEMA)


def add_step_channel(head: FileHead) -> int:
    """Add the channel of the substeps of loops; return its id."""
    return _add_channel(head, STEP_TOPIC, STEP_SCHEMA)


def add_preamble(
    head: FileHead,
    plan: Plan,
    *,
    metadata: Mapping[str, Mapping[str, str]],
    attachments: Sequence[Attachment],
    kinds: Mapping[str, str],
) -> int:
    """Add the channel of messages, the metadata and the attachments; return the channel's id."""
    channel_id = _add_channel(head, LOG_TOPIC, LOG_SCHEMA)
    for name, items in _complete_metadata(plan, metadata, kinds).items():
        head.metadata(name, add_checksum(name, items))
    for attachment in _with_layout(plan, attachments):
        head.attachment(attachment.name, attachment.media_type, attachment.data)
    return channel_id


def _with_layout(plan: Plan, attachments: Sequence[Attachment]) -> list[Attachment]:
    """Return attachments with a layout for viewers; the caller's, where there is one."""
    if any(attachment.name == LAYOUT_FILE for attachment in attachments):
        return list(attachments)
    layout = layout_json(output_panels(plan.channels))
    return [*attachments, Attachment(LAYOUT_FILE, "application/json", layout)]


def _add_channel(head: FileHead, topic: str, schema: MessageSchema) -> int:
    return head.channel(topic, schema=(schema.name, schema.serialized), metadata={})


def _complete_metadata(
    plan: Plan, metadata: Mapping[str, Mapping[str, str]], kinds: Mapping[str, str]
) -> dict[str, dict[str, str]]:
    """Return all metadata records: the caller's, completed by the recorder's own."""
    completed = {name: dict(items) for name, items in metadata.items()}
    for name, items in _own_metadata(plan, kinds).items():
        # Ours after the caller's: no caller may overwrite what a replay rests on.
        completed[name] = {**completed.get(name, {}), **items}
    return completed


def _own_metadata(plan: Plan, kinds: Mapping[str, str]) -> dict[str, dict[str, str]]:
    stages = compact(list(plan.schedule))
    written = datetime.now(UTC).isoformat(sep=" ", timespec="seconds")
    records = {
        "cosim.run": {"format": FORMAT},
        "cosim.env": environment(),
        WRITTEN: {"time": written},
        "cosim.schedule": {"step_ns": str(plan.step_ns), "stages": stages},
    }
    if plan.partial is not None:
        records[RECORD] = partial_metadata(plan.partial)
    for name, channel in plan.declared.items():
        design = plan.designs.get(name, {})
        held = [bool(value) for value in plan.held.get(name, ())]
        records[f"cosim.component.{name}"] = {
            "cosim.design": encode_design(design),
            "cosim.held": compact(held),
        }
        if plan.partial is not None:
            items = records[f"cosim.component.{name}"]
            items[DECLARED] = declaration_json(channel, kinds.get(name, ""), plan.step_ns)
    return records
