"""The border: what users hand to the core is checked once, and named where it is wrong."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import Any, Final

import numpy as np

from cosim.core.contracts import Component, Design
from cosim.core.recording import Recorder
from cosim.core.signals import Interface
from cosim.errors import GraphError, UsageError, nearest, quoted
from cosim.instants import StepNs

THREADS: Final = (1, 2)
RECORDER_METHODS = ("__enter__", "__exit__", "begin", "write", "message", "event", "result")


def check_type(label: str, value: object, needed: type, error: type[UsageError]) -> None:
    """Check the type of an argument.

    Raises
    ------
    UsageError
        Or what ``error`` says: if it has another one.
    """
    if not isinstance(value, needed):
        raise error(f"{label}: expected a {needed.__name__}, got {kind_of(value)}")


def kind_of(value: object) -> str:
    """Return in words what a value is: itself where it is plain, else its type."""
    if value is None or isinstance(value, bool | int | float | str):
        return quoted(value)
    if isinstance(value, type):
        return f"the class {value.__name__}"
    return f"an object of type {type(value).__name__}"


def check_recorder(recorder: Recorder) -> None:
    """Check that a recorder has its methods.

    Raises
    ------
    UsageError
        If it is none.
    """
    if isinstance(recorder, type):
        raise UsageError(f"recorder: expected an instance, got {kind_of(recorder)}")
    missing = _missing(recorder, RECORDER_METHODS)
    if missing:
        raise UsageError(
            f"recorder: expected a recorder such as Memory(), got {kind_of(recorder)}; missing: "
            f"{missing}"
        )


def checked_components(components: Mapping[str, Component]) -> dict[str, Component]:
    """Return a copy of named components, after a check of their names and contracts.

    Raises
    ------
    GraphError
        At the first name or component that cannot be part of a graph.
    """
    check_type("components", components, Mapping, GraphError)
    if not components:
        raise GraphError("the graph has no components; expected at least one")
    names: dict[int, str] = {}
    for name, component in components.items():
        if not isinstance(name, str) or not name or "." in name:
            raise GraphError(
                f"component {name!r}: expected a non-empty string without dots as its name"
            )
        other = names.setdefault(id(component), name)
        if other != name:
            raise GraphError(
                f"components {other!r} and {name!r} are the same object; use one instance each, "
                "as an instance has one state"
            )
        _check_component(name, component)
    return dict(components)


def check_threads(threads: int | None) -> None:
    """Check a number of threads; None: as many as it takes.

    Raises
    ------
    GraphError
        If there cannot be as many.
    """
    if threads is not None and (type(threads) is not int or threads not in THREADS):
        raise GraphError(f"threads: expected 1, 2 or None, got {kind_of(threads)}")


def check_choice(key: str, value: str, choices: tuple[str, ...]) -> None:
    """Check that a value is one of several.

    Raises
    ------
    GraphError
        If it is none of them; names the nearest.
    """
    if not isinstance(value, str) or value not in choices:
        raise GraphError(f"{key}: got {kind_of(value)}; {nearest(str(value), choices)}")


def check_iterations(iterations: int, coupling: str, input_interpolation: str) -> None:
    """Check that a number of iterations is one, and has something to change.

    Raises
    ------
    GraphError
        If it is not, or has not.
    """
    if type(iterations) is not int or iterations < 1:
        raise GraphError(f"iterations: expected an integer >= 1, got {kind_of(iterations)}")
    if iterations > 1 and coupling == "newton":
        raise GraphError(
            "iterations: expected 1 with coupling = 'newton', which iterates until it converges, "
            f"got {iterations}; use 1, or 'gauss-seidel' or 'jacobi'"
        )
    if iterations > 1 and input_interpolation == "zero-order":
        raise GraphError(
            "iterations: expected 1 with input_interpolation = 'zero-order', where iterations "
            "change nothing (inputs keep their values from the start of a step), got "
            f"{iterations}; use 'linear' or 'latest'"
        )


def checked_periods(
    periods: Mapping[str, int], components: Mapping[str, Component]
) -> dict[str, int]:
    """Return a copy of the communication steps between rows that are kept, by component.

    Raises
    ------
    GraphError
        If there is no such component, or they are no whole number from 1 on.
    """
    check_type("periods", periods, Mapping, GraphError)
    for name, period in periods.items():
        if name not in components:
            suggestion = nearest(str(name), components)
            raise GraphError(f"periods: there is no component {name!r}; {suggestion}")
        if type(period) is not int or period < 1:
            found = kind_of(period)
            raise GraphError(f"periods: expected at least 1 step for {name!r}, got {found}")
    return dict(periods)


def check_step(step_ns: StepNs) -> None:
    """Check a communication step [ns].

    Raises
    ------
    GraphError
        If it is no whole number, or fraction, from 1 on.
    """
    if type(step_ns) not in (int, Fraction) or step_ns < 1:
        raise GraphError(f"step_ns: expected a number >= 1 [ns], got {kind_of(step_ns)}")


def check_recorded_designs(
    designs: Mapping[str, Design], components: Mapping[str, Component]
) -> None:
    """Check that recorded designs are those of components.

    Raises
    ------
    GraphError
        If there is no such component, or a design is no mapping of arrays.
    """
    check_type("recorded", designs, Mapping, GraphError)
    for name, design in designs.items():
        if name not in components:
            suggestion = nearest(str(name), components)
            raise GraphError(f"recorded: there is no component {name!r}; {suggestion}")
        check_type(f"recorded design of {name!r}", design, Mapping, GraphError)
        for key, array in design.items():
            label = f"recorded design of {name!r}, {key!r}"
            check_type(label, array, np.ndarray, GraphError)


def _check_component(name: str, component: Component) -> None:
    """Check that a component has what the contract asks for."""
    try:
        interface = getattr(component, "interface", None)
    except Exception as error:  # a property of the user's own may raise anything
        raise GraphError(
            f"component {name!r}: its interface raised {type(error).__name__}: {error}"
        ) from error
    missing = _missing(component, _methods(interface))
    found = kind_of(component)
    if isinstance(component, type):
        raise GraphError(f"component {name!r}: expected an instance, got {found}")
    if not isinstance(interface, Interface):
        raise GraphError(
            f"component {name!r}: expected an interface of type cosim.core.Interface, got "
            f"{kind_of(interface)} from {found}{_inner(component)}"
        )
    if missing:
        raise GraphError(
            f"component {name!r}: expected a cosim.core.Component, got {found}; missing: {missing}"
        )


def _methods(interface: Any) -> list[str]:
    methods = ["initialize", "outputs", "advance"]
    if isinstance(interface, Interface):
        methods += ["prepare"] * interface.prepares
        methods += ["save", "restore"] * interface.rollback
        methods += ["native"] * interface.native
        methods += ["linearized"] * interface.linearizable
    return methods


def _inner(value: object) -> str:
    """Return the way out where an object only carries a component, as an opened FMU does."""
    carried = getattr(value, "component", None)
    if isinstance(getattr(carried, "interface", None), Interface):
        return "; pass its .component"
    return ""


def _missing(value: object, methods: list[str] | tuple[str, ...]) -> str:
    missing = [name for name in methods if not callable(getattr(value, name, None))]
    return ", ".join(missing)
