"""The catalog of what a scenario can be made of."""

import json
import re

import pytest

from cosim.native.numerics.expression import FUNCTIONS
from cosim.scenario.document.document import shipped
from cosim.scenario.document.schema import ActionTable, ModelTable, RecordTable, Settings
from cosim.scenario.kinds import KINDS

TABLES = {
    "settings": Settings,
    "models": ModelTable,
    "actions": ActionTable,
    "record": RecordTable,
}


@pytest.fixture
def listed(call):
    """Return what ``cosim list`` prints: lines, or the content of its JSON."""

    def listed(*arguments):
        code, out, err = call("list", *arguments)
        assert (code, err) == (0, "")
        return json.loads(out) if "--json" in arguments else out.splitlines()

    return listed


def test_everything_that_can_stand_in_a_scenario_is_listed(listed):
    """Scenarios, kinds and the keys of every table with their meanings, as text and as JSON."""
    found = listed("--json")
    firsts = {line.split("\t")[0] for line in listed()}
    assert set(found["scenarios"]) == set(shipped())
    assert set(found["kinds"]) == set(KINDS)
    assert set(found["scenarios"]) | set(found["kinds"]) <= firsts
    for entry, table in TABLES.items():
        assert {key.partition(".")[0] for key in found[entry]} == set(table.model_fields)
        assert all(key["description"] for key in found[entry].values())
        assert set(found[entry]) <= firsts
    assert {"substeps.rtol", "substeps.atol", "substeps.min"} <= found["settings"].keys()


def test_a_kind_is_explained_with_default_meaning_and_unit(listed):
    """Of every parameter, keys of inner tables too; an expression has its functions."""
    first, *lines = listed("identifier")
    assert first.startswith("identifier: Identification of theta by output error")
    rows = {line.split("\t")[0]: line for line in lines}
    assert re.match(r"P0\toptional\tleast-squares: .*P\(0\) = P0 I", rows["P0"])
    assert re.match(r"start\.epsilon_filter\trequired\t.*in \(0, 1\)", rows["start.epsilon_filter"])
    assert any(line.startswith('time\t"t"\tcolumn of the times') for line in listed("table"))
    time, after = (listed("step", "--json")["parameters"][name] for name in ("time", "after"))
    assert (time["description"], after["default"]) == ("time of the jump [s]", 1.0)
    text = "\n".join(listed("expression"))
    assert "ports: [u1], [u2], ... -> y" in text
    assert all(f" {name}" in text for name in FUNCTIONS)
