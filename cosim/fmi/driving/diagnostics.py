"""What a run shows about an FMU that its user should know."""

from __future__ import annotations

from typing import final

from cosim.fmi.binary.messages import Message


@final
class Diagnostics:
    """Warnings about an FMU, at most one on each topic, kept until they are fetched."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._topics: set[str] = set()  # of all warnings so far
        self._new: list[tuple[str, Message]] = []  # with their topics
        self._count = 0  # of all warnings so far

    def add(self, t: float | None, topic: str, warning: str, category: str = "") -> None:
        """Add a warning, unless there was one on that topic before.

        ``t`` [s] is when; None: that is not known. ``category``: what programs know it by.
        """
        if topic not in self._topics:
            self._topics.add(topic)
            self._count += 1
            message = Message(t, "warning", category, f"{self._name}: {warning}")
            self._new.append((topic, message))

    def discard(self) -> None:
        """Forget all warnings, so that each may come again."""
        self._topics.clear()
        self._new.clear()

    def drain(self) -> list[Message]:
        """Return the warnings since the last call."""
        messages = [message for _, message in self._new]
        self._new = []
        return messages

    def save(self) -> int:
        """Return what the warnings up to now are known by."""
        return self._count

    def restore(self, state: int) -> None:
        """Forget the warnings since then; those that were fetched were shown, and stay known."""
        first = max(0, len(self._new) - (self._count - state))
        self._topics.difference_update(topic for topic, _ in self._new[first:])
        del self._new[first:]
        self._count = state
