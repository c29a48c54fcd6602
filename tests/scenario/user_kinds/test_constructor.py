"""The parameters of a user's class: from the table, by name and annotation, and nothing else."""

import re
from dataclasses import dataclass

import pytest

import cosim
from cosim.errors import ScenarioError, UsageError
from cosim.scenario.kinds.user_code import UserClass
from cosim.scenario.kinds.user_component import construct
from tests.scenario.refusals import check_refused
from tests.scenario.user_modules import one, own_module, write

TAKEN = """
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.core import Interface, Signal

class Own:
    def __init__(self, *args, {parameter} = {default}, **kwargs):
        {name} = {name}
        self.value = {name}
        self.interface = Interface((Signal("u"),), (Signal("y"),))
        text = repr(self.value) if not isinstance(self.value, np.ndarray) else (
            f"{{self.value.dtype}} {{self.value.shape}} {{self.value.tolist()}}"
        )
        raise ValueError(text)
"""


def taken(folder, parameter, value, default="None"):
    """Return what a constructor gets, or what is said of the table."""
    name = parameter.partition(":")[0]
    write(folder, own=TAKEN.format(parameter=parameter, name=name, default=default))
    with pytest.raises(ScenarioError) as error:
        cosim.run(one(folder, f"{name} = {value}"))
    text = str(error.value)
    _, _, raised = text.partition("raised ValueError: ")
    return raised.partition(" (")[0] if raised else text


TAKEN_AS = [
    ("float", "1", "1.0"),
    ("float", "2.5", "2.5"),
    ("int", "3", "3"),
    ("bool", "true", "True"),
    ("str", '"a"', "'a'"),
    ('Literal["a", "b"]', '"b"', "'b'"),
    ("float | None", "1", "1.0"),
    ("list[float]", "[1, 2.5]", "[1.0, 2.5]"),
    ("tuple[int, ...]", "[1, 2]", "(1, 2)"),
    ("list[list[float]] | None", "[[1], [2, 3]]", "[[1.0], [2.0, 3.0]]"),
    ('"list[float]"', "[1]", "[1.0]"),
]


def test_a_parameter_gets_what_its_annotation_says(tmp_path):
    """Whole numbers are numbers; nothing else is converted."""
    results = [(a, v, taken(tmp_path, f"a: {a}", v)) for a, v, _ in TAKEN_AS]
    assert results == TAKEN_AS


def test_an_array_is_one_of_float64(tmp_path):
    """Of one axis, or of two."""
    for annotation in ("np.ndarray", "NDArray[np.float64]", "Vector", "Matrix"):
        for value in ("[1, 2]", "[[1, 2], [3, 4]]"):
            text = taken(tmp_path, f"a: {annotation} | None", value)
            assert text.startswith("float64"), annotation


def test_the_names_that_pydantic_has_may_be_parameters(tmp_path):
    """Also those with an underscore in front."""
    for name in ("model_config", "json", "copy", "build", "ports", "_x", "field_0", "name"):
        assert taken(tmp_path, f"{name}: float", "1") == "1.0"


OF_ANOTHER_TYPE = [
    ("float", '"1"', r"expected a number, got '1'"),
    ("float", "true", r"expected a number, got True"),
    ("float", "nan", r"expected a finite number, got nan"),
    ("int", "1.0", r"expected a whole number, got 1\.0"),
    ("int", "true", r"expected a whole number, got True"),
    ("bool", "1", r"expected true or false, got 1"),
    ("str", "1", r"expected a string, got 1"),
    ('Literal["on", "off"]', '"of"', r"'of'; did you mean 'off'\? Available: on, off"),
    ("list[float]", "1.0", r"expected a list, got 1\.0"),
    ("np.ndarray", '"a"', r"expected a list, got 'a'"),
    ("np.ndarray", "[[1, 2], [3]]", r"rows: .*\[2, 1\]"),
]


def test_a_value_of_another_type_is_refused_at_its_line(tmp_path):
    """With what is expected there."""
    for annotation, value, pattern in OF_ANOTHER_TYPE:
        text = taken(tmp_path, f"a: {annotation}", value)
        assert re.fullmatch(rf"one\.toml:13: components\.own\.a: .*{pattern}.*", text)


CONSTRUCTORS = [
    (", a", r"the parameter 'a' of 'own:Own' has no annotation"),
    (", a: float, /", r"the parameter 'a' of 'own:Own' is positional-only"),
    (", unit: str = ''", r"the parameter 'unit' of 'own:Own' has a reserved name"),
    (", a: dict[str, float]", r"'a' of 'own:Own' .*dict\[str, float\]; expected float, int,"),
    (", a: np.ndarray[tuple[int], np.dtype[np.int64]]", r"'own:Own' .*int64\]\]; expected float"),
    (", a: tuple[float, float]", r"'a' of 'own:Own' .*tuple\[float, float\]; expected float"),
    (", a: 'Flaot'", r"'own:Own' .*NameError: name 'Flaot' is not defined"),
]


def test_a_constructor_that_cannot_be_served_is_refused(tmp_path):
    """At the line of the class."""

    def run(parameters):
        own_module(tmp_path, parameters)
        cosim.run(one(tmp_path))

    place = r"one\.toml:12: components\.own\.class: .*"
    check_refused([(case, place + text) for case, text in CONSTRUCTORS], run, ScenarioError)


def test_unknown_and_missing_parameters_are_told_together(tmp_path):
    """With what is available, and what is expected."""
    own_module(tmp_path, ", width: float, rows: list[list[float]], size: int = 1")
    with pytest.raises(ScenarioError) as error:
        cosim.run(one(tmp_path, "size = 1.5\nnoise = 1"))
    assert sorted(str(error.value).splitlines()) == [
        "one.toml:10: components.own: 'rows' is missing (list[list[float]])",
        "one.toml:10: components.own: 'width' is missing (float)",
        "one.toml:13: components.own.size: expected a whole number, got 1.5",
        "one.toml:14: components.own.noise: unknown key 'noise'; available: rows, size, width",
    ]


@dataclass
class Kept:
    gain: "float"
    offset: "float" = 1.0

    def __post_init__(self):
        raise ValueError(f"{self.gain} and {self.offset}")


def test_a_dataclass_with_deferred_annotations_takes_its_fields():
    with pytest.raises(UsageError, match=r"the constructor of 'own:Kept' .*: 3\.0 and 1\.0 "):
        construct("own", UserClass("own:Kept", Kept, {}, ()), {"gain": 3})


def test_an_edit_of_a_parameter_is_named_as_the_place(tmp_path):
    own_module(tmp_path, ", width: float")
    with pytest.raises(ScenarioError) as error:
        cosim.run(one(tmp_path), set={"own.width": "x"})
    assert str(error.value) == ("set['own.width']: expected a number, got 'x'")
