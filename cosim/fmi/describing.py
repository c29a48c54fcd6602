"""Describe a model of ours as a unit, as the exported FMU describes itself."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol

import numpy as np

from cosim.core.linear import LinearModel
from cosim.core.signals import Interface, Signal
from cosim.errors import FmuError
from cosim.fmi.description import NO_VALUE, Description
from cosim.fmi.variable import Initial, Variable


class Shape(Protocol):
    """What a description takes from a model."""

    @property
    def interface(self) -> Interface:
        """Inputs, outputs and feedthrough."""
        ...

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the continuous state elements."""
        ...


def describe(model: Shape, name: str, linear: LinearModel | None) -> Description:
    """Describe a model of ours as a unit; value references as in ``c/model.h``.

    Inputs come first, then outputs, derivatives, and the states that are no outputs. An output that is a state, under the
    state's name, is one variable.

    Raises
    ------
    FmuError
        If a state has the name of another variable.
    """
    face, m, p, n = model.interface, model.interface.n_u, model.interface.n_y, len(model.states)
    outputs = [element for signal in face.outputs for element in signal.elements]
    state_of = states_of_outputs(linear) if linear else [-1] * p
    exact = [not row.any() for row in linear.Xu] if linear else [False] * n
    shown = {outputs[i] for i in range(p) if state_of[i] >= 0}

    def state(index: int) -> tuple[Initial, tuple[float, ...] | None]:
        return (
            ("exact", (float(linear.X0[index]),))
            if linear and exact[index]
            else ("calculated", None)
        )

    variables = [
        Variable(
            element,
            number,
            "input",
            unit=signal.unit,
            variability=_variability(signal),
            start=(0.0,),
            doc=_doc(signal),
        )
        for number, (signal, element) in enumerate((s, e) for s in face.inputs for e in s.elements)
    ]
    for i, (signal, element) in enumerate((s, e) for s in face.outputs for e in s.elements):
        initial, start = state(state_of[i]) if state_of[i] >= 0 else ("calculated", None)
        variables.append(
            Variable(
                element,
                m + i,
                "output",
                unit=signal.unit,
                variability=_variability(signal),
                initial=initial,
                start=start,
                doc=_doc(signal),
            )
        )
    units = {v.name: v.unit for v in variables}
    for j, x in enumerate(model.states):
        unit = units.get(x) if x in shown else None
        rate = None if unit is None else f"{unit}/s"
        variables.append(
            Variable(
                f"der({x})", m + p + j, "local", unit=rate, initial="calculated", derivative_of=x
            )
        )
    for j, x in enumerate(model.states):
        if x not in shown:
            initial, start = state(j)
            variables.append(Variable(x, m + p + n + j, "local", initial=initial, start=start))
    names = [v.name for v in variables]
    twice = next((v for v in names if names.count(v) > 1), None)
    if twice:
        raise FmuError(
            f"{name}: {twice!r} is a state and another variable; give the state a name of its own"
        )
    return Description(
        name,
        "",
        "2.0",
        tuple(variables),
        model.states,
        _dependencies(model, linear),
        event_indicators=0,
    )


def _doc(signal: Signal) -> str:
    return NO_VALUE if signal.optional else ""


def _variability(signal: Signal) -> str:
    return "discrete" if signal.variability == "discrete" else "continuous"


def states_of_outputs(model: LinearModel) -> list[int]:
    """Give for every output element the state that it is, by value and by name, or -1."""
    names = [element for signal in model.interface.outputs for element in signal.elements]
    found = []
    for name, c, d in zip(names, model.C, model.D, strict=True):
        j = model.states.index(name) if name in model.states else -1
        is_state = j >= 0 and c[j] == 1.0 and np.count_nonzero(c) == 1 and not d.any()
        found.append(j if is_state else -1)
    return found


def _dependencies(model: Shape, linear: LinearModel | None) -> dict[str, tuple[str, ...] | None]:
    inputs = [element for signal in model.interface.inputs for element in signal.elements]
    outputs = [element for signal in model.interface.outputs for element in signal.elements]
    derivatives = [f"der({x})" for x in model.states]
    if linear is None:
        return {
            **{
                element: tuple(
                    e
                    for s in model.interface.inputs
                    if s.name in model.interface.feeds(signal.name)
                    for e in s.elements
                )
                for signal in model.interface.outputs
                for element in signal.elements
            },
            **dict.fromkeys(derivatives),
        }
    rows = zip(
        [*outputs, *derivatives], [*linear.C, *linear.A], [*linear.D, *linear.B], strict=True
    )
    return {
        name: (*element_dependencies(inputs, of_u), *element_dependencies(model.states, of_x))
        for name, of_x, of_u in rows
    }


def element_dependencies(names: Sequence[str], row: Iterable[float]) -> tuple[str, ...]:
    """Give the names whose entries in a row of a matrix are not zero."""
    return tuple(name for name, value in zip(names, row, strict=True) if value != 0.0)
