"""Messages are those that the channels declare."""

from __future__ import annotations

import pytest

from cosim.errors import LogError
from cosim.log import open_log
from tests.log.crafting import rewrite
from tests.log.recordings import (
    record,
)


def test_messages_encoded_anew_are_refused(tmp_path):
    """A tool that leaves out zeros changes the size of messages."""
    record(tmp_path / "a.mcap", steps=5)

    def shorten(messages):
        for schema, channel, message in messages:
            message.data = message.data[:-9]
            yield schema, channel, message

    rewrite(tmp_path / "a.mcap", tmp_path / "b.mcap", order=shorten)
    with pytest.raises(LogError, match="re-encoded by another tool"):
        open_log(tmp_path / "b.mcap").rows("plant")
