"""Edits from outside: which table a key is in, elements of lists, values of the command line."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

import cosim
from cosim.errors import ScenarioError, UsageError
from cosim.scenario.document.document import component_in, parse_values, parts_of, short
from cosim.scenario.document.places import written
from tests.scenario.refusals import check_refused

THETA = [-0.1, -0.3]
ACTED = """
scenario = { name = "x", stop = 1.0, step = 0.5 }
components = { u = { kind = "constant", value = 1.0 } }
actions = [{ at = 0.5, set = { "u.value" = 3.0 } }]
"""


def loaded(folder, text):
    """Load a scenario of a text."""
    path = folder / "x.toml"
    path.write_text(text)
    return cosim.load(path)


@pytest.fixture
def academic():
    return cosim.load("academic")


def tree(scenario):
    return scenario.document.tables().tree


# --- keys ---


def test_a_swap_names_its_component_in_both_forms(tmp_path):
    """``components.load`` is ``load``; once each."""
    cosim.run("pair", set={"scenario.stop": 0.01}, out=tmp_path / "pair.mcap")
    log = str(tmp_path / "pair.mcap")
    edited = cosim.load("pair").edit(swap={"components.load": log})
    assert list(edited.document.tables().replaced) == ["load"]
    with pytest.raises(UsageError, match=r"load.*once"):
        cosim.load("pair").edit(swap={"components.load": log, "load": log})


@pytest.mark.parametrize("key", ["u.value", "components.u.value"])
def test_an_action_sets_a_component_in_both_forms(tmp_path, key):
    """Keys of an action are those of components alone, also in an edit of it."""
    text = ACTED.replace("u.value", key)
    assert cosim.run(loaded(tmp_path, text))["u.y"].tolist() == [1.0, 1.0, 3.0]  # behind the step
    edited = cosim.run(loaded(tmp_path, ACTED), set={f"actions[0].set.{key}": 4.0})
    assert edited["u.y"][-1] == 4.0


@pytest.mark.parametrize(
    ("key", "shortest", "component"),
    [
        ("components.motor.J", "motor.J", "motor"),
        ("motor.J", "motor.J", "motor"),
        ("record.every", "record.every", None),
        ("actions[0].at", "actions.0.at", None),
    ],
)
def test_the_form_of_a_key_is_one(key, shortest, component):
    """However it was written; a second time changes nothing."""
    assert short(key) == short(short(key)) == shortest
    assert component_in(shortest) == component


NAMES = st.text("abcxyz_-", min_size=1, max_size=4)
PARTS = st.tuples(NAMES, st.lists(st.integers(0, 99), max_size=3))


@given(st.lists(PARTS, min_size=1, max_size=4))
def test_keys_are_read_as_they_are_written(parts):
    """Names and indices come back, and the parts_of has each as a part."""
    key = []
    for name, indices in parts:
        key += [name, *indices]
    assert parts_of(written(tuple(key))) == list(map(str, key))


# --- elements ---


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
    before, after = tree(academic)["components"], tree(edited)["components"]
    assert [term["theta"] for term in after["delta"]["terms"]] == [-0.2, -0.3]
    assert after["plant"]["x_a0"] == [1.0, 0.5]
    assert tree(edited)["models"]["academic"]["A"] == [[0, 1, 1], [0, -2, 7.0], [1, 0, 1]]
    first = before["regressor"]["terms"][0]
    assert after["regressor"]["terms"] == [first, {"family": "exponential"}]
    assert [term["theta"] for term in before["delta"]["terms"]] == THETA
    assert edited.specs["delta"].terms[0].theta == -0.2


def test_the_later_edit_wins(academic):
    """A list that is set after its element takes the place of both, and the other way round."""
    first = academic.set({"plant.x_a0[1]": 0.5, "plant.x_a0": [3.0, 4.0]})
    assert first.specs["plant"].x_a0 == (3.0, 4.0)
    assert first.set({"plant.x_a0[1]": 0.5}).specs["plant"].x_a0 == (3.0, 0.5)
    again = academic.set({"plant.x_a0": [1.0, 2.0]}).set({"plant.x_a0[0]": 9.0})
    assert again.set({"plant.x_a0": [5.0, 6.0]}).specs["plant"].x_a0 == (5.0, 6.0)


UNKNOWN = [
    ("delta.terms[2].theta", r"\Aset.*\]: components\.delta\.terms .*'2'; available: 0 to 1\Z"),
    ("delta.terms[-1].theta", r"components\.delta\.terms .*'-1'; available: 0 to 1"),
    ("plant.x_a0[0:2]", r"components\.plant\.x_a0 .*'0:2'; available: 0 to 1"),
    ("plant.x_a0[01]", r"components\.plant\.x_a0 .*'01'; available: 0 to 1"),
    ("plant.x_a0[]", r"components\.plant\.x_a0 .*''; available: 0 to 1"),
    ("plant.x_a0[" + 5000 * "1" + "]", r"'1+\.\.\.1+'; available: 0 to 1"),
    ("models.academic.A[0][3]", r"models\.academic\.A\[0\] .*'3'; available: 0 to 2"),
    ("models.academic.A[0][0][0]", r"models\.academic\.A\[0\]\[0\]: expected a list, got 0"),
    ("observer.filter_rate[0]", r"components\.observer\.filter_rate: expected a list, got 1000\.0"),
    ("plant.x0[0]", r"components\.plant\.x0 is not given, so element 0 cannot be set"),
    ("plant.x_a0[0].x", r"components\.plant\.x_a0\[0\]: expected a table, got 1\.0"),
    ("delta.terms[0].teta", r"set\['delta\.terms\[0\]\.teta'\]: unknown key"),
    ("plant.x_a0[1]", r"set\['plant\.x_a0\[1\]'\]: expected a number, got 'a'"),
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


# --- values of the command line ---

VALUES = {
    "1e3,1e6": [1e3, 1e6],
    "1": [1],
    "[0,2,4],[0,2]": [[0, 2, 4], [0, 2]],
    "{a=1,b=[2,3]},4": [{"a": 1, "b": [2, 3]}, 4],
    "'a,b',\"c,]\",d": ["a,b", "c,]", "d"],
    "abs(min(u.y,2)),3": ["abs(min(u.y,2))", 3],
    "a], b": ["a]", "b"],
}


def test_values_are_split_at_their_own_commas():
    """Not at those inside lists, tables, calls and strings; none is empty."""
    assert {text: parse_values(text) for text in VALUES} == VALUES
    with pytest.raises(UsageError, match="'1,,2'"):
        parse_values("1,,2")


def test_the_element_that_is_wrong_is_named_where_a_list_may_be_of_several_types(
    tmp_path, academic
):
    """It is the first behind those that fit; where none fits, all types are."""
    text = academic.document.text
    for value, message in (
        ('[1.0, "a"]', r"theta\[1\]: expected a number, got 'a'"),
        ('["plant.y", 1.0]', r"theta\[1\]: expected a string, got 1\.0"),
        ("[true]", r"theta\[0\]: expected a string or a number, got True"),
    ):
        path = tmp_path / "truth.toml"
        path.write_text(re.sub(r"(identifier\.theta\W+=).*", rf"\1 {value}", text))
        with pytest.raises(ScenarioError, match=message):
            cosim.load(path)
