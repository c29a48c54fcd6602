"""The catalog of what a scenario can be made of."""

import json
from pathlib import Path

import pytest

import cosim
from cosim.report.tables.catalog import print_catalog
from cosim.scenario.schema import Settings


def test_every_key_of_a_scenario_stands_in_the_catalog_with_its_meaning(capsys):
    """As text and as JSON, and none is without a meaning."""
    print_catalog(as_json=True)
    settings = json.loads(capsys.readouterr().out)["settings"]
    assert set(settings) == set(Settings.model_fields)
    assert all(entry["description"] for entry in settings.values())
    print_catalog(as_json=False)
    lines = capsys.readouterr().out.splitlines()
    for name in Settings.model_fields:
        assert any(line.split()[0] == name for line in lines if line.strip())


@pytest.mark.parametrize("name", ["start_time", "coupling", "input_interpolation"])
def test_readme_names_the_keys_that_change_results(name):
    """Beside those that its scenarios have."""
    assert f"`{name}`" in (Path(cosim.__file__).parents[1] / "README.md").read_text()
