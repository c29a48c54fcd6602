"""What an FMU logs, between the kernels' callback that takes it (``native/fmi.c``) and the log."""

from __future__ import annotations

import math
import weakref
from ctypes import addressof, byref, c_double
from typing import Final, NamedTuple

from cosim.core.contracts import MessageLevel
from cosim.native.library import MessagesStruct, MessageStruct, library

LEVELS: Final[tuple[MessageLevel, ...]] = (
    "info",
    "warning",
    "warning",
    "error",
    "fatal",
    "info",
)  # by FMI status
MESSAGES: Final = 100  # how many are kept until they are fetched


class Message(NamedTuple):
    """A message of an FMU, or of its driver about it; ``category`` is one of its LogCategories.

    ``time`` [s] is when it was said, in the simulation; None: that is not known, or the simulation did not begin.
    """

    time: float | None
    level: MessageLevel
    category: str
    text: str

    @staticmethod
    def of(found: MessageStruct) -> Message:
        """Read what the callback took."""
        level: MessageLevel = LEVELS[found.status] if 0 <= found.status < len(LEVELS) else "warning"
        time = None if math.isnan(found.time) else found.time
        return Message(
            time,
            level,
            found.category.decode("utf-8", "replace"),
            found.text.decode("utf-8", "replace"),
        )


class Messages:
    """What an FMU logs, kept until it is fetched: the last ``MESSAGES`` of it, 1000 bytes each.

    Attributes
    ----------
    clock : c_double
        The time [s] that messages get; NaN before the start. Whoever calls the FMU writes it: where the initialization and
        every communication step begin (what is said in a step or behind it has the time of its begin), and in model exchange
        what ``set_time`` sets. It is the memory itself that C reads, as a store in a method would cost more than the rest.
    """

    def __init__(self) -> None:
        ring = (MessageStruct * MESSAGES)()
        self._kept = MessagesStruct(
            ring=addressof(ring), size=MESSAGES
        )  # not cast: that makes a cycle of 100 kB
        self._out = MessageStruct()
        self.clock = c_double.from_buffer(self._kept, MessagesStruct.now.offset)
        self.clock.value = math.nan
        library.cosim_messages_open(byref(self._kept))
        weakref.finalize(self, _close, self._kept, ring)

    def listen(self, key: int | None) -> None:
        """Take what comes with this key; None: with a key that nobody listens to."""
        self._kept.key, self._kept.accepts_unknown = key, int(key is None)

    @property
    def tail(self) -> str:
        """The last one that was not fetched yet, as the tail of an error; empty where there is none."""
        if not library.cosim_messages_last(byref(self._kept), byref(self._out)):
            return ""
        last = Message.of(self._out)
        return f"; it said: {last.level}: {last.text}"

    def drain(self) -> list[Message]:
        """Give the messages since the last call, and how many were dropped."""
        dropped = library.cosim_messages_dropped(byref(self._kept))
        found: list[Message] = []
        for _ in range(MESSAGES):  # not for ever, if it goes on to log from another thread
            if not library.cosim_messages_take(byref(self._kept), byref(self._out)):
                break
            found.append(Message.of(self._out))
        if dropped:
            time = found[0].time if found else None
            found.insert(
                0,
                Message(time, "warning", "", f"{dropped} earlier messages of the FMU were dropped"),
            )
        return found


def _close(kept: MessagesStruct, ring: object) -> None:
    """Let no FMU reach the memory any more, which is kept until then."""
    library.cosim_messages_close(byref(kept))
