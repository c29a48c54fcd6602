"""Estimates are compared with what they should equal, in one unit."""

import pytest

import cosim
from cosim.errors import ScenarioError
from cosim.report.plots import plot_run
from cosim.report.summary import summarize
from cosim.scenario.build import parse
from cosim.scenario.document import Document

ROOM = """
[scenario]
name = "room"
stop = 1.0
step = 0.01
[components.room]
kind = "constant"
value = 20.0
unit = "degC"
[components.sensor]
kind = "sum"
signs = [1.0]
unit = "{unit}"
[connections]
"sensor.u1" = {{ from = "room.y", unit = "{unit}", gain = {gain} }}
[truth]
"sensor.y" = "{truth}"
"""


def room(folder, **given):
    text = ROOM.format(**{"unit": "K", "gain": 1.0, "truth": "room.y"} | given)
    return parse(Document(text.replace(', unit = "K", gain = 1.0', ""), "room", folder))


def test_a_truth_is_compared_in_the_unit_of_the_estimate(tmp_path):
    """20 degC measured as 293.15 K is no error; the picture draws both in K."""
    run = cosim.run(room(tmp_path), out=tmp_path / "room.mcap")
    assert run["sensor.y"][-1] == 293.15
    (signal,) = summarize(run).signals
    assert (signal.largest, signal.rms, signal.last) == (0.0, 0.0, 0.0)
    plot_run(run, tmp_path / "room.png")


def test_a_truth_of_another_kind_is_refused(tmp_path):
    text = (
        r"truth\.sensor\.y: 'sensor\.y' has unit 'm', its truth 'room\.y' has unit 'degC'; "
        "needed units of one kind"
    )
    with pytest.raises(ScenarioError, match=text):
        cosim.run(room(tmp_path, unit="m", gain=0.5))
