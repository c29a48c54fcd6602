"""Keys of edits that reach into lists."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

import cosim
from cosim.errors import ScenarioError, UsageError
from cosim.scenario.document.document import parts_of
from cosim.scenario.document.places import written
from tests.scenario.refusals import check_refused

THETA = [-0.1, -0.3]
FMU = """
scenario = { name = "x", stop = 1.0, step = 0.1 }
[components]
plant = { kind = "fmu", path = "plant.fmu", start = { gains = [2.0, 0.5], level = 1.0 } }
"""


@pytest.fixture
def academic():
    return cosim.load("academic")


def tables(scenario):
    return scenario.document.tree()[0]


def test_an_element_of_a_list_is_set_alone(academic):
    """Of lists of tables, of numbers and of rows; the others stay."""
    edited = academic.set(
        {
            "delta.terms[0].theta": -0.2,
            "components.plant.x_a0[1]": 0.5,
            "models.academic.A[1][2]": 7.0,
            "regressor.terms[1]": {"family": "exponential"},
        }
    )
    before = tables(academic)
    after = tables(edited)
    assert [term["theta"] for term in after["components"]["delta"]["terms"]] == [-0.2, -0.3]
    assert after["components"]["plant"]["x_a0"] == [1.0, 0.5]
    assert after["models"]["academic"]["A"] == [[0, 1, 1], [0, -2, 7.0], [1, 0, 1]]
    assert after["components"]["regressor"]["terms"] == [
        before["components"]["regressor"]["terms"][0],
        {"family": "exponential"},
    ]
    assert [term["theta"] for term in before["components"]["delta"]["terms"]] == THETA
    assert edited.specs["delta"].terms[0].theta == -0.2
    assert edited.specs["plant"].x_a0 == (1.0, 0.5)


def test_the_later_edit_wins(academic):
    """A list that is set after its element takes the place of both, and the other way round."""
    first = academic.set({"plant.x_a0[1]": 0.5, "plant.x_a0": [3.0, 4.0]})
    assert first.specs["plant"].x_a0 == (3.0, 4.0)
    assert first.set({"plant.x_a0[1]": 0.5}).specs["plant"].x_a0 == (3.0, 0.5)
    again = academic.set({"plant.x_a0": [1.0, 2.0]}).set({"plant.x_a0[0]": 9.0})
    assert again.set({"plant.x_a0": [5.0, 6.0]}).specs["plant"].x_a0 == (5.0, 6.0)


@pytest.mark.slow
def test_a_run_with_an_element_set_is_that_of_the_file_with_it(tmp_path, academic):
    """Bit for bit, and so is its replay, with an element of its own."""
    end = {"scenario.stop": 0.05}
    by_key = cosim.run("academic", set={**end, "delta.terms[1].theta": -0.4, "plant.x_a0[0]": 2.0})
    terms = [dict(term) for term in tables(academic)["components"]["delta"]["terms"]]
    terms[1]["theta"] = -0.4
    whole = cosim.run("academic", set={**end, "delta.terms": terms, "plant.x_a0": [2.0, -1.0]})
    assert cosim.diff(by_key, whole).equal
    log = cosim.run("academic", set=end, out=tmp_path / "a.mcap")
    element = cosim.replay(log, set={"observer.x_a0[1]": 0.25})
    assert cosim.diff(element, cosim.replay(log, set={"observer.x_a0": [0.0, 0.25]})).equal
    assert element["observer.x_a"][0, 1] == 0.25


def test_the_command_line_takes_such_keys(call, tmp_path):
    """As --set of a run and of a replay."""
    run = ["run", "academic", "--stop", "0.02", "--quiet", "--out", "a.mcap"]
    assert call(*run, "--set", "plant.x_a0[1]=0.5")[0] == 0
    assert cosim.open_log(tmp_path / "a.mcap")["plant.x_a"][0, 1] == 0.5
    replay = ["replay", "a.mcap", "--quiet", "--out", "b.mcap"]
    assert call(*replay, "--set", "observer.x_a0[0]=0.5")[0] == 0
    assert cosim.open_log(tmp_path / "b.mcap")["observer.x_a"][0, 0] == 0.5
    code, _, err = call(*replay, "--force", "--set", "plant.x_a0[0]=0.5")
    assert code == 2
    assert "--set plant.x_a0[0]: 'plant' is taken from the recording" in err


UNKNOWN = [
    (
        "delta.terms[2].theta",
        r"\Aset\['delta\.terms\[2\]\.theta'\]: components\.delta\.terms .*'2'; available: 0 to 1\Z",
    ),
    ("delta.terms[-1].theta", r"components\.delta\.terms .*'-1'; available: 0 to 1"),
    ("plant.x_a0[0:2]", r"components\.plant\.x_a0 .*'0:2'; available: 0 to 1"),
    ("plant.x_a0[01]", r"components\.plant\.x_a0 .*'01'; available: 0 to 1"),
    ("plant.x_a0[]", r"components\.plant\.x_a0 .*''; available: 0 to 1"),
    ("plant.x_a0[" + 5000 * "1" + "]", r"'1+\.\.\.1+'; available: 0 to 1"),
    ("models.academic.A[0][3]", r"models\.academic\.A\[0\] .*'3'; available: 0 to 2"),
    ("models.academic.A[3][0]", r"models\.academic\.A .*'3'; available: 0 to 2"),
    ("models.academic.A[0][0][0]", r"models\.academic\.A\[0\]\[0\]: expected a list, got 0"),
    ("observer.filter_rate[0]", r"components\.observer\.filter_rate: expected a list, got 1000\.0"),
    ("plant.x0[0]", r"unknown key 'x0\[0\]'; did you mean 'x0'\?"),
    ("plant.x_a0[0].x", r"components\.plant\.x_a0\[0\]: expected a table, got 1\.0"),
    (
        "delta.terms[0].teta",
        r"set\['delta\.terms\[0\]\.teta'\]: unknown key",
    ),
    (
        "plant.x_a0[1]",
        r"set\['plant\.x_a0\[1\]'\]: expected a number, got 'a'",
    ),
    ("plnt.x_a0[1]", r"unknown component 'plnt'; did you mean 'plant'\?"),
    ("delta[0]", r"expected COMPONENT\.PARAMETER"),
    ("delta[0].theta", r"unknown component 'delta\[0\]'; did you mean 'delta'\?"),
]


def test_an_unknown_element_is_refused(academic):
    """The message names the list, and the indices that it has; an empty list has none."""
    check_refused(UNKNOWN, lambda key: academic.set({key: "a"}), ScenarioError)
    with pytest.raises(ScenarioError, match=r"plant\.x_a0 .*'0'; none is available"):
        academic.set({"plant.x_a0": [], "plant.x_a0[0]": 1.0})


def test_a_problem_with_the_whole_list_names_the_edit_of_its_element(academic):
    """What is wrong with all of it may be due to that."""
    message = r"academic:\d+ \(with set\['observer\.L\[0\]'\]\): .*Hurwitz"
    with pytest.raises(UsageError, match=message):
        cosim.run(academic.set({"observer.L[0]": -50.0}))


def test_names_of_ports_and_variables_stay_names(tmp_path):
    """An element of a connected input, and of a variable of an FMU that has a table of starts."""
    ports = cosim.load("academic").set({"connections.plant.u[0]": "u.y"})
    assert tables(ports)["connections"]["plant.u[0]"] == "u.y"
    path = tmp_path / "x.toml"
    path.write_text(FMU)
    scenario = cosim.load(path).set({"plant.start.x[1]": 2.0, "plant.start.gains[1]": 0.75})
    start = tables(scenario)["components"]["plant"]["start"]
    assert start == {"gains": [2.0, 0.75], "level": 1.0, "x[1]": 2.0}
    again = scenario.set({"plant.start.x[1]": 3.0, "plant.unit.y[0]": "m"})
    assert tables(again)["components"]["plant"]["start"]["x[1]"] == 3.0
    assert tables(again)["components"]["plant"]["unit"] == {"y[0]": "m"}
    with pytest.raises(ScenarioError, match=r"plant\.start\.level: expected a list, got 1\.0"):
        cosim.load(path).set({"plant.start.level[0]": 2.0})


def test_a_table_takes_the_place_of_one_value_for_all():
    """Units by port, where the file has one unit; so it is in logs of before."""
    edited = cosim.load("pair").set({"load.unit.y": "N.m"})
    assert tables(edited)["components"]["load"]["unit"] == {"y": "N.m"}


def test_a_part_that_an_edit_gives_twice_is_blamed_on_the_edit(tmp_path):
    """Whatever the parts of its key are in the file."""
    path = tmp_path / "x.toml"
    path.write_text(
        'scenario = { name = "x", stop = 1.0, step = 0.1 }\n'
        'actions = [{ at = 0.5, set = { "g.K" = 2.0 } }]\n'
        'components = { g = { kind = "gain", K = 1.0 }, u = { kind = "constant", value = 1.0 } }\n'
        'connections = { "g.u" = "u.y" }\n'
    )
    with pytest.raises(ScenarioError, match=r"set\['actions\[0\]\.set\.g'\]: .*given twice"):
        cosim.load(path).set({"actions[0].set.g": {"K": 3.0}})


def test_an_action_is_found_by_either_spelling(tmp_path):
    """``actions[0]`` is ``actions.0``; a replay refuses both."""
    path = tmp_path / "x.toml"
    path.write_text(
        'scenario = { name = "x", stop = 1.0, step = 0.1 }\n'
        'actions = [{ at = 0.5, signal = "x.u", override = 2.0 }]\n'
        '[components]\nx = { kind = "lag", time_constant = 1.0, initial = 0.0 }\n'
        'u = { kind = "constant", value = 1.0 }\n[connections]\n"x.u" = "u.y"\n'
    )
    scenario = cosim.load(path)
    edited = scenario.set({"actions[0].override": 3.0})
    assert edited.document.changes == {"actions.0.override": 3.0}
    assert edited.actions[0].override == 3.0
    with pytest.raises(ScenarioError, match=r"actions has no element '1'; available: 0 to 0"):
        scenario.set({"actions[1].override": 3.0})
    log = cosim.run(path, out=tmp_path / "x.mcap")
    with pytest.raises(UsageError, match="actions"):
        cosim.replay(log, set={"actions[0].override": 3.0})


NAMES = st.text("abcxyz_-", min_size=1, max_size=4)
PARTS = st.tuples(NAMES, st.lists(st.integers(0, 99), max_size=3))


@given(st.lists(PARTS, min_size=1, max_size=4))
def test_keys_are_read_as_they_are_written(parts):
    """Names and indices come back, and the parts_of has each as a part."""
    key = []
    for name, indices in parts:
        key += [name, *indices]
    assert parts_of(written(tuple(key))) == list(map(str, key))
