"""Which table of a scenario a dotted key is in."""

import pytest

import cosim
from cosim.errors import ScenarioError, UsageError
from cosim.scenario.document.document import component_in, short

TABLES = ["scenario", "models", "connections", "truth", "actions", "record", "swap", "components"]


@pytest.fixture
def tables(tmp_path):
    """Return a scenario with a component of the name of each table."""
    path = tmp_path / "tables.toml"
    components = [f'{name} = {{ kind = "constant", value = 1.0 }}' for name in TABLES]
    settings = 'scenario = { name = "tables", stop = 0.1, step = 0.1 }'
    path.write_text("\n".join([settings, "[components]", *components]))
    return cosim.load(path)


def final(scenario, changes):
    log = cosim.run(scenario, set=changes)
    return {name: log[f"{name}.y"][-1] for name in TABLES}


def test_a_long_key_is_that_of_a_component_whatever_its_name(tables):
    """Each one alone reaches its value."""
    values = dict(zip(TABLES, range(2, 10), strict=True))
    assert final(tables, {f"components.{name}.value": values[name] for name in TABLES}) == values


def test_a_short_key_is_in_the_table_where_that_has_the_key(tables):
    """[record] and [scenario] are set, and not the components of their names."""
    edited = tables.set({"record.every": 2, "scenario.stop": 0.4, "scenario.step": 0.2})
    assert edited.file.record.every == 2
    assert edited.file.scenario.stop == 0.4
    assert set(final(edited, {}).values()) == {1.0}


@pytest.mark.parametrize("name", TABLES[:-2])
def test_a_short_key_that_the_table_does_not_have_is_refused(tables, name):
    with pytest.raises(ScenarioError, match=rf"{name}(\.|\[)value"):
        cosim.run(tables, set={f"{name}.value": 5.0})


def test_a_swap_names_its_component_in_both_forms(tmp_path):
    """``components.load`` is ``load``; once each."""
    cosim.run("pair", set={"scenario.stop": 0.01}, out=tmp_path / "pair.mcap")
    log = str(tmp_path / "pair.mcap")
    edited = cosim.load("pair").edit(swap={"components.load": log})
    assert edited.document.swapped_components() == ["load"]
    with pytest.raises(UsageError, match=r"load.*once"):
        cosim.load("pair").edit(swap={"components.load": log, "load": log})


def test_a_study_varies_components_of_any_name(tables, tmp_path):
    """The grid of two components, one of them named like the prefix of a swap."""
    study = cosim.study(
        tables.document.source,
        vary={"components.record.value": [1.0, 2.0], "components.swap.value": [3.0, 4.0]},
        metrics={"sum": "last(record.y) + last(swap.y)"},
        out=tmp_path / "out",
    )
    assert study.table(["sum"])["sum"].to_pylist() == [4.0, 5.0, 5.0, 6.0]


def test_an_action_sets_a_component_in_both_forms(tmp_path):
    """Keys of an action are those of components alone."""
    text = """
    scenario = { name = "x", stop = 1.0, step = 0.5 }
    components = { u = { kind = "constant", value = 1.0 } }
    actions = [{ at = 0.5, set = { "KEY" = 3.0 } }]
    """
    for key in ("u.value", "components.u.value"):
        path = tmp_path / "x.toml"
        path.write_text(text.replace("KEY", key))
        assert cosim.run(path)["u.y"].tolist() == [1.0, 1.0, 3.0]  # behind the step


@pytest.mark.parametrize(
    ("key", "shortest", "component"),
    [
        ("components.motor.J", "motor.J", "motor"),
        ("motor.J", "motor.J", "motor"),
        ("components.record.every", "components.record.every", "record"),
        ("record.every", "record.every", None),
        ("actions[0].at", "actions.0.at", None),
    ],
)
def test_the_form_of_a_key_is_one(key, shortest, component):
    """However it was written; a second time changes nothing."""
    assert short(key) == short(short(key)) == shortest
    assert component_in(shortest) == component
