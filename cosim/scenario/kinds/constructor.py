"""The parameters of a user's class: its constructor's, by name and annotation, from a TOML table.

A parameter takes what its annotation says, and nothing that would have to be converted:

==================================================  ===========================================
``float``, ``int``, ``bool``, ``str``               a number, a whole number, true or false, a
                                                    string
``Literal["a", "b"]``                               one of these
``list[T]``, ``Sequence[T]``, ``tuple[T, ...]``     a list; of lists, where T is a list
``np.ndarray``, ``NDArray[np.float64]``, ``Vector``  a list of numbers, or rows: an array of
and ``Matrix`` of ``cosim.arrays``                  float64
``T | None``, ``T | U``                             any of these; a table leaves None out
==================================================  ===========================================

``*args`` and ``**kwargs`` get nothing. A parameter with a default may be left out.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Any, Final, Literal, Union, get_args, get_origin
from weakref import WeakKeyDictionary

import numpy as np
from pydantic import Field, StrictStr, ValidationError, create_model

from cosim.core.arguments import checked_components
from cosim.core.contracts import Component
from cosim.errors import CosimError, UsageError
from cosim.scenario.document.problems import TableProblems, problems_of
from cosim.scenario.document.schema import (
    Flag,
    Number,
    NumberRow,
    NumberRows,
    TomlTable,
    Whole,
    matrix,
)
from cosim.scenario.kinds.user_code import UserClass, in_words

_SCALARS: Final[Mapping[Any, Any]] = {float: Number, int: Whole, bool: Flag, str: StrictStr}
_SEQUENCES: Final = (list, tuple, Sequence)
_ANNOTATIONS: Final = (
    "float, int, bool, str, Literal, a list, Sequence or tuple[T, ...] of these, "
    "a numpy array of float64, or a union of them"
)


@dataclass(frozen=True, slots=True)
class _Constructor:
    """The constructor of a class.

    Parameters
    ----------
    names, annotations : mapping of field of the model to the name and annotation of a parameter
    model : type
        The table that has their values.
    """

    names: Mapping[str, str]
    annotations: Mapping[str, Any]
    model: type[TomlTable]


# making a model takes longer than many a run, and a study has a component of a class a member
_constructors: Final[WeakKeyDictionary[type, _Constructor]] = WeakKeyDictionary()


def construct(name: str, user_class: UserClass, table: Mapping[str, Any]) -> Component:
    """Return the component of a user's class.

    Parameters
    ----------
    name : str
        Of the component.
    user_class : UserClass
    table : mapping of key to value
        The parameters.

    Raises
    ------
    TableProblems
        If a parameter is unknown, missing or has a wrong value, or the constructor cannot be
        understood.
    UsageError
        If the constructor raises something, which is the cause, or makes no component.
    """
    arguments = _arguments(user_class, table)
    try:
        component: Component = user_class.loaded(**arguments)
    except CosimError:
        raise
    except (Exception, SystemExit) as error:  # it is the user's code, which may raise anything
        text = f"the constructor of {user_class.name!r} raised {in_words(error)}"
        raise UsageError(text) from error
    return checked_components({name: component})[name]


def _arguments(user_class: UserClass, table: Mapping[str, Any]) -> dict[str, Any]:
    if user_class.loaded not in _constructors:
        _constructors[user_class.loaded] = _read_constructor(user_class)
    constructor = _constructors[user_class.loaded]
    model = constructor.model
    try:
        values = model.model_validate(dict(table))
    except ValidationError as error:
        raise TableProblems(problems_of(error, model, table, ())) from error
    arguments = {}
    for field in values.model_fields_set:
        name = constructor.names[field]
        try:
            arguments[name] = _converted(getattr(values, field), constructor.annotations[field])
        except ValueError as error:
            raise TableProblems([((name,), str(error))]) from error
    return arguments


def _read_constructor(user_class: UserClass) -> _Constructor:
    """Return the parameters of the constructor of a class, and the table that has their values."""
    fields: dict[str, Any] = {}
    names: dict[str, str] = {}
    annotations: dict[str, Any] = {}
    for number, parameter in enumerate(_parameters(user_class)):
        # fields have names of their own: those of parameters may mean something to pydantic
        field = f"field_{number}"
        names[field] = parameter.name
        annotations[field] = parameter.annotation
        schema = _schema(parameter, user_class)
        is_required = parameter.default is inspect.Parameter.empty
        default = ... if is_required else None
        description = inspect.formatannotation(parameter.annotation)
        fields[field] = (schema, Field(default, alias=parameter.name, description=description))
    model = create_model("Parameters", __base__=TomlTable, **fields)
    return _Constructor(names, annotations, model)


def _parameters(user_class: UserClass) -> list[inspect.Parameter]:
    try:
        signature = inspect.signature(user_class.loaded, eval_str=True)
    except Exception as error:  # annotations may be any code
        text = f"the constructor of {user_class.name!r} cannot be read: {in_words(error)}"
        raise TableProblems([(("class",), text)]) from error
    parameters = []
    for parameter in signature.parameters.values():
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            continue
        reason = ""
        if parameter.kind is parameter.POSITIONAL_ONLY:
            reason = "is positional-only; expected a keyword parameter"
        elif parameter.name in ("kind", "unit"):
            reason = "has a reserved name; rename it"
        elif parameter.annotation is parameter.empty:
            reason = f"has no annotation; expected one, such as {parameter.name}: float"
        if reason:
            raise _refused(user_class, parameter, reason)
        parameters.append(parameter)
    return parameters


def _refused(user_class: UserClass, parameter: inspect.Parameter, reason: str) -> TableProblems:
    text = f"the parameter {parameter.name!r} of {user_class.name!r} {reason}"
    return TableProblems([(("class",), text)])


# --- annotations ---


def _schema(parameter: inspect.Parameter, user_class: UserClass) -> Any:
    """Return the type that the schema of a scenario has for an annotation.

    Raises
    ------
    TableProblems
        If there is none.
    """
    try:
        return _type(parameter.annotation)
    except TypeError as error:
        annotation = inspect.formatannotation(parameter.annotation)
        reason = f"has the annotation {annotation}; expected {_ANNOTATIONS}"
        raise _refused(user_class, parameter, reason) from error


def _type(annotation: Any) -> Any:
    """Return the type of the schema; raise TypeError if there is none."""
    origin = get_origin(annotation)
    arguments = get_args(annotation)
    if _is_array(annotation):
        return NumberRow | NumberRows
    if origin is Literal:
        return annotation
    if origin in (Union, UnionType):
        return Union[tuple(_type(argument) for argument in arguments)]  # noqa: UP007
    if annotation is NoneType:
        return None
    if origin in _SEQUENCES:
        if origin is tuple and arguments[1:] != (...,):
            raise TypeError
        return tuple[_type(arguments[0]), ...]  # type: ignore[misc]
    if annotation in _SCALARS:
        return _SCALARS[annotation]
    raise TypeError


def _is_array(annotation: Any) -> bool:
    """Return whether an annotation is that of an array of float64."""
    if annotation is np.ndarray:
        return True
    if get_origin(annotation) is not np.ndarray:
        return False
    return get_args(get_args(annotation)[1]) == (np.float64,)


def _converted(value: Any, annotation: Any) -> Any:
    """Return a checked value as its annotation wants it.

    Raises
    ------
    ValueError
        If the rows of an array have different lengths.
    """
    convert = _container(annotation)
    if not isinstance(value, tuple) or convert is None:
        return value
    return convert(value)


def _container(annotation: Any) -> Callable[[Any], Any] | None:
    """Return what makes a list, tuple or array of a tuple; None: the annotation is none of them."""
    origin = get_origin(annotation)
    if _is_array(annotation):
        return _array
    if origin in (Union, UnionType):
        containers = [_container(argument) for argument in get_args(annotation)]
        return next((container for container in containers if container is not None), None)
    if origin in _SEQUENCES:
        inner = get_args(annotation)[0]
        outer = list if origin is list else tuple
        return lambda values: outer(_each(values, inner))
    return None


def _each(values: Iterable[Any], annotation: Any) -> list[Any]:
    return [_converted(value, annotation) for value in values]


def _array(values: tuple[Any, ...]) -> Any:
    if values and isinstance(values[0], tuple):
        return matrix(values, "rows")
    return np.array(values, np.float64)
