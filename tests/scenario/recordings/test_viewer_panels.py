"""What the layout for viewers shows of scenarios."""

from __future__ import annotations

import json

import pytest

import cosim
from cosim.log.contents.viewer_layout import LAYOUT_FILE
from cosim.scenario.document.document import find, shipped
from tests.log.contents.viewing import curves, decoded, leaves, parsed

DECAY = """
[scenario]
name = "decay"
stop = 0.1
step = 0.01

[components.u]
kind = "sine"
amplitude = 1.0
rate = 1.0
unit = "N"

[components.lag]
kind = "lag"
time_constant = 0.1
unit = { u = "N", y = "N" }

[components.count]
kind = "constant"
value = 3.0

[connections]
"lag.u" = "u.y"
"""


def panels(layout):
    """Return the labels of the curves by the title of the panel."""
    found = {}
    for config in layout["configById"].values():
        found[config["lichtblickPanelTitle"]] = [curve["label"] for curve in config["paths"]]
    return found


@pytest.mark.fast("pair", "academic")
@pytest.mark.parametrize("name", shipped())
def test_every_path_of_the_layout_leads_to_values_of_its_log(name, tmp_path):
    """Topic and field are in the decoded messages, as many values as the topic has messages."""
    log = cosim.run(name, out=tmp_path / "a.mcap", set={"scenario.stop": 0.1})
    layout = json.loads(log.attachment(LAYOUT_FILE))
    values = decoded(tmp_path / "a.mcap")
    paths, _ = curves(layout)
    assert paths
    for path in paths:
        assert len(values[parsed(path)]) >= 1
    assert sorted(leaves(layout["layout"])) == sorted(layout["configById"])


def test_estimates_are_shown_beside_their_truth():
    """Measured outputs, then every estimate with the signal or the levels that it should have."""
    run = cosim.run("academic", set={"scenario.stop": 0.1})
    layout = json.loads(run.attachment(LAYOUT_FILE))
    assert panels(layout) == {
        "measured outputs": ["plant.y"],
        "observer.x_a": [
            "observer.x_a[0]",
            "observer.x_a[1]",
            "plant.x_a[0]",
            "plant.x_a[1]",
        ],
        "observer.delta": ["observer.delta", "delta.y"],
        "identifier.theta": ["identifier.theta[0]", "identifier.theta[1]", "-0.1", "-0.3"],
    }
    assert curves(layout)[1] == [-0.1, -0.3]


def academic(path, truth):
    """Write the shipped example with another table of truths; return its path."""
    text, _, _ = find("academic").text.partition("[truth]")
    path.write_text(f"{text}\n[truth]\n{truth}\n")
    return path


def test_estimates_are_shown_without_their_truth_too(tmp_path):
    """Those of disturbance and parameters; of others there would be too many."""
    run = cosim.run(academic(tmp_path / "x.toml", ""), set={"scenario.stop": 0.1})
    layout = json.loads(run.attachment(LAYOUT_FILE))
    assert panels(layout) == {
        "measured outputs": ["plant.y"],
        "observer.delta": ["observer.delta"],
        "identifier.theta": ["identifier.theta[0]", "identifier.theta[1]"],
    }


def test_a_truth_of_one_element_takes_the_place_of_its_signal(tmp_path):
    """There are no two panels of one estimate."""
    path = academic(tmp_path / "x.toml", '"identifier.theta[1]" = -0.3')
    run = cosim.run(path, set={"scenario.stop": 0.1})
    layout = json.loads(run.attachment(LAYOUT_FILE))
    assert panels(layout) == {
        "measured outputs": ["plant.y"],
        "identifier.theta[1]": ["identifier.theta[1]", "-0.3"],
        "observer.delta": ["observer.delta"],
    }


def test_a_run_without_estimates_shows_its_outputs(tmp_path):
    """By their units, and those without by component."""
    path = tmp_path / "decay.toml"
    path.write_text(DECAY)
    layout = json.loads(cosim.run(path).attachment(LAYOUT_FILE))
    assert panels(layout) == {"[N]": ["u.y [N]", "lag.y [N]"], "count": ["count.y"]}
