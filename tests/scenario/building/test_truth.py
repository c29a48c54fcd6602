"""Estimates are compared with what they should equal, in one unit."""

from dataclasses import replace

import pytest

import cosim
from cosim.errors import ScenarioError
from cosim.report.plots.runs import plot_run
from cosim.report.summary import summarize
from cosim.scenario.building.build import parse
from cosim.scenario.document.document import Document, find
from tests.scenario.refusals import check_refused

ROOM = """
scenario = {{ name = "room", stop = 1.0, step = 0.01 }}
[components]
room = {{ kind = "constant", value = 20.0, unit = "degC" }}
sensor = {{ kind = "sum", signs = [1.0], unit = "{unit}" }}
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
    text = r"truth\.sensor\.y: 'sensor\.y' .*'m', .*'room\.y' .*'degC'"
    with pytest.raises(ScenarioError, match=text):
        cosim.run(room(tmp_path, unit="m", gain=0.5))


def with_truth(entries, **changes):
    """Return 0.1 s of the academic scenario with other entries for the truth of x_a."""
    text = find("academic").text
    whole = '"observer.x_a" = "plant.x_a"'
    assert whole in text
    document = replace(find("academic"), text=text.replace(whole, entries))
    return parse(document.with_changes({"scenario.stop": 0.1, **changes}))


def test_elements_and_slices_are_compared_too(tmp_path):
    """On both sides; an element that is not there is named."""
    entries = '"observer.x_a[0]" = "plant.x_a[0]"\n"observer.x_a[0:2]" = "plant.x_a[0:2]"'
    run = cosim.run(with_truth(entries), out=tmp_path / "a.mcap")
    largest = {signal.estimate: signal.largest for signal in summarize(run).signals}
    error = abs(run["observer.x_a"] - run["plant.x_a"]).max(axis=0)
    assert largest["observer.x_a[0]"] == error[0]
    assert largest["observer.x_a[0:2]"] == error.max()
    with pytest.raises(ScenarioError, match=r"'plant\.x_a\[2\]': 'plant\.x_a' has 2 elements"):
        cosim.run(with_truth('"observer.x_a[0]" = "plant.x_a[2]"'))


def test_a_truth_may_be_stacked():
    """Ports in the order of the elements are compared as one signal would be."""
    stacked = cosim.run(with_truth('"observer.x_a" = ["plant.x_a[0]", "plant.x_a[1]"]'))
    whole = cosim.run(with_truth('"observer.x_a" = "plant.x_a"'))
    signal, *_ = summarize(stacked).signals
    assert signal.truth == "plant.x_a[0], plant.x_a[1]"
    assert replace(signal, truth="plant.x_a") == summarize(whole).signals[0]
    turned = cosim.run(with_truth('"observer.x_a" = ["plant.x_a[1]", "plant.x_a[0]"]'))
    last = abs(turned["observer.x_a"][-1] - turned["plant.x_a"][-1, ::-1]).max()
    assert summarize(turned).signals[0].last == last


def test_a_stacked_truth_is_checked(tmp_path):
    """Its size, its signals and the types of its entries."""
    text = find("academic").text
    scenario = tmp_path / "mine.toml"

    def run(truth):
        given = '"observer.x_a" = "plant.x_a"'
        scenario.write_text(text.replace(given, f'"observer.x_a" = {truth}'))
        cosim.run(scenario)

    cases = [
        ('["plant.x_a[0]"]', r"'observer\.x_a' has size 2, .*\['plant\.x_a\[0\]'\] has size 1"),
        ('["plant.x_a[0]", "plant.x_c"]', r"signal 'plant\.x_c'; did you mean 'plant\.x_b'"),
        ('["plant.x_a[0]", 1.0]', r"truth\.observer\.x_a.*: expected .* 1\.0\]?$"),
        ("[]", r"has size 2, .*\[\] has size 0"),
    ]
    check_refused(cases, run, ScenarioError)
