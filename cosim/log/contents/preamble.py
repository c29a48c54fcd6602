"""The start of a log, before the first row: schemas, channels, metadata, attachments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from cosim.core.recording import Plan
from cosim.log.contents.comments import element_comments, part_comment
from cosim.log.contents.environment import WRITTEN, environment
from cosim.log.contents.layout import Part
from cosim.log.contents.messages import EVENT_SCHEMA, LOG_SCHEMA, STEP_SCHEMA, MessageSchema
from cosim.log.contents.metadata import compact, encode_design
from cosim.log.contents.record_selection import DECLARED, RECORD, declaration_json, partial_metadata
from cosim.log.contents.schema import component_schema, identifiers
from cosim.log.contents.viewer_layout import LAYOUT_FILE, layout_json, output_panels
from cosim.log.mcap_file.checksum import add_checksum
from cosim.log.mcap_file.head import FileHead

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
