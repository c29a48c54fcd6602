"""A layout for viewers of MCAP files, Foxglove and Lichtblick: panels with plots, as JSON.

The format is that of the layouts that both viewers export and import: the configuration of every
panel by its identifier, ``Plot!1``, and a binary tree that divides the window among the panels.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Final

from cosim.core.recorded.signals import RecordedPort, find_signal
from cosim.core.signals import Channel, Signal, element_names
from cosim.log.messages import message_paths
from cosim.units import with_unit

LAYOUT_FILE: Final = "viewer-layout.json"
MOST_PANELS: Final = 12
MOST_SERIES: Final = 10  # of a panel, more cannot be told apart
_MOST_ROWS = 4


@dataclass(frozen=True, slots=True)
class ViewerPanel:
    """A plot over time.

    Parameters
    ----------
    title : str
    signals : tuple of RecordedPort
        Each element is a curve.
    levels : tuple of float
        Horizontal lines.
    """

    title: str
    signals: tuple[RecordedPort, ...]
    levels: tuple[float, ...] = ()


def layout_json(panels: Sequence[ViewerPanel]) -> bytes:
    """Return the layout that shows the first panels, at most ``MOST_PANELS``."""
    configs = {}
    # Path and name of every element of a component, each once: one may have thousands.
    elements: dict[str, list[tuple[str, str]]] = {}
    for number, panel in enumerate(panels[:MOST_PANELS], start=1):
        curves = []
        for port in panel.signals:
            name = port.channel.name
            if name not in elements:
                names = element_names(port.channel.signals)
                elements[name] = list(zip(message_paths(port.channel), names, strict=True))
            own = elements[name][port.columns]
            for (path, element), unit in zip(own, port.measures, strict=True):
                curves.append(_curve(path, with_unit(f"{name}.{element}", unit.name)))
        curves += [_curve(repr(level), repr(level)) for level in panel.levels]
        configs[f"Plot!{number}"] = _panel_config(panel, curves)
    content: dict[str, Any] = {
        "configById": configs,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
    }
    if configs:
        content["layout"] = _grid(list(configs))
    return json.dumps(content, indent=1).encode()


def output_panels(channels: Mapping[str, Channel]) -> list[ViewerPanel]:
    """Return panels of all outputs: one for every unit, and one a component for those without.

    Of a component that has other outputs, states are left out. A panel of more than ``MOST_SERIES``
    elements is divided.
    """
    groups: dict[str, list[RecordedPort]] = {}
    for name, channel in channels.items():
        for signal in shown_outputs(channel):
            port = find_signal(channels, f"{name}.{signal.name}", source="the run")
            for part in _in_one_unit(port):
                unit = part.measures[0].name
                title = name if unit is None else f"[{unit}]"
                groups.setdefault(title, []).append(part)
    panels = []
    for title, ports in groups.items():
        for signals in _divided(ports):
            panels.append(ViewerPanel(title, signals))
    return panels


def _in_one_unit(port: RecordedPort) -> Iterator[RecordedPort]:
    """Yield the parts of a signal whose neighbouring elements have the same unit."""
    start = port.columns.start
    for _, elements in groupby(port.measures):
        stop = start + len(list(elements))
        yield port._replace(columns=slice(start, stop))
        start = stop


def shown_outputs(channel: Channel) -> Sequence[Signal]:
    """Return the outputs of a component that are no states; where all are, these."""
    outputs = channel.interface.outputs
    return [signal for signal in outputs if signal.role != "state"] or outputs


def _divided(ports: Iterable[RecordedPort]) -> list[tuple[RecordedPort, ...]]:
    """Divide signals such that no part has more than ``MOST_SERIES`` elements."""
    parts: list[list[RecordedPort]] = []
    room = 0
    for port in ports:
        columns = port.columns
        for start in range(columns.start, columns.stop, MOST_SERIES):
            stop = min(start + MOST_SERIES, columns.stop)
            if stop - start > room:
                parts.append([])
                room = MOST_SERIES
            parts[-1].append(port._replace(columns=slice(start, stop)))
            room -= stop - start
    return [tuple(part) for part in parts]


def _panel_config(panel: ViewerPanel, curves: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    units = {unit.name for port in panel.signals for unit in port.measures}
    unit = units.pop() if len(units) == 1 else None
    return {
        # the title, by the name that each viewer has for it
        "foxglovePanelTitle": panel.title,
        "lichtblickPanelTitle": panel.title,
        "paths": curves,
        "xAxisVal": "timestamp",
        "isSynced": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": False,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "yAxisLabel": unit or "",
        "sidebarDimension": 240,
    }


def _curve(value: str, label: str) -> dict[str, Any]:
    return {"value": value, "label": label, "enabled": True, "timestampMethod": "receiveTime"}


def _grid(names: Sequence[str]) -> Any:
    """Return the tree of panels in columns of at most ``_MOST_ROWS``, filled row by row."""
    columns = -(-len(names) // _MOST_ROWS)
    return _divide([_divide(names[k::columns], "column") for k in range(columns)], "row")


def _divide(nodes: Sequence[Any], direction: str) -> Any:
    """Return the node that gives each of some nodes the same part."""
    if len(nodes) == 1:
        return nodes[0]
    return {
        "direction": direction,
        "first": nodes[0],
        "second": _divide(nodes[1:], direction),
        "splitPercentage": 100.0 / len(nodes),
    }
