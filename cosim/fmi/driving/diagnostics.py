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
        self._messages: list[Message] = []

    def add(self, t: float | None, topic: str, warning: str) -> None:
        """Add a warning, unless there was one on that topic before.

        ``t`` [s] is when; None: that is not known.
        """
        if topic not in self._topics:
            self._topics.add(topic)
            self._messages.append(Message(t, "warning", "", f"{self._name}: {warning}"))

    def drain(self) -> list[Message]:
        """Return the warnings since the last call."""
        messages = self._messages
        self._messages = []
        return messages
