"""The store of a log, driven flush by flush, without a thread and without waiting."""

from __future__ import annotations

import numpy as np

from cosim.log.background import RunContent
from cosim.log.files import UnfinishedLog
from cosim.log.preamble import begin_file
from cosim.log.store import LogStore
from tests.log.recordings import STEP_NS


class Unplaced(UnfinishedLog):
    """The place of a log that is written to a stream."""

    def __init__(self, stream):
        super().__init__("x.mcap", force=False)
        self.create = lambda: stream

    def publish(self):
        self.published = True

    def check(self):
        pass


def open_store(stream, plan, *, compression="none", metadata=None, attachments=()):
    """Return the store of a new log, written to a stream."""
    options = {"metadata": metadata or {}, "attachments": attachments, "kinds": {}}
    head, parts, _ = begin_file(plan, **options)
    store = LogStore(Unplaced(stream), plan, head, parts, compression=compression)
    store.begin(0)
    return store


def content(rows, start, stop, messages=()):
    """Return rows ``start`` to ``stop`` of a run, and messages."""
    steps = np.arange(start, stop, dtype=np.int64)
    return RunContent(steps, steps * STEP_NS, rows[start:stop], messages)
