"""The layout for viewers that every log has."""

from __future__ import annotations

import json

from cosim.core.recorded.signals import find_signal
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.log import Attachment, Log
from cosim.log.messages import message_paths
from cosim.log.viewer_layout import (
    LAYOUT_FILE,
    MOST_PANELS,
    MOST_SERIES,
    ViewerPanel,
    layout_json,
    output_panels,
)
from tests.log.recordings import record
from tests.log.viewing import curves, decoded, leaves, parsed


def channels_of(*interfaces):
    """Return components c0, c1, ... in one row."""
    channels = {}
    start = 0
    for number, interface in enumerate(interfaces):
        channel = Channel(f"c{number}", interface, start)
        channels[channel.name] = channel
        start = channel.columns.stop
    return channels


def test_a_log_has_a_layout_of_its_outputs(tmp_path):
    """Those of one unit share a panel, those without have one a component."""
    channels = channels_of(
        Interface((Signal("u", unit="N"),), (Signal("x", 2, unit="m"), Signal("v", unit="m/s"))),
        Interface((), (Signal("x", unit="m"), Signal("on", type="boolean"))),
        Interface((), (Signal("z", role="state"), Signal("y"))),
        Interface((), (Signal("z", role="state"),)),
    )
    record(tmp_path / "a.mcap", steps=40, size=7, lay=Layout(tuple(channels.values())))
    layout = json.loads(Log(tmp_path / "a.mcap").attachment(LAYOUT_FILE))
    panels = {}
    for config in layout["configById"].values():
        labels = [curve["label"] for curve in config["paths"]]
        panels[config["foxglovePanelTitle"]] = (config["yAxisLabel"], labels)
    assert panels == {
        "[m]": ("m", ["c0.x[0] [m]", "c0.x[1] [m]", "c1.x [m]"]),
        "[m/s]": ("m/s", ["c0.v [m/s]"]),
        "c1": ("", ["c1.on"]),
        "c2": ("", ["c2.y"]),
        "c3": ("", ["c3.z"]),
    }
    assert sorted(leaves(layout["layout"])) == sorted(layout["configById"])
    paths, _ = curves(layout)
    assert {parsed(path) for path in paths} <= set(decoded(tmp_path / "a.mcap"))


def test_the_layout_of_the_caller_is_kept(tmp_path):
    """There is one only."""
    channels = channels_of(Interface((), (Signal("y"),)))
    own = Attachment(LAYOUT_FILE, "application/json", b"{}")
    record(
        tmp_path / "a.mcap",
        steps=40,
        size=7,
        lay=Layout(tuple(channels.values())),
        attachments=[own],
    )
    log = Log(tmp_path / "a.mcap")
    assert log.attachments.count(LAYOUT_FILE) == 1
    assert log.attachment(LAYOUT_FILE) == b"{}"


def test_no_panel_has_more_curves_than_can_be_told_apart(subtests):
    """All elements are in some panel, in their order; no more panels than there is room for."""
    for sizes in [(MOST_SERIES + 1,), (9, 2), (3, 25, 1), (1,) * 30, (300,)]:
        signals = tuple(Signal(f"y{k}", size, unit="m") for k, size in enumerate(sizes))
        channels = channels_of(Interface((), signals))
        panels = output_panels(channels)
        layout = json.loads(layout_json(panels))
        counts = [len(config["paths"]) for config in layout["configById"].values()]
        paths, _ = curves(layout)
        with subtests.test(case=sizes):
            assert len(layout["configById"]) == min(len(panels), MOST_PANELS)
            assert len(leaves(layout["layout"])) == len(layout["configById"])
            assert max(counts) <= MOST_SERIES
            assert paths == message_paths(channels["c0"])[: len(paths)]
            assert len(paths) == sum(sizes) or len(layout["configById"]) == MOST_PANELS


def test_a_level_is_a_curve_whose_path_is_a_number():
    """That is how the viewers draw a horizontal line."""
    channels = channels_of(Interface((), (Signal("y"),)))
    port = find_signal(channels, "c0.y", source="the run")
    layout = json.loads(layout_json([ViewerPanel("y", (port,), (-0.1, 1e-9))]))
    assert curves(layout) == (["/c0.y"], [-0.1, 1e-9])


def test_a_run_without_outputs_has_a_layout_without_panels():
    """There is nothing to show."""
    layout = json.loads(layout_json(output_panels(channels_of(Interface((Signal("u"),))))))
    assert layout["configById"] == {}
    assert "layout" not in layout
