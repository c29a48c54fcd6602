"""Describe a model of ours, as the exported FMU describes itself."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Protocol

import numpy as np

from cosim.core.linear import LinearModel
from cosim.core.signals import Interface, Signal
from cosim.errors import FmuError
from cosim.fmi.description import NO_VALUE, Description, VariableDependencies
from cosim.fmi.variable import Initial, Variable


class DescribedModel(Protocol):
    """What a description takes from a model."""

    @property
    def interface(self) -> Interface:
        """Inputs, outputs and feedthrough."""
        ...

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the continuous state elements."""
        ...


def describe(model: DescribedModel, name: str, linear: LinearModel | None) -> Description:
    """Describe a model of ours; value references are those of ``c/model.h``.

    Inputs come first, then outputs, derivatives, and the states that are no outputs. An output that
    is a state, under the state's name, is one variable.

    Parameters
    ----------
    model : DescribedModel
    name : str
    linear : LinearModel or None
        The model, where it is linear.

    Raises
    ------
    FmuError
        If a state has the name of another variable.
    """
    output_states = states_of_outputs(linear) if linear else [-1] * model.interface.n_y
    inputs = _inputs(model)
    outputs = _outputs(model, linear, output_states)
    shown = {}
    for output, state in zip(outputs, output_states, strict=True):
        if state >= 0:
            shown[output.name] = output
    variables = [
        *inputs,
        *outputs,
        *_derivatives(model, shown),
        *_other_states(model, linear, shown),
    ]
    names = [variable.name for variable in variables]
    duplicates = [name for name in names if names.count(name) > 1]
    if duplicates:
        raise FmuError(
            f"{name}: {duplicates[0]!r} is a state and another variable; "
            "give the state a name of its own"
        )
    dependencies = _dependencies(model, linear)
    return Description(name, "", "2.0", tuple(variables), model.states, dependencies)


def _inputs(model: DescribedModel) -> list[Variable]:
    variables = []
    for reference, (signal, element, unit) in enumerate(_elements(model.interface.inputs)):
        variable = Variable(
            element,
            reference,
            "input",
            unit=unit,
            variability=_variability(signal),
            start=(0.0,),
            doc=_doc(signal),
        )
        variables.append(variable)
    return variables


def _outputs(
    model: DescribedModel, linear: LinearModel | None, output_states: Sequence[int]
) -> list[Variable]:
    variables = []
    reference = model.interface.n_u
    elements = _elements(model.interface.outputs)
    for (signal, element, unit), state in zip(elements, output_states, strict=True):
        initial, start = _initial_state(linear, state)
        variable = Variable(
            element,
            reference,
            "output",
            unit=unit,
            variability=_variability(signal),
            initial=initial,
            start=start,
            doc=_doc(signal),
        )
        variables.append(variable)
        reference += 1
    return variables


def _derivatives(model: DescribedModel, shown: Mapping[str, Variable]) -> list[Variable]:
    """Return the derivatives of the states; ``shown`` are the outputs that are states."""
    derivatives = []
    first_reference = model.interface.n_u + model.interface.n_y
    for reference, state in enumerate(model.states, first_reference):
        unit = shown[state].unit if state in shown else None
        derivative = Variable(
            _derivative(state),
            reference,
            "local",
            unit=None if unit is None else f"{unit}/s",
            initial="calculated",
            derivative_of=state,
        )
        derivatives.append(derivative)
    return derivatives


def _other_states(
    model: DescribedModel, linear: LinearModel | None, shown: Mapping[str, Variable]
) -> list[Variable]:
    """Return the states that are no outputs; ``shown`` are the outputs that are states."""
    variables = []
    first_reference = model.interface.n_u + model.interface.n_y + len(model.states)
    # States that are outputs have a value reference here too, which is not used.
    for index, state in enumerate(model.states):
        if state not in shown:
            initial, start = _initial_state(linear, index)
            reference = first_reference + index
            variables.append(Variable(state, reference, "local", initial=initial, start=start))
    return variables


def _initial_state(
    linear: LinearModel | None, index: int
) -> tuple[Initial, tuple[float, ...] | None]:
    """Return ``initial`` and ``start`` of a state (index -1: of no state).

    A state has a start value unless the inputs decide it.
    """
    if linear is None or index < 0 or linear.Xu[index].any():
        return "calculated", None
    return "exact", (float(linear.X0[index]),)


def _elements(signals: Iterable[Signal]) -> Iterator[tuple[Signal, str, str | None]]:
    """Yield the elements of signals: each with its signal, its name and its unit."""
    for signal in signals:
        for element, unit in zip(signal.elements, signal.measures, strict=True):
            yield signal, element, unit.name


def _names(signals: Iterable[Signal]) -> list[str]:
    return [name for _, name, _ in _elements(signals)]


def _derivative(state: str) -> str:
    return f"der({state})"


def _doc(signal: Signal) -> str:
    marker = NO_VALUE if signal.optional else ""
    return "; ".join(text for text in (marker, signal.description) if text)


def _variability(signal: Signal) -> str:
    return "discrete" if signal.variability == "discrete" else "continuous"


def states_of_outputs(model: LinearModel) -> list[int]:
    """Return for every output element the index of the state that it is, or -1.

    Both the row of C and the name must be those of the state.
    """
    states = []
    outputs = _names(model.interface.outputs)
    for name, c, d in zip(outputs, model.C, model.D, strict=True):
        state = -1
        if name in model.states and np.count_nonzero(c) == 1 and not d.any():
            index = model.states.index(name)
            state = index if c[index] == 1.0 else -1
        states.append(state)
    return states


def _dependencies(model: DescribedModel, linear: LinearModel | None) -> VariableDependencies:
    if linear is not None:
        return _linear_dependencies(linear)
    interface = model.interface
    dependencies: dict[str, tuple[str, ...] | None] = {}
    for signal in interface.outputs:
        feeding = interface.feeds(signal.name)
        inputs = _names(source for source in interface.inputs if source.name in feeding)
        dependencies |= dict.fromkeys(signal.elements, tuple(inputs))
    for state in model.states:
        dependencies[_derivative(state)] = None
    return dependencies


def _linear_dependencies(linear: LinearModel) -> VariableDependencies:
    """Return the inputs and states whose entries in the rows of the matrices are not zero."""
    inputs = _names(linear.interface.inputs)
    derivatives = [_derivative(state) for state in linear.states]
    unknowns = _names(linear.interface.outputs) + derivatives
    by_state = [*linear.C, *linear.A]
    by_input = [*linear.D, *linear.B]
    dependencies = {}
    for name, state_row, input_row in zip(unknowns, by_state, by_input, strict=True):
        of_inputs = element_dependencies(inputs, input_row)
        of_states = element_dependencies(linear.states, state_row)
        dependencies[name] = (*of_inputs, *of_states)
    return dependencies


def element_dependencies(names: Sequence[str], row: Iterable[float]) -> tuple[str, ...]:
    """Return the names whose entries in a row of a matrix are not zero."""
    return tuple(name for name, value in zip(names, row, strict=True) if value != 0.0)
