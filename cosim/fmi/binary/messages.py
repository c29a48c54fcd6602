"""What an FMU logs, between the callback of ``native/fmi/callbacks.c`` and the log."""

from __future__ import annotations

import math
import weakref
from ctypes import addressof, byref, c_double
from typing import Final, NamedTuple

from cosim.core.recording import MessageLevel
from cosim.native.fmi.callbacks import MessagesStruct, MessageStruct
from cosim.native.library import library
from cosim.native.memory import place_struct

LEVELS: Final[tuple[MessageLevel, ...]] = (
    "info",  # ok
    "warning",  # warning
    "warning",  # discard
    "error",  # error
    "fatal",  # fatal
    "info",  # pending
)
MESSAGES: Final = 100  # how many are kept until they are fetched


class Message(NamedTuple):
    """A message of an FMU, or of its driver about it; ``category`` is one of its LogCategories.

    ``time`` [s] is when it was logged, in the simulation; None: that is not known, or the
    simulation did not begin.
    """

    time: float | None
    level: MessageLevel
    category: str
    text: str

    @staticmethod
    def of(struct: MessageStruct) -> Message:
        """Read what the callback took."""
        has_level = 0 <= struct.status < len(LEVELS)
        level: MessageLevel = LEVELS[struct.status] if has_level else "warning"
        time = None if math.isnan(struct.time) else struct.time
        category = struct.category.decode("utf-8", "replace")
        text = struct.text.decode("utf-8", "replace")
        return Message(time, level, category, text)


class Messages:
    """What an FMU logs, kept until it is fetched: the last ``MESSAGES`` of it, 1000 bytes each.

    Parameters
    ----------
    name : str
        Of the component, for a process that dies in a call of it.

    Attributes
    ----------
    clock : c_double
        The time [s] that messages get; NaN before the initialization. Whoever calls the FMU writes
        it: where the initialization and every communication step begin (what is logged in a step
        or after it has the time of its begin), and in model exchange what ``set_time`` sets. It is
        the memory itself that C reads, as a store in a method would cost more than the rest.
    """

    def __init__(self, name: str = "") -> None:
        ring = (MessageStruct * MESSAGES)()
        # The address, not a cast of the ring: that would make a reference cycle of 100 kB.
        self._struct = place_struct(MessagesStruct)
        self._struct.ring = addressof(ring)
        self._struct.size = MESSAGES
        self._struct.name = name.encode()
        self._out = MessageStruct()
        self._taken: list[Message] = []  # out of the ring, and not fetched yet
        self._count = 0  # of all that were taken out of the ring
        self.clock = c_double.from_buffer(self._struct, MessagesStruct.now.offset)
        self.clock.value = math.nan
        library.cosim_messages_open(byref(self._struct))
        weakref.finalize(self, _close, self._struct, ring)

    def accept(self, key: int | None) -> None:
        """Take the messages with this key; None: those with a key that nobody accepts."""
        self._struct.key = key
        self._struct.accepts_unknown = int(key is None)

    @property
    def address(self) -> int:
        """Where compiled code finds them (``cosim_messages``)."""
        return addressof(self._struct)

    @property
    def time(self) -> float | None:
        """The time [s] that a message would get now; None: the initialization did not begin."""
        time: float = self.clock.value
        return None if math.isnan(time) else time

    @property
    def last_as_suffix(self) -> str:
        """The last message that was not fetched yet, to end an error with; empty without one."""
        if library.cosim_messages_last(byref(self._struct), byref(self._out)):
            return last_as_suffix(Message.of(self._out))
        return last_as_suffix(self._taken[-1]) if self._taken else ""

    def drain(self) -> list[Message]:
        """Return the messages since the last call, and how many were dropped."""
        self._take()
        messages = self._taken
        self._taken = []
        return messages

    def mark(self) -> int:
        """Return what the messages up to now are known by."""
        self._take()
        return self._count

    def forget(self, mark: int) -> None:
        """Forget the messages that came behind a mark, and were not fetched yet."""
        self._take()
        kept = max(0, len(self._taken) - (self._count - mark))
        del self._taken[kept:]
        self._count = mark

    def _take(self) -> None:
        """Take the messages out of the ring."""
        dropped = library.cosim_messages_dropped(byref(self._struct))
        messages: list[Message] = []
        for _ in range(MESSAGES):  # not without end, if it goes on to log from another thread
            if not library.cosim_messages_take(byref(self._struct), byref(self._out)):
                break
            messages.append(Message.of(self._out))
        if dropped:
            time = messages[0].time if messages else None
            text = f"{dropped} earlier messages of the FMU were dropped"
            messages.insert(0, Message(time, "warning", "", text))
        self._taken += messages
        self._count += len(messages)


def last_as_suffix(last: Message) -> str:
    """Return the last message of an FMU, to end an error with."""
    return f"; its last message: {last.level}: {last.text}"


def _close(struct: MessagesStruct, ring: object) -> None:
    """Take the memory from the list that FMUs log to; the finalizer keeps ``ring`` until then."""
    library.cosim_messages_close(byref(struct))
