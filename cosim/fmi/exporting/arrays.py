"""Join scalars to the arrays of FMI 3."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from cosim.core.port import split_element
from cosim.fmi.description import Dae, Description, Formulation, VariableDependencies
from cosim.fmi.variable import Variable


def with_arrays(description: Description) -> Description:
    """Join the scalars ``x[0]``, ``x[1]``, ... whose references follow each other to one array.

    It has the reference of the first. The derivatives of an array of states are an array too.
    """
    group_of: dict[str, list[Variable]] = {}  # by name of a scalar that is no derivative
    for group in _groups(description):
        group_of |= dict.fromkeys([variable.name for variable in group], group)
    array_of = {name: _array_name(group) for name, group in group_of.items()}
    names = dict(array_of)  # of scalars, derivatives included: their arrays
    variables: list[Variable] = []
    for variable in description.variables:
        if variable.derivative_of is None:
            group = group_of[variable.name]
            if variable is group[0]:
                variables.append(_join(group, array_of))
            continue
        states = group_of[variable.derivative_of]
        name = variable.name
        if len(states) > 1:
            name = f"der({_array_name(states)})"
        names[variable.name] = name
        derivatives = _derivatives(description, states)
        if variable is derivatives[0]:
            array = _join(derivatives, array_of)
            variables.append(replace(array, name=name))
    arranged = _with_names_of_arrays(description, names)
    dependencies = _without_calculated(arranged.initial_dependencies, variables)
    return replace(arranged, variables=tuple(variables), initial_dependencies=dependencies)


def _with_names_of_arrays(description: Description, names: Mapping[str, str]) -> Description:
    """Return the description with states and dependencies by the names of their arrays."""
    dae = description.dae
    return replace(
        description,
        states=_array_names(description.states, names),
        dependencies=_array_dependencies(description.dependencies, names),
        initial_dependencies=_array_dependencies(description.initial_dependencies, names),
        dae=None if dae is None else _residual_form(dae, names),
    )


def _derivative_references(description: Description) -> dict[str, int]:
    """Return the value reference of each state's derivative."""
    references = {}
    for variable in description.variables:
        if variable.derivative_of is not None:
            references[variable.derivative_of] = variable.reference
    return references


def _derivatives(description: Description, states: Sequence[Variable]) -> list[Variable]:
    names = {state.name for state in states}
    return [v for v in description.variables if v.derivative_of in names]


# --- which scalars are one array ---


def _groups(description: Description) -> list[list[Variable]]:
    """Split all but derivatives into the elements 0, 1, ... of one array each."""
    derivatives = _derivative_references(description)
    groups: list[list[Variable]] = []
    for variable in description.variables:
        if variable.derivative_of is not None:
            continue
        if groups and _continues(groups[-1], variable, derivatives):
            groups[-1].append(variable)
        else:
            groups.append([variable])
    return groups


def _continues(
    group: Sequence[Variable], variable: Variable, derivatives: Mapping[str, int]
) -> bool:
    """Check whether a variable is the next element of an array."""
    first = re.fullmatch(r"(.+)\[0\]", group[0].name)
    if first is None:
        return False
    if variable.name != f"{first[1]}[{len(group)}]":
        return False
    last = group[-1]
    if variable.reference != last.reference + 1:
        return False
    if _attributes(last) != _attributes(variable):
        return False
    return _derivatives_continue(last, variable, derivatives)


def _attributes(variable: Variable) -> tuple[str, str | None, str]:
    return variable.causality, variable.unit, variable.variability


def _derivatives_continue(
    last: Variable, variable: Variable, derivatives: Mapping[str, int]
) -> bool:
    """Check that neither is a state, or both are and their derivatives follow each other too."""
    last_derivative = derivatives.get(last.name)
    derivative = derivatives.get(variable.name)
    if last_derivative is None or derivative is None:
        return last_derivative == derivative
    return derivative == last_derivative + 1


# --- arrays in the place of scalars ---


def _array_name(group: Sequence[Variable]) -> str:
    name = group[0].name
    return name if len(group) == 1 else split_element(name)[0]


def _join(group: Sequence[Variable], array_of: Mapping[str, str]) -> Variable:
    first = group[0]
    state = None
    if first.derivative_of is not None:
        state = array_of[first.derivative_of]
    if len(group) == 1:
        return replace(first, derivative_of=state)
    initials = {variable.initial for variable in group}
    initial = first.initial if len(initials) == 1 else "calculated"
    start = None if initial == "calculated" else _start(group)
    size = len(group)
    array = replace(first, name=_array_name(group), size=size, dimensions=(size,))
    return replace(array, initial=initial, start=start, derivative_of=state)


def _start(group: Sequence[Variable]) -> tuple[float, ...] | None:
    """Return the start values of all elements; None if one has none."""
    values: list[float] = []
    for variable in group:
        if variable.start is None:
            return None
        values += variable.start
    return tuple(values)


def _array_names(scalars: Iterable[str], names: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(names[scalar] for scalar in scalars))


def _array_dependencies(
    dependencies: VariableDependencies, names: Mapping[str, str]
) -> VariableDependencies:
    """Return what arrays depend on: what any of their elements does; None: one does not say."""
    merged: dict[str, tuple[str, ...] | None] = {}
    for scalar, needs in dependencies.items():
        array = names[scalar]
        known = merged.get(array, ())
        if needs is None or known is None:
            merged[array] = None
        else:
            arrays = _array_names(needs, names)
            merged[array] = tuple(dict.fromkeys((*known, *arrays)))
    return merged


def _without_calculated(
    dependencies: VariableDependencies, variables: Iterable[Variable]
) -> VariableDependencies:
    """Return initial dependencies on what can be set.

    A calculated array cannot: not even those of its elements that could be set as scalars.
    """
    calculated = {variable.name for variable in variables if variable.initial == "calculated"}
    settable: dict[str, tuple[str, ...] | None] = {}
    for name, needs in dependencies.items():
        settable[name] = needs
        if needs is not None:
            settable[name] = tuple(need for need in needs if need not in calculated)
    return settable


def _residual_form(dae: Dae, names: Mapping[str, str]) -> Dae:
    needs: dict[str, tuple[str, ...] | None] = {}
    for formulations in dae.residuals:
        needs |= {formulation.name: formulation.dependencies for formulation in formulations}
    residuals = []
    for name, known in _array_dependencies(needs, names).items():
        residuals.append((Formulation(name, known),))
    return replace(
        dae,
        algebraic=_array_names(dae.algebraic, names),
        residuals=tuple(residuals),
        dependencies=_array_dependencies(dae.dependencies, names),
    )
