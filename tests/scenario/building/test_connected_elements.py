"""Elements of an input are connected one by one in a scenario, and its components swapped."""

import pytest

import cosim
from cosim.errors import ScenarioError
from tests.scenario.refusals import check_refused

SCENARIO = """
scenario = { name = "plant", stop = 0.3, step = 0.05 }
[components]
a = { kind = "sine", amplitude = 1.0, rate = 3.0 }
b = { kind = "step", time = 0.1, before = 1.0, after = 4.0 }
meter = { kind = "gain", K = 2.0 }
plant = { kind = "controller", A = [[-1.0]], B = [[1.0, 2.0]], C = [[1.0]] }
[connections]
"plant.u[1]" = "b.y"
"plant.u[0]" = "a.y"
"meter.u" = "plant.y"
"""


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "plant.toml"
    path.write_text(SCENARIO)
    return path


def stacked(path):
    text = path.read_text().replace('"plant.u[1]" = "b.y"\n', "")
    copy = path.with_name("stacked.toml")
    copy.write_text(text.replace('"plant.u[0]" = "a.y"', '"plant.u" = ["a.y", "b.y"]'))
    return copy


@pytest.mark.parametrize("interpolation", ["linear", "zero-order"])
def test_the_run_is_that_of_a_stack(path, tmp_path, interpolation):
    """The same content hash, whatever the interpolation; each element is held or not by itself."""
    options = {"set": {"scenario.input_interpolation": interpolation}}
    one = cosim.run(path, out=tmp_path / "one.mcap", **options)
    both = cosim.run(stacked(path), out=tmp_path / "both.mcap", **options)
    assert one.content_hash() == both.content_hash()
    held = [False, True] if interpolation == "linear" else [True, True]
    assert one.held["plant"].tolist() == held


def test_wrong_elements_are_named(path):
    """With the line or the option that they come from."""
    cases = [
        (
            {"connections.plant.u": "a.y"},
            r"set\['connections\.plant\.u'\]: a\.y -> plant\.u: .*size 1"
            r".*'plant\.u\[0\]', 'plant\.u\[1\]'",
        ),
        (
            {"connections.plant.u[2]": "a.y"},
            r"set\['connections\.plant\.u\[2\]'\]: 'plant\.u\[2\]'",
        ),
        (
            {"plant.B": [[1.0, 2.0, 3.0]]},
            r"plant\.toml:10: connections\.plant\.u\[0\]: 'plant\.u\[2\]' is not connected",
        ),
    ]
    check_refused(cases, lambda change: cosim.run(path, set=change), ScenarioError)
