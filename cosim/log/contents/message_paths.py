"""Message paths, by which viewers find the elements of a signal: topic and field.

The grammar is that of Foxglove and Lichtblick: a topic, quoted where it has other characters than
letters, digits, ``_``, ``-`` and ``/``, a dot, a field: ``/plant.x_a_0``.
"""

from __future__ import annotations

import re

from cosim.core.signals import Channel
from cosim.log.contents.layout import split_channel
from cosim.log.contents.schema import identifiers

_PLAIN_TOPIC = re.compile(r"[A-Za-z0-9_/-]+")
_QUOTED = re.compile(r'["\\]')


def message_paths(channel: Channel) -> list[str]:
    """Return the message path of every element of a component, in the order of its row."""
    paths: list[str] = []
    # Kind and step of a part are in none of its names.
    for part in split_channel(channel, kind="", step_ns=1):
        topic = _topic_text(f"/{part.title}")
        paths += [f"{topic}.{field}" for field in identifiers(part.elements)]
    return paths


def _topic_text(topic: str) -> str:
    if _PLAIN_TOPIC.fullmatch(topic):
        return topic
    escaped = _QUOTED.sub(lambda match: f"\\{match[0]}", topic)
    return f'"{escaped}"'
