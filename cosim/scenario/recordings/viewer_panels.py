"""What viewers show of a run: outputs that are measured, and estimates beside their truth."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Any, Final

import numpy as np

from cosim.core.connections import Connection
from cosim.core.port import Port, named_ports
from cosim.core.recorded.signals import RecordedPort, find_signal
from cosim.core.signals import Channel
from cosim.errors import UnknownSignalError
from cosim.log.contents.viewer_layout import ViewerPanel, output_panels

# Estimates that are shown where no truth is given; of the others there are only some beside these.
_SHOWN: Final = ("delta", "theta")
_MEASURED: Final = "y"
_SOURCE: Final = "the run"


def viewer_panels(
    channels: Mapping[str, Channel],
    connections: Mapping[Port, Connection],
    truth: Mapping[str, Any],
) -> list[ViewerPanel]:
    """Return the panels of a run; of one without estimates those of all outputs."""
    estimators = [name for name, channel in channels.items() if _estimates(channel)]
    if not estimators:
        return output_panels(channels)
    panels = []
    measured = _measured(channels, connections, estimators)
    if measured:
        panels.append(ViewerPanel("measured outputs", measured))
    shown = dict.fromkeys(truth)
    for name in estimators:
        for estimate in _estimates(channels[name]):
            port = f"{name}.{estimate}"
            is_known = any(key.partition("[")[0] == port for key in truth)
            if estimate in _SHOWN and not is_known:
                shown[port] = None
    for estimate in shown:
        panel = _estimate_panel(channels, estimate, truth.get(estimate))
        if panel.signals:
            panels.append(panel)
    return panels


def _estimates(channel: Channel) -> list[str]:
    outputs = channel.interface.outputs
    return [signal.name for signal in outputs if signal.role == "estimate"]


def _measured(
    channels: Mapping[str, Channel],
    connections: Mapping[Port, Connection],
    estimators: list[str],
) -> tuple[RecordedPort, ...]:
    """Return what drives the inputs y of estimators, each signal once."""
    sources: dict[str, None] = {}
    for to, connection in connections.items():
        if to.component in estimators and to.signal == _MEASURED:
            sources |= dict.fromkeys(map(str, connection.sources))
    return tuple(_recorded(channels, sources))


def _recorded(channels: Mapping[str, Channel], names: Iterable[str]) -> Iterator[RecordedPort]:
    """Yield the signals that are recorded, in their order."""
    for name in names:
        with suppress(UnknownSignalError):
            yield find_signal(channels, name, source=_SOURCE)


def _estimate_panel(channels: Mapping[str, Channel], estimate: str, truth: Any) -> ViewerPanel:
    """Return an estimate with the signals, or the values, that it should have."""
    names = [estimate, *named_ports(truth)]
    signals = tuple(_recorded(channels, names))
    return ViewerPanel(estimate, signals, tuple(_levels(truth)))


def _levels(truth: Any) -> Iterator[float]:
    """Yield the values of a truth that names no signals."""
    if truth is not None and not named_ports(truth):
        yield from np.atleast_1d(np.array(truth, np.float64)).tolist()
