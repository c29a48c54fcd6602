"""The catalog of what a scenario can be made of."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

import cosim
from cosim.native.numerics.expression import FUNCTIONS
from cosim.report.tables.catalog import print_catalog, print_kind
from cosim.scenario.document.schema import ModelTable, Settings
from cosim.scenario.kinds import KINDS


@pytest.mark.parametrize(("entry", "table"), [("settings", Settings), ("models", ModelTable)])
def test_every_key_of_a_scenario_stands_in_the_catalog_with_its_meaning(entry, table, capsys):
    """As text and as JSON, and none is without a meaning."""
    print_catalog(as_json=True)
    keys = json.loads(capsys.readouterr().out)[entry]
    assert {key.partition(".")[0] for key in keys} == set(table.model_fields)
    assert {"substeps.rtol", "substeps.atol", "substeps.min"} <= keys.keys() or table is ModelTable
    assert all(key["description"] for key in keys.values())
    print_catalog(as_json=False)
    lines = capsys.readouterr().out.splitlines()
    for name in table.model_fields:
        assert any(line.split()[0] == name for line in lines if line.strip())


@pytest.mark.parametrize("name", ["start_time", "coupling", "input_interpolation"])
def test_readme_names_the_keys_that_change_results(name):
    """Beside those that its scenarios have; on its first page or one of the others."""
    root = Path(cosim.__file__).parents[1]
    pages = [root / "README.md", *(root / ".readme").glob("*.md")]
    assert any(re.search(f"`{name}[` ]", page.read_text(encoding="utf-8")) for page in pages)


def test_kinds_say_their_ports_and_expressions_their_functions(capsys):
    """In the list, and where a kind is explained."""
    print_catalog(as_json=False)
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("sum\tu1, u2, ... -> y\t") for line in lines)
    print_kind("expression", as_json=False)
    text = capsys.readouterr().out
    assert "ports: [u1], [u2], ... -> y" in text
    assert all(f" {name}" in text for name in FUNCTIONS)


def test_kinds_mark_what_may_be_set_in_a_run(capsys):
    print_kind("pid", as_json=False)
    lines = [line.split("\t") for line in capsys.readouterr().out.splitlines()]
    assert ["parameter", "default", "in a run", "meaning"] in lines
    rows = {line[0]: line[2] for line in lines[3:]}
    assert rows["gain"] == rows["upper"] == "tunable"
    assert rows["period"] == rows["initial_integral"] == ""
    print_kind("delay", as_json=False)
    assert "parameter\tdefault\tmeaning" in capsys.readouterr().out.splitlines()
    print_kind("fmu", as_json=False)
    assert "tunable: parameters that the FMU declares tunable" in capsys.readouterr().out
    print_kind("lag", as_json=True)
    shown = json.loads(capsys.readouterr().out)
    assert (shown["ports"], shown["tunable"]) == ("u -> y", ["time_constant"])


def test_every_tunable_key_is_a_key_of_its_kind():
    unknown = {name: set(kind.tunable) - set(kind.model_fields) for name, kind in KINDS.items()}
    assert not any(unknown.values()), unknown


@pytest.mark.slow
def test_a_list_needs_no_numerical_library_but_numpy():
    """It is what people call most often, and should not take a second."""
    code = (
        "import sys\n"
        "from cosim.report.tables.catalog import print_catalog\n"
        "print_catalog(as_json=False)\n"
        "print([name for name in ('scipy', 'mcap', 'fmpy') if name in sys.modules])\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.splitlines()[-1] == "[]"
