"""The parameters of a user's class: from the table, by name and annotation, and nothing else."""

import numpy as np
import pytest

import cosim
from cosim.errors import ScenarioError
from tests.scenario.user_modules import one, own_module, write

TAKEN = """
import sys
from collections.abc import Sequence
from typing import Literal, Optional

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


@pytest.mark.parametrize(
    ("annotation", "value", "expected"),
    [
        ("float", "1", "1.0"),
        ("float", "2.5", "2.5"),
        ("int", "3", "3"),
        ("bool", "true", "True"),
        ("str", '"a"', "'a'"),
        ('Literal["a", "b"]', '"b"', "'b'"),
        ("float | None", "1", "1.0"),
        ("Optional[int]", "1", "1"),
        ("list[float]", "[1, 2.5]", "[1.0, 2.5]"),
        ("Sequence[str]", '["a"]', "('a',)"),
        ("tuple[int, ...]", "[1, 2]", "(1, 2)"),
        ("list[list[float]] | None", "[[1], [2, 3]]", "[[1.0], [2.0, 3.0]]"),
        ('"list[float]"', "[1]", "[1.0]"),
    ],
)
def test_a_parameter_gets_what_its_annotation_says(tmp_path, annotation, value, expected):
    """Whole numbers are numbers; nothing else is converted."""
    assert taken(tmp_path, f"a: {annotation}", value) == expected


@pytest.mark.parametrize("annotation", ["np.ndarray", "NDArray[np.float64]", "Vector", "Matrix"])
def test_an_array_is_one_of_float64(tmp_path, annotation):
    """Of one axis, or of two."""
    for value, expected in (("[1, 2]", "float64"), ("[[1, 2], [3, 4]]", "float64")):
        text = taken(tmp_path, f"a: {annotation} | None", value)
        assert text.startswith(expected)


def test_the_names_that_pydantic_has_may_be_parameters(tmp_path):
    """Also those with an underscore in front."""
    for name in ("model_config", "json", "copy", "build", "ports", "_x", "field_0", "name"):
        assert taken(tmp_path, f"{name}: float", "1") == "1.0"


@pytest.mark.parametrize(
    ("annotation", "value", "expected"),
    [
        ("float", '"1"', "found '1'; needed a number"),
        ("float", "true", "found True; needed a number"),
        ("float", "nan", "found nan; needed a finite number"),
        ("int", "1.0", "found 1.0; needed a whole number"),
        ("int", "true", "found True; needed a whole number"),
        ("bool", "1", "found 1; needed true or false"),
        ("str", "1", "found 1; needed a string"),
        ('Literal["on", "off"]', '"of"', "found 'of'; did you mean 'off'? There is: on, off"),
        ("list[float]", "1.0", "found 1.0; needed a list of numbers"),
        ("np.ndarray", '"a"', "found 'a'; needed a list of numbers or a list of lists of numbers"),
    ],
)
def test_a_value_of_another_type_is_refused_at_its_line(tmp_path, annotation, value, expected):
    text = taken(tmp_path, f"a: {annotation}", value)
    assert text == f"one.toml:13: components.own.a: {expected}"


def test_rows_of_different_lengths_are_refused(tmp_path):
    assert taken(tmp_path, "a: np.ndarray", "[[1, 2], [3]]") == (
        "one.toml:13: components.own.a: rows: found rows of lengths [2, 1], needed rows of one "
        "length, like [[0, 1], [2, 3]]"
    )


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        (
            ", a",
            "the parameter 'a' of 'own:Own' has no annotation; needed one, such as a: float",
        ),
        (
            ", a: float, /",
            "the parameter 'a' of 'own:Own' is positional only; needed one that a name can be "
            "given to",
        ),
        (
            ", unit: str = ''",
            "the parameter 'unit' of 'own:Own' has the name of a key that every table has; needed "
            "another name",
        ),
        (
            ", a: dict[str, float]",
            "the parameter 'a' of 'own:Own' has the annotation dict[str, float]; needed float, "
            "int, bool, str, Literal, a list, Sequence or tuple[T, ...] of these, a numpy array of "
            "float64, or alternatives of them",
        ),
        (
            ", a: np.ndarray[tuple[int], np.dtype[np.int64]]",
            "the parameter 'a' of 'own:Own' has the annotation numpy.ndarray[tuple[int], "
            "numpy.dtype[numpy.int64]]; needed float",
        ),
        (
            ", a: tuple[float, float]",
            "the parameter 'a' of 'own:Own' has the annotation tuple[float, float]; needed float",
        ),
        (
            ", a: 'Flaot'",
            "the constructor of 'own:Own' cannot be read: NameError: name 'Flaot' is not defined",
        ),
    ],
)
def test_a_constructor_that_cannot_be_served_is_refused(tmp_path, parameters, text):
    """At the line of the class."""
    own_module(tmp_path, parameters)
    with pytest.raises(ScenarioError) as error:
        cosim.run(one(tmp_path))
    assert f"one.toml:12: components.own.class: {text}" in str(error.value)


def test_unknown_and_missing_parameters_are_told_together(tmp_path):
    """With what there is, and what is needed."""
    own_module(tmp_path, ", width: float, rows: list[list[float]], size: int = 1")
    with pytest.raises(ScenarioError) as error:
        cosim.run(one(tmp_path, "size = 1.5\nnoise = 1"))
    assert sorted(str(error.value).splitlines()) == [
        "one.toml:10: components.own: 'rows' is missing; needed a list of lists of numbers",
        "one.toml:10: components.own: 'width' is missing; needed a number",
        "one.toml:13: components.own.size: found 1.5; needed a whole number",
        "one.toml:14: components.own.noise: unknown key 'noise'; there is: rows, size, width",
    ]


def test_a_dataclass_with_deferred_annotations_takes_its_fields(tmp_path):
    write(
        tmp_path,
        own="""
            from __future__ import annotations
            from dataclasses import dataclass
            import numpy as np
            from cosim.core import Interface, Signal

            @dataclass
            class Own:
                gain: float
                offset: float = 1.0

                @property
                def interface(self):
                    return Interface((Signal("u"),), (Signal("y"),), feedthrough={"y": ("u",)})

                def initialize(self, t, u):
                    return self.outputs(t, u)

                def outputs(self, t, u):
                    return self.gain * u + self.offset

                def advance(self, t, h, u):
                    return self.gain * u[1:] + self.offset
        """,
    )
    run = cosim.run(one(tmp_path, "gain = 3"))
    np.testing.assert_array_equal(run["own.y"], 3.0 * run["u.y"] + 1.0)


def test_an_edit_of_a_parameter_is_named_as_the_place(tmp_path):
    own_module(tmp_path, ", width: float")
    with pytest.raises(ScenarioError) as error:
        cosim.run(one(tmp_path), set={"own.width": "x"})
    assert str(error.value) == (
        "set['own.width']: components.own.width: found 'x'; needed a number"
    )
