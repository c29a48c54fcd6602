"""What a run shows about a unit that its user should know."""

from __future__ import annotations

from typing import final

from cosim.fmi.binary.messages import Message


@final
class Diagnostics:
    """Warnings of a unit, kept until they are fetched; each kind is said once."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._said: set[str] = set()  # what they were about
        self._news: list[Message] = []

    def add(self, t: float, about: str, text: str) -> None:
        """Say it at ``t`` [s], unless something was said about that before."""
        if about not in self._said:
            self._said.add(about)
            self._news.append(Message(t, "warning", "", f"{self._name}: {text}"))

    def drain(self) -> list[Message]:
        """Give the warnings since the last call."""
        news, self._news = self._news, []
        return news
