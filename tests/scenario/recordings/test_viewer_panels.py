"""What the layout for viewers shows of scenarios."""

import json

import pytest

import cosim
from cosim.log.contents.viewer_layout import LAYOUT_FILE
from cosim.scenario.document.document import find, shipped
from tests.log.contents.viewing import curves, decoded, leaves, parsed

SHORT = {"scenario.stop": 0.1}


def panels(run):
    """Return the labels of the curves by the title of the panel."""
    layout = json.loads(run.attachment(LAYOUT_FILE))
    found = {}
    for config in layout["configById"].values():
        found[config["lichtblickPanelTitle"]] = [curve["label"] for curve in config["paths"]]
    return found


@pytest.mark.fast("pair", "academic")
@pytest.mark.parametrize("name", shipped())
def test_every_path_of_the_layout_leads_to_values_of_its_log(name, tmp_path):
    """Topic and field are in the decoded messages."""
    log = cosim.run(name, out=tmp_path / "a.mcap", set=SHORT)
    layout = json.loads(log.attachment(LAYOUT_FILE))
    values = decoded(tmp_path / "a.mcap")
    paths, _ = curves(layout)
    assert paths
    assert all(len(values[parsed(path)]) >= 1 for path in paths)
    assert sorted(leaves(layout["layout"])) == sorted(layout["configById"])


DELTA = {"observer.delta": ["observer.delta"]}
THETA = {"identifier.theta": ["identifier.theta[0]", "identifier.theta[1]"]}


@pytest.mark.parametrize(
    ("truth", "estimates"),
    [
        # of the others there would be too many
        ("", DELTA | THETA),
        # there are no two panels of one estimate
        (
            '"identifier.theta[1]" = -0.3',
            {"identifier.theta[1]": ["identifier.theta[1]", "-0.3"]} | DELTA,
        ),
        ('"observer.delta" = "delta.y"', {"observer.delta": ["observer.delta", "delta.y"]} | THETA),
    ],
)
def test_estimates_are_shown_beside_their_truth(tmp_path, truth, estimates):
    """Measured outputs, then estimates with the signal or the level that each should have."""
    text, _, _ = find("academic").text.partition("[truth]")
    path = tmp_path / "x.toml"
    path.write_text(f"{text}\n[truth]\n{truth}\n")
    run = cosim.run(path, set=SHORT)
    assert panels(run) == {"measured outputs": ["plant.y"]} | estimates
    levels = curves(json.loads(run.attachment(LAYOUT_FILE)))[1]
    assert levels == ([-0.3] if "-0.3" in truth else [])
