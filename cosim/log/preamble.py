"""What a log says before the first row: schemas, channels, metadata, attachments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from cosim.core.contracts import Plan
from cosim.log.environment import environment
from cosim.log.layout import Part
from cosim.log.metadata import compact, encode_design, seal
from cosim.log.schema import LOG_SCHEMA, component_schema, identifiers, log_schema
from cosim.log.sink import Sink

FORMAT = "1"
LOG_TOPIC = "/cosim/log"


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file that goes into the log."""

    name: str
    media_type: str
    data: bytes


def write_parts(sink: Sink, parts: Sequence[Part]) -> list[int]:
    """Write schema and channel of every part; give the channels' ids."""
    messages = identifiers([part.title for part in parts])
    return [
        sink.channel(
            f"/{part.title}",
            schema=(f"cosim.{message}", component_schema(message, part.elements)),
            metadata=part.metadata,
        )
        for part, message in zip(parts, messages, strict=True)
    ]


def write_preamble(
    sink: Sink,
    plan: Plan,
    *,
    metadata: Mapping[str, Mapping[str, str]],
    attachments: Sequence[Attachment],
) -> int:
    """Write the channel of messages, the metadata and the attachments; give the channel's id."""
    log_id = sink.channel(LOG_TOPIC, schema=(LOG_SCHEMA, log_schema()), metadata={})
    for name, items in _completed(plan, metadata).items():
        sink.metadata(name, seal(name, items))
    for attachment in attachments:
        sink.attachment(attachment.name, attachment.media_type, attachment.data)
    return log_id


def _completed(plan: Plan, metadata: Mapping[str, Mapping[str, str]]) -> dict[str, dict[str, str]]:
    """Give all metadata records: the caller's, completed by ours."""
    stages = {"step_ns": str(plan.step_ns), "stages": compact(list(plan.schedule))}
    ours = {"cosim.run": {"format": FORMAT}, "cosim.env": environment(), "cosim.schedule": stages}
    for channel in plan.layout.channels:
        held = [bool(value) for value in plan.held.get(channel.name, ())]
        design = encode_design(plan.designs.get(channel.name, {}))
        ours[f"cosim.component.{channel.name}"] = {
            "cosim.design": design,
            "cosim.held": compact(held),
        }
    names = [*metadata, *(name for name in ours if name not in metadata)]
    return {name: {**metadata.get(name, {}), **ours.get(name, {})} for name in names}
