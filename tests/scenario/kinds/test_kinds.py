"""Kinds of scenario files: their table, and how to add one."""

import importlib.util
import sys
import textwrap
from typing import Literal

import pytest

import cosim
from cosim.blocks.sampled import Sampled
from cosim.errors import ScenarioError
from cosim.scenario import kinds
from cosim.scenario.building.build import parse
from cosim.scenario.document.document import Document
from cosim.scenario.kinds import KINDS
from cosim.scenario.kinds.base import PeriodicKind

DEAD = """
[scenario]
name = "dead"
stop = 1.0
step = 0.25

[components.u]
kind = "ramp"
slope = 1.0

[components.dead]
kind = "dead-zone"
width = {width}

[connections]
"dead.u" = "u.y"
"""


@pytest.fixture
def dead_zone(tmp_path, monkeypatch):
    """Add the example of the package's docstring to the kinds."""
    _, _, after = kinds.__doc__.partition("for example::\n")
    example, _, _ = after.partition("\nWith the class")
    path = tmp_path / "dead_zone.py"
    path.write_text(textwrap.dedent(example))
    spec = importlib.util.spec_from_file_location("dead_zone", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setitem(sys.modules, "cosim.scenario.kinds.dead_zone", module)
    monkeypatch.setitem(KINDS.homes, "dead-zone", "dead_zone.DeadZoneKind")


def dead(folder, width):
    return parse(Document(DEAD.format(width=width), "dead", folder))


def test_the_example_of_a_kind_runs(dead_zone, tmp_path):
    """With the entry that the docstring names, a file may use it, and a log replays."""
    log = cosim.run(dead(tmp_path, 0.5), out=tmp_path / "dead.mcap")
    assert log["dead.y"].tolist() == [0.0, 0.0, 0.0, 0.25, 0.5]
    assert cosim.diff(log, cosim.replay(tmp_path / "dead.mcap")).equal


def test_a_usage_error_of_the_example_is_a_problem_of_the_file(dead_zone, tmp_path):
    """With the line of the component; a missing key shows the description of its field."""
    with pytest.raises(ScenarioError) as error:
        cosim.run(dead(tmp_path, -1.0))
    assert "dead:11: components.dead: width: expected a number >= 0, got -1.0" in str(error.value)
    text = DEAD.replace("width = {width}", "")
    with pytest.raises(ScenarioError) as error:
        parse(Document(text, "dead", tmp_path))
    assert "'width' is missing (half the width of the zone" in str(error.value)


def test_every_kind_has_the_name_that_it_is_listed_under():
    for name, kind in KINDS.items():
        assert kind.model_fields["kind"].annotation == Literal[name]


def test_a_periodic_kind_must_say_how_its_period_is_kept():
    """Else it would accept ``period`` and ignore it."""

    class Forgetful(PeriodicKind):
        kind: Literal["forgetful"]

        def build(self, name, context):
            return KINDS["step"](kind="step", time=0.5).build(name, context)

    class Keeping(Forgetful):
        def with_period(self, component, n):
            return Sampled(component, n)

    with pytest.raises(TypeError, match="with_period"):
        Forgetful.model_validate({"kind": "forgetful", "period": 0.5})
    assert Keeping.model_validate({"kind": "forgetful", "period": 0.5}).period == 0.5


@pytest.mark.parametrize(
    ("table", "y"),
    [
        ('kind = "ramp"\nslope = 2.0\nstart_time = 0.5', [0.0, 0.0, 0.0, 0.5, 1.0]),
        ('kind = "table"\nt = [0.0, 0.5, 1.0]\ny = [0.0, 1.0, 3.0]', [0.0, 0.5, 1.0, 2.0, 3.0]),
        (
            'kind = "table"\nt = [0.0, 0.5, 1.0]\ny = [0.0, 1.0, 3.0]\n'
            'interpolation = "zero-order"',
            [0.0, 0.0, 1.0, 1.0, 3.0],
        ),
    ],
)
def test_a_source_begins_and_interpolates_as_its_table_says(tmp_path, table, y):
    text = f'[scenario]\nname = "u"\nstop = 1.0\nstep = 0.25\n[components.u]\n{table}\n'
    assert cosim.run(parse(Document(text, "u", tmp_path)))["u.y"].tolist() == y
