"""The store of a log, driven flush by flush, without a thread and without waiting."""

from __future__ import annotations

import numpy as np

from cosim.log.background import RunContent, RunRows
from cosim.log.layout import split_channel
from cosim.log.live_file import LiveFile
from cosim.log.mcap_records import FileHead
from cosim.log.preamble import add_parts, add_preamble
from cosim.log.store import LogOptions, LogStore
from cosim.log.unfinished import UnfinishedLog
from tests.log.recordings import STEP_NS


class Unplaced(UnfinishedLog):
    """The place of a log that is in memory."""

    def publish(self):
        self.published = True

    def check(self):
        pass


def open_store(stream, plan, *, compression="none", metadata=None, attachments=()):
    """Return the store of a new log, written to a stream."""
    head = FileHead(library="cosim/test")
    parts = []
    for channel in plan.layout.channels:
        parts += split_channel(channel, kind="", step_ns=plan.step_ns)
    numbered = list(zip(add_parts(head, parts), parts, strict=True))
    add_preamble(head, plan, metadata=metadata or {}, attachments=attachments, kinds={})
    file = LiveFile(stream, head.data, head.summary())
    place = Unplaced("x.mcap", force=False)
    store = LogStore(place, file, head, plan, numbered, LogOptions(compression))
    store.begin(0)
    return store


def content(rows, start, stop, messages=()):
    """Return rows ``start`` to ``stop`` of a run, and messages."""
    steps = np.arange(start, stop, dtype=np.int64)
    return RunContent(RunRows(steps, steps * STEP_NS, rows[start:stop]), messages)
