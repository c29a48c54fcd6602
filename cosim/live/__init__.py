"""Runs and logs to watch while they go on: a server that Foxglove and Lichtblick connect to.

Needs the extra ``live``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from cosim.lazy import lazy_names

if TYPE_CHECKING:
    from cosim.live.playback import play
    from cosim.live.server import LiveServer

_HOMES = {"LiveServer": "cosim.live.server", "play": "cosim.live.playback"}

__all__ = ["LiveServer", "play"]

__getattr__ = lazy_names(__name__, _HOMES)


def __dir__() -> list[str]:
    return list(__all__)
