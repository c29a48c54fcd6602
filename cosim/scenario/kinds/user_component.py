"""Components of users: a Python class in the scenario's folder, on sys.path, or installed.

What else the table has are the parameters of the class's constructor, by name and annotation. A
parameter takes what its annotation says, and nothing that would have to be converted:

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

How the class is found: :mod:`cosim.scenario.kinds.user_code`. Its code runs where its component is
built: in a run, a dry run, and whatever needs the component. It does not run to show a scenario. A
log names classes too, and may come from anywhere: a replay takes their components from the
recording, unless its caller allows the code.

An entry point ``relay = "relay_package.parts:Relay"`` of the group ``cosim.components`` of an
installed package makes ``kind = "relay"`` available. Nothing is imported to know of it. The names
of the kinds that come with cosim stand for these, whatever is installed.
"""

from __future__ import annotations

import inspect
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import entry_points
from types import NoneType, UnionType
from typing import Annotated, Any, ClassVar, Final, Literal, Union, get_args, get_origin
from weakref import WeakKeyDictionary

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, StrictStr, ValidationError, create_model

from cosim.core.arguments import checked_components
from cosim.core.contracts import Component
from cosim.errors import CosimError, UsageError, quoted
from cosim.scenario.document.problems import TableProblems, problems_of
from cosim.scenario.document.schema import (
    Flag,
    Number,
    NumberRow,
    NumberRows,
    TomlTable,
    Whole,
    array_of,
)
from cosim.scenario.kinds.base import BuildContext, Kind
from cosim.scenario.kinds.user_code import UserClass, in_words
from cosim.scenario.kinds.values import StepDependence

GROUP: Final = "cosim.components"
_SCALARS: Final[Mapping[Any, Any]] = {
    float: Number,
    int: Whole,
    bool: Flag,
    str: StrictStr,
    NoneType: None,
}
_ANNOTATIONS: Final = (
    "float, int, bool, str, Literal, a list, Sequence or tuple[T, ...] of these, "
    "a numpy array of float64, or a union of them"
)


def _check_class_name(name: str) -> str:
    """Return ``package.module:Class``; raise ValueError if it is something else."""
    module, colon, class_name = name.partition(":")
    if colon and all(map(str.isidentifier, [*module.split("."), class_name])):
        return name
    module, dot, class_name = name.rpartition(".")
    meant = f"; did you mean {f'{module}:{class_name}'!r}?" if dot and not colon else ""
    raise ValueError(f"expected 'package.module:Class', got {quoted(name)}{meant}")


class UserKind(Kind):
    """A component of a class that its user wrote.

    Its other keys are parameters of the constructor.
    """

    model_config = ConfigDict(extra="allow")
    ports: ClassVar[str] = "those of the class"

    @property
    def step_dependence(self) -> StepDependence:
        return StepDependence(jumps_at_points=False)

    @property
    def computable(self) -> bool:
        """Whether a replay may run the class."""
        return self._is_allowed

    def _constructed(self, name: str, user_class: UserClass) -> Component:
        return construct(name, user_class, self.model_extra or {})


class PythonKind(UserKind):
    """A component of a Python class in the scenario's folder or on sys.path.

    Every other key is a parameter of its constructor.
    """

    kind: Literal["python"]
    class_: Annotated[StrictStr, AfterValidator(_check_class_name)] = Field(
        alias="class",
        description='"package.module:Class"; all other keys are parameters of its constructor',
    )

    @property
    def code(self) -> str:
        return self.class_

    def build(self, name: str, context: BuildContext) -> Component:
        return self._constructed(name, context.user_class(name, self.code, self.class_))


class InstalledKind(UserKind):
    """A component of a Python class that an installed package declares.

    Every other key is a parameter of its constructor.
    """

    kind: StrictStr

    @property
    def code(self) -> str:
        return self.kind

    def build(self, name: str, context: BuildContext) -> Component:
        found = installed_class(self.kind)
        class_name = _check_class_name(found.class_name)
        return self._constructed(
            name, context.user_class(name, self.code, class_name, found.distribution)
        )


# --- the parameters of a constructor ---

# making a table takes longer than many a run, and a study has a component of a class a member
_tables: Final[WeakKeyDictionary[type, type[TomlTable]]] = WeakKeyDictionary()


def construct(name: str, user_class: UserClass, parameters: Mapping[str, Any]) -> Component:
    """Return the component of a user's class, by its name and the parameters of its constructor.

    Raises
    ------
    TableProblems
        If a parameter is unknown, missing or has a wrong value, or the constructor cannot be
        understood.
    UsageError
        If the constructor raises something, which is the cause, or makes no component.
    """
    if user_class.loaded not in _tables:
        _tables[user_class.loaded] = _table_of(user_class)
    table = _tables[user_class.loaded]
    try:
        values = table.model_validate(dict(parameters))
    except ValidationError as error:
        raise TableProblems(problems_of(error, table, parameters, ())) from error
    arguments = {}
    for field in values.model_fields_set:
        arguments[str(table.model_fields[field].alias)] = getattr(values, field)
    try:
        component: Component = user_class.loaded(**arguments)
    except CosimError:
        raise
    except (Exception, SystemExit) as error:  # it is the user's code, which may raise anything
        text = f"the constructor of {user_class.name!r} raised {in_words(error)}"
        raise UsageError(text) from error
    return checked_components({name: component})[name]


def _table_of(user_class: UserClass) -> type[TomlTable]:
    """Return the table that has the parameters of the constructor of a class.

    Raises
    ------
    TableProblems
        If there is none.
    """
    try:
        signature = inspect.signature(user_class.loaded, eval_str=True)
    except Exception as error:  # annotations may be any code
        text = f"the constructor of {user_class.name!r} cannot be read: {in_words(error)}"
        raise TableProblems([(("class",), text)]) from error
    fields: dict[str, Any] = {}
    for number, parameter in enumerate(signature.parameters.values()):
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            continue
        try:
            value = _type_of(parameter)
        except TypeError as error:
            text = f"the parameter {parameter.name!r} of {user_class.name!r} {error}"
            raise TableProblems([(("class",), text)]) from error
        default = ... if parameter.default is parameter.empty else None
        # fields have names of their own: those of parameters may mean something to pydantic
        annotation = inspect.formatannotation(parameter.annotation)
        field = Field(default, alias=parameter.name, description=annotation)
        fields[f"field_{number}"] = (value, field)
    return create_model("Parameters", __base__=TomlTable, **fields)


def _type_of(parameter: inspect.Parameter) -> Any:
    """Return the type that a table has for a parameter; raise TypeError if there is none."""
    if parameter.kind is parameter.POSITIONAL_ONLY:
        raise TypeError("is positional-only; expected a keyword parameter")
    if parameter.name in ("kind", "unit"):
        raise TypeError("has a reserved name; rename it")
    if parameter.annotation is parameter.empty:
        raise TypeError(f"has no annotation; expected one, such as {parameter.name}: float")
    try:
        return _type(parameter.annotation)
    except TypeError as error:
        annotation = inspect.formatannotation(parameter.annotation)
        raise TypeError(f"has the annotation {annotation}; expected {_ANNOTATIONS}") from error


def _type(annotation: Any) -> Any:
    """Return the type of a table for an annotation; raise TypeError if there is none."""
    origin = get_origin(annotation)
    arguments = get_args(annotation)
    if annotation in _SCALARS:
        return _SCALARS[annotation]
    if origin is Literal:
        return annotation
    if origin in (Union, UnionType):
        return Union[tuple(_type(argument) for argument in arguments)]  # noqa: UP007
    is_of_float64 = origin is np.ndarray and get_args(arguments[1]) == (np.float64,)
    if annotation is np.ndarray or is_of_float64:
        return Annotated[NumberRow | NumberRows, AfterValidator(partial(array_of, name="rows"))]
    if origin is list:
        return Annotated[tuple[_type(arguments[0]), ...], AfterValidator(list)]  # type: ignore[misc]
    if origin is Sequence or (origin is tuple and arguments[1:] == (...,)):
        return tuple[_type(arguments[0]), ...]  # type: ignore[misc]
    raise TypeError


# --- installed packages ---


@dataclass(frozen=True, slots=True)
class InstalledClass:
    """An entry point.

    Parameters
    ----------
    kind : str
    class_name : str
        ``package.module:Class``.
    distribution : str
        Name and version of the package that declares it.
    """

    kind: str
    class_name: str
    distribution: str


def installed_classes() -> Mapping[str, list[InstalledClass]]:
    """Return all entry points by kind; more than one where packages declare the same."""
    classes: dict[str, list[InstalledClass]] = {}
    for point in entry_points(group=GROUP):
        about = "an unknown package"
        if point.dist is not None:
            about = f"{point.dist.name} {point.dist.version}"
        class_name = f"{point.module}:{point.attr}" if point.attr else point.value
        installed = InstalledClass(point.name, class_name, about)
        classes.setdefault(point.name, []).append(installed)
    return dict(sorted(classes.items()))


def installed_class(kind: str) -> InstalledClass:
    """Return the class of a kind.

    Raises
    ------
    UsageError
        If no installed package declares it, or several do.
    """
    classes = installed_classes().get(kind, [])
    if not classes:
        raise UsageError(
            f"no installed package declares the kind {kind!r}; expected one with an entry point "
            f"{kind!r} in the group {GROUP!r}"
        )
    if len(classes) > 1:
        packages = ", ".join(entry.distribution for entry in classes)
        raise UsageError(
            f"the kind {kind!r} is declared {len(classes)} times, by {packages}; expected one; "
            'kind = "python" with class = "package.module:Class" selects a class'
        )
    return classes[0]


def refusal(entry: InstalledClass, shipped: Collection[str]) -> str:
    """Return why an entry point makes no kind; empty: it does."""
    if entry.kind in shipped:
        return f"refused: {entry.kind!r} is a kind of cosim itself; rename it"
    if ":" not in entry.class_name:
        return f"refused: expected 'package.module:Class', got {entry.class_name!r}"
    if len(installed_classes()[entry.kind]) > 1:
        return f"refused: {entry.kind!r} is declared more than once"
    return ""
