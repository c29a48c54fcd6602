"""A hash of the times and bits of every signal, whatever the signal is called.

Signals with the same hash have the same bits at the same times, in one log or in two. Like the
content hash, it depends neither on the compression nor on the chunks of the file.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

from cosim.core.recorded.signals import RecordedPort
from cosim.core.recording import Recording
from cosim.log.contents.content import hash_input


def hash_signals(run: Recording, selection: Mapping[str, RecordedPort]) -> dict[str, str]:
    """Return the SHA-256 in hex of each chosen signal, by its name.

    Per row it covers the time in ns as int64, then the elements as doubles, all little-endian.

    Raises
    ------
    LogError
        If a file is damaged.
    """
    by_component: dict[str, list[str]] = {}
    for name, port in selection.items():
        by_component.setdefault(port.channel.name, []).append(name)
    digests = {name: hashlib.sha256() for name in selection}
    for component, names in by_component.items():
        for time_ns, rows in run.blocks(component):
            for name in names:
                digests[name].update(hash_input(time_ns, rows[:, selection[name].columns]))
    return {name: digest.hexdigest() for name, digest in digests.items()}
