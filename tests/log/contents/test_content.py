"""What the content hash of a log covers."""

from __future__ import annotations

import hashlib
import json
import struct

from cosim.log import open_log
from cosim.log.metadata import combine_hashes
from tests.log.crafting import put_together, take_apart


def test_the_hash_covers_the_declaration_that_was_recorded(short_log, tmp_path):
    """Whatever the present version would write: a log of an earlier one still has its hash."""
    content = take_apart(short_log)
    for _, _, items in content.channels.values():
        if items:
            signals = json.loads(items["cosim.signals"])
            for signal in signals:
                del signal["type"]  # as if it had been added later, with this default
            items["cosim.signals"] = json.dumps(signals, separators=(",", ":"))
    components = []
    for number, (_, _, items) in content.channels.items():
        if items:
            digest = hashlib.sha256()
            for channel, time_ns, _, data in content.messages:
                if channel == number:
                    digest.update(struct.pack("<q", time_ns))
                    digest.update(b"".join(data[i + 1 : i + 9] for i in range(0, len(data), 9)))
            declared = items["cosim.signals"]
            components.append((items["cosim.component"], declared, digest.hexdigest()))
    expected = combine_hashes(components)
    log = open_log(put_together(content, tmp_path / "b.mcap"))
    assert log.content_hash() == expected
    assert log.content_hash() != open_log(short_log).recorded_hash
