"""What an MCAP file of another tool contains, as plain values."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from cosim.instants import NANOSECONDS
from cosim.log.foreign.survey import TopicSurvey, survey

MOST_FIELDS: Final = 1000  # that are shown


def describe_recording(path: str) -> dict[str, Any]:
    """Describe a recording of another tool: topics, times, order, numeric fields.

    Raises
    ------
    LogError
        If it cannot be read, or is damaged.
    """
    topics = survey(Path(path))
    fields: list[dict[str, Any]] = []
    for topic in topics:
        for name, type_name in topic.fields.items():
            fields.append({"field": name, "type": type_name})
    content: dict[str, Any] = {
        "recording": _about(topics),
        "topics": [_topic_row(topic) for topic in topics],
        "fields": fields[:MOST_FIELDS],
    }
    if len(fields) > MOST_FIELDS:
        content["more fields"] = {"not shown": len(fields) - MOST_FIELDS}
    problems = [{"topic": topic.topic, "problem": topic.problem} for topic in topics]
    unread = [row for row in problems if row["problem"]]
    if unread:
        content["not read"] = unread
    return content


def _about(topics: Sequence[TopicSurvey]) -> dict[str, Any]:
    spacings = [topic.spacing for topic in topics if topic.spacing is not None]
    about: dict[str, Any] = {
        "topics": len({topic.topic for topic in topics}),
        "messages": sum(spacing.count for spacing in spacings),
    }
    if spacings:
        first = min(spacing.first_ns for spacing in spacings)
        last = max(spacing.last_ns for spacing in spacings)
        about["log times"] = f"{_seconds(first)} s to {_seconds(last)} s"
        about["duration"] = f"{_seconds(last - first)} s"
    return about


def _topic_row(topic: TopicSurvey) -> dict[str, Any]:
    schema = topic.schema
    if topic.schema_encoding:
        schema += f" ({topic.schema_encoding})"
    row: dict[str, Any] = {
        "topic": topic.topic,
        "encoding": topic.encoding,
        "schema": schema or None,
    }
    spacing = topic.spacing
    if spacing is None:
        return {**row, "messages": 0} | dict.fromkeys(
            ("rate", "out of order", "same instant", "largest gap", "at")
        )
    rate = spacing.rate
    return {
        **row,
        "messages": spacing.count,
        "rate": None if rate is None else f"{rate:.6g} Hz",
        "out of order": spacing.late,
        "same instant": spacing.repeated,
        "largest gap": f"{spacing.largest_ns / NANOSECONDS:g} s",
        "at": f"{_seconds(spacing.largest_at_ns)} s",
    }


def _seconds(time_ns: int) -> str:
    """Return a time in ns as seconds, with all its digits."""
    sign = "-" if time_ns < 0 else ""
    whole, rest = divmod(abs(time_ns), NANOSECONDS)
    decimals = f"{rest:09d}".rstrip("0")
    return f"{sign}{whole}.{decimals}" if decimals else f"{sign}{whole}"
