"""Fields taken out of messages that a library decodes to objects."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import Any

from cosim.errors import nearest
from cosim.log.foreign.fields import FieldPath, FieldProblem, StampNs, path_text


class DecodedFormat(ABC):
    """Messages that are decoded to objects with fields."""

    @abstractmethod
    def fields(self, sample: bytes) -> Iterator[tuple[str, str]]:
        """Yield names and types of the numeric fields, by the schema."""

    @abstractmethod
    def decode(self, data: bytes) -> Any:
        """Return a message."""

    @abstractmethod
    def _is_message(self, value: Any) -> bool:
        """Return whether a value is a message."""

    @abstractmethod
    def _field(self, message: Any, name: str) -> Any:
        """Return a field of a message, None if it is not set; raise KeyError if there is none."""

    @abstractmethod
    def _stamp(self, message: Any) -> StampNs | None:
        """Return a message as a time; None: it is none."""

    def value(self, message: Any, path: FieldPath) -> Any:
        """Return what is at a path in a message; None: it is not set."""
        value = message
        for position, step in enumerate(path):
            if value is None:
                return None
            place = path_text(path[:position])
            is_list = isinstance(value, Sequence) and not isinstance(value, str | bytes)
            if isinstance(step, str):
                if is_list:
                    raise FieldProblem(
                        f"{place!r} is an array; choose one of its elements, such as {place}[0]"
                    )
                if not self._is_message(value):
                    what = "text" if isinstance(value, str | bytes) else "a number"
                    raise FieldProblem(f"{place!r} is {what}, so it has no fields")
                try:
                    value = self._field(value, step)
                except KeyError:
                    names = nearest(path_text(path), [name for name, _ in self.fields(b"")])
                    text = path_text(path[: position + 1])
                    raise FieldProblem(f"unknown field {text!r}; {names}") from None
                continue
            if not is_list:
                raise FieldProblem(f"{place!r} is not an array, so it cannot be indexed")
            last = step if isinstance(step, int) else step[-1]
            if last >= len(value):
                raise FieldProblem(
                    f"{place!r}: index {last} is out of range for {len(value)} elements, numbered "
                    "from 0"
                )
            value = value[last] if isinstance(step, int) else value[step.start : step.stop]
        return self._number(value, path)

    def _number(self, value: Any, path: FieldPath) -> Any:
        place = path_text(path)
        if isinstance(value, str | bytes):
            what = "text" if isinstance(value, str) else "bytes"
            raise FieldProblem(f"{place!r}: expected a number, got {what}")
        if isinstance(value, Sequence):
            if len(value) and not isinstance(value[0], int | float):
                return [self._number(item, path) for item in value]
            return value
        if not self._is_message(value):
            return value
        stamp = self._stamp(value)
        if stamp is None:
            known = [name for name, _ in self.fields(b"") if name.startswith(f"{place}.")]
            raise FieldProblem(f"{place!r}: expected a number, got a message; {nearest('', known)}")
        return stamp
