"""The recorder that shows a run to viewers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import final

import numpy as np

from cosim.arrays import Matrix
from cosim.core.contracts import Block
from cosim.core.recorders import Nothing
from cosim.core.recording import MessageLevel, Plan, SignalEvent, Substep
from cosim.live.connection import ViewerConnection
from cosim.live.publisher import Publisher
from cosim.log.messages import encode_event, encode_log, encode_substep
from cosim.log.preamble import EVENT_TOPIC, LOG_TOPIC, STEP_TOPIC


@final
class LiveRecorder(Nothing):
    """Publishes rows, messages, events and substeps; keeps nothing.

    Parameters
    ----------
    connection : ViewerConnection
    kinds : mapping of component name to str
    signals : sequence of str
        Components or signals to publish; none: all.
    listen : callable
        Called when all topics are there.
    """

    def __init__(
        self,
        connection: ViewerConnection,
        kinds: Mapping[str, str],
        signals: Sequence[str],
        listen: Callable[[], None],
    ) -> None:
        self._connection = connection
        self._kinds = kinds
        self._signals = signals
        self._listen = listen
        self._publisher: Publisher | None = None  # until the run begins
        self._has_rows = False

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Send what came after the last block."""
        if self._publisher is not None:
            self._publisher.send()

    def begin(self, plan: Plan) -> None:
        """Advertise the topics.

        Raises
        ------
        UnknownSignalError
            If a component or signal to publish is not there.
        UsageError
            If somebody else has taken the address.
        """
        self._channels = {channel.name: channel for channel in plan.layout.channels}
        self._publisher = Publisher(
            self._connection,
            self._channels,
            kinds=self._kinds,
            step_ns=plan.step_ns,
            names=self._signals,
            source="the run",
        )
        # Whether there will be events and substeps is not known.
        for topic in (LOG_TOPIC, EVENT_TOPIC, STEP_TOPIC):
            self._publisher.advertise(topic)
        self._listen()

    def write(self, block: Block, signals: Matrix) -> None:
        """Publish the new rows, of each component those that its log has."""
        assert self._publisher is not None
        first = 1 if self._has_rows or block.index else 0
        self._has_rows = True
        rows = np.arange(first, block.steps + 1)
        for name in self._publisher.components:
            channel = self._channels[name]
            kept = rows[(block.index + rows) % channel.period == 0]
            if len(kept):
                own_rows = signals[kept, channel.columns]
                self._publisher.add_rows(name, block.time_ns[kept], own_rows)
        self._publisher.send()

    def message(self, time_ns: int, level: MessageLevel, source: str, text: str) -> None:
        """Publish a message with the next rows; nothing of a run that could not begin."""
        if self._publisher is not None:
            data = encode_log(time_ns, level, source, text)
            self._publisher.add_message(LOG_TOPIC, time_ns, data)

    def event(self, event: SignalEvent) -> None:
        """Publish a jump with the next rows."""
        assert self._publisher is not None
        self._publisher.add_message(EVENT_TOPIC, event.time_ns, encode_event(event))

    def substep(self, substep: Substep) -> None:
        """Publish a substep with the next rows."""
        assert self._publisher is not None
        self._publisher.add_message(STEP_TOPIC, substep.begin_ns, encode_substep(substep))
