"""What a log begins and ends with: schemas, channels, metadata, attachments; how the run ended.

The record ``cosim.result`` says how, and so does the attachment ``result.json``, which has the
values that the caller adds, too.
"""

from __future__ import annotations

import json
from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, TypeAlias

import numpy as np

from cosim.core.recording import MessageLevel, Plan, Recorder, SignalEvent, Substep
from cosim.core.signals import Channel
from cosim.instants import NANOSECONDS, StepNs
from cosim.log.layout import (
    DECLARED,
    RECORD,
    Part,
    declaration_json,
    partial_metadata,
    split_channel,
)
from cosim.log.mcap_records import (
    FileHead,
    RecordGroup,
    attachment_group,
    joined_groups,
    metadata_group,
)
from cosim.log.messages import (
    EVENT_SCHEMA,
    LOG_SCHEMA,
    STEP_SCHEMA,
    MessageSchema,
    component_schema,
    element_comments,
    encode_event,
    encode_log,
    encode_substep,
    identifiers,
    part_comment,
)
from cosim.log.metadata import (
    WRITTEN,
    add_checksum,
    compact,
    encode_design,
    environment,
    library_name,
)
from cosim.log.viewer_layout import LAYOUT_FILE, layout_json, output_panels

RESULT = "cosim.result"
RESULT_FILE = "result.json"
PARTIAL = "cosim.partial"  # the result of the whole run, in the log of a part of it
WHOLE = "whole"  # in the result file of a part: what the one of the whole run has
PARTIAL_STATUS = "partial"  # of a log that lacks rows of its run
PART_REASON = "part "  # what the reason of a file of several begins with, before its number

ResultItems: TypeAlias = Mapping[str, str | int]


def span_text(first_ns: int, last_ns: int) -> str:
    """Return from when to when some rows are, in words."""
    return f"from {first_ns / NANOSECONDS} s to {last_ns / NANOSECONDS} s"


def end_group(items: ResultItems, values: Mapping[str, Any]) -> RecordGroup:
    """Return the record and the attachment; ``values`` go to the attachment only."""
    # Ours after the caller's: no caller may overwrite how the run ended.
    text = json.dumps({**values, **items}, default=_to_json, indent=2)
    attachment = attachment_group(RESULT_FILE, "application/json", text.encode())
    return joined_groups([result_record(RESULT, items), attachment])


def result_record(name: str, items: ResultItems) -> RecordGroup:
    """Return the metadata record ``name``: how a run or a part of it ended."""
    texts = {key: str(value) for key, value in items.items()}
    return metadata_group(name, add_checksum(name, texts))


def _to_json(value: object) -> object:
    """Return numpy values as numbers and lists, and all others, such as paths, as text."""
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    return str(value)


FORMAT = "2"
LOG_TOPIC = "/cosim/log"
EVENT_TOPIC = "/cosim/event"
STEP_TOPIC = "/cosim/step"
SCHEMAS: Mapping[str, MessageSchema] = {
    LOG_TOPIC: LOG_SCHEMA,
    EVENT_TOPIC: EVENT_SCHEMA,
    STEP_TOPIC: STEP_SCHEMA,
}


class MessageEncoder(Recorder):
    """Takes messages, events and substeps as the messages of their topics; a subclass has rows."""

    def message(self, time_ns: int, level: MessageLevel, source: str, text: str) -> None:
        """Take a message of the run or of a component at a simulation time [ns]."""
        self._add_message(LOG_TOPIC, time_ns, encode_log(time_ns, level, source, text))

    def event(self, event: SignalEvent) -> None:
        """Take a jump of a signal."""
        self._add_message(EVENT_TOPIC, event.time_ns, encode_event(event))

    def substep(self, substep: Substep) -> None:
        """Take a substep of a loop."""
        self._add_message(STEP_TOPIC, substep.begin_ns, encode_substep(substep))

    @abstractmethod
    def _add_message(self, topic: str, time_ns: int, data: bytes) -> None:
        """Take a message of a topic."""


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file that goes into the log."""

    name: str
    media_type: str
    data: bytes


def parts_of(
    channels: Iterable[Channel], kinds: Mapping[str, str], step_ns: StepNs
) -> list[tuple[Part, tuple[str, bytes]]]:
    """Return the parts of components in a log; of each name and FileDescriptorSet of its messages.

    Parameters
    ----------
    channels : iterable of Channel
    kinds : mapping of component name to str
    step_ns : int or Fraction
        Communication step [ns].
    """
    parts: list[Part] = []
    for channel in channels:
        parts += split_channel(channel, kind=kinds.get(channel.name, ""), step_ns=step_ns)
    messages = identifiers([part.title for part in parts])
    found = []
    for part, message in zip(parts, messages, strict=True):
        title = part_comment(part)
        comments = element_comments(part)
        schema = component_schema(message, part.elements, title=title, comments=comments)
        found.append((part, (f"cosim.{message}", schema)))
    return found


def begin_file(
    plan: Plan,
    *,
    metadata: Mapping[str, Mapping[str, str]],
    attachments: Sequence[Attachment],
    kinds: Mapping[str, str],
    topics: Sequence[str] = (),
) -> tuple[FileHead, dict[int, Part], dict[str, int]]:
    """Return what a file begins with, the parts of its components and the topics beside them.

    Both with the ids of their channels.

    Parameters
    ----------
    plan : Plan
    metadata : mapping of record name to its items
    attachments : sequence of Attachment
    kinds : mapping of component name to str
    topics : sequence of str
        ``EVENT_TOPIC``, ``STEP_TOPIC``, where there are such messages.
    """
    head = FileHead(library=library_name())
    numbered = {}
    for part, schema in parts_of(plan.layout.channels, kinds, plan.step_ns):
        number = head.channel(f"/{part.title}", schema=schema, metadata=part.metadata)
        numbered[number] = part
    topic_ids = {}

    def add(topic: str) -> None:
        schema = SCHEMAS[topic]
        serialized = (schema.name, schema.serialized)
        topic_ids[topic] = head.channel(topic, schema=serialized, metadata={})

    add(LOG_TOPIC)
    own = _own_metadata(plan, kinds)
    for name in {**metadata, **own}:
        # Ours after the caller's: no caller may overwrite what a replay rests on.
        items = {**metadata.get(name, {}), **own.get(name, {})}
        head.metadata(name, add_checksum(name, items))
    for attachment in attachments:
        head.attachment(attachment.name, attachment.media_type, attachment.data)
    if all(attachment.name != LAYOUT_FILE for attachment in attachments):
        layout = layout_json(output_panels(plan.channels))
        head.attachment(LAYOUT_FILE, "application/json", layout)
    for topic in topics:
        add(topic)
    return head, numbered, topic_ids


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
