"""What the layout for viewers shows of scenarios."""

import json

import pytest

import cosim
from cosim.log.contents.viewer_layout import LAYOUT_FILE
from cosim.scenario.document.document import shipped
from tests.log.contents.viewing import curves, decoded, leaves, parsed

SHORT = {"scenario.stop": 0.1}


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
