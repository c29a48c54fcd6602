"""Join scalars to the arrays of FMI 3."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from cosim.fmi.description import Dae, Description, Formulation
from cosim.fmi.variable import Variable


def with_arrays(description: Description) -> Description:
    """Join the scalars ``x[0]``, ``x[1]``, ... whose references follow each other to one array.

    It has the reference of the first. The derivatives of an array of states are an array too.
    """
    not_derivatives = [v for v in description.variables if v.derivative_of is None]
    groups = _groups(not_derivatives, _derivative_references(description))
    group_of = {variable.name: group for group in groups for variable in group}
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
        name = f"der({_array_name(states)})" if len(states) > 1 else variable.name
        names[variable.name] = name
        derivatives = _derivatives(description, states)
        if variable is derivatives[0]:
            variables.append(replace(_join(derivatives, array_of), name=name))
    return replace(
        description,
        variables=tuple(variables),
        states=_array_names(description.states, names),
        dependencies=_array_dependencies(description.dependencies, names),
        initial_dependencies=_initial_dependencies(description, variables, names),
        dae=None if description.dae is None else _residual_form(description.dae, names),
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


def _groups(variables: Sequence[Variable], derivatives: Mapping[str, int]) -> list[list[Variable]]:
    """Split into elements 0, 1, ... of one array each, all of them states or none."""
    groups: list[list[Variable]] = []
    for variable in variables:
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
    if first is None or variable.name != f"{first[1]}[{len(group)}]":
        return False
    last = group[-1]
    if variable.reference != last.reference + 1:
        return False
    return _attributes(last) == _attributes(variable) and _derivatives_continue(
        last, variable, derivatives
    )


def _attributes(variable: Variable) -> tuple[str, str | None, str]:
    return variable.causality, variable.unit, variable.variability


def _derivatives_continue(
    last: Variable, variable: Variable, derivatives: Mapping[str, int]
) -> bool:
    """Check that neither is a state, or both are and their derivatives follow each other too."""
    if last.name not in derivatives or variable.name not in derivatives:
        return last.name not in derivatives and variable.name not in derivatives
    return derivatives[variable.name] == derivatives[last.name] + 1


# --- arrays in the place of scalars ---


def _array_name(group: Sequence[Variable]) -> str:
    name = group[0].name
    return name if len(group) == 1 else name.rpartition("[")[0]


def _join(group: Sequence[Variable], array_of: Mapping[str, str]) -> Variable:
    first = group[0]
    state = None if first.derivative_of is None else array_of[first.derivative_of]
    if len(group) == 1:
        return replace(first, derivative_of=state)
    initials = {variable.initial for variable in group}
    initial = first.initial if len(initials) == 1 else "calculated"
    return replace(
        first,
        name=_array_name(group),
        size=len(group),
        dimensions=(len(group),),
        initial=initial,
        start=None if initial == "calculated" else _start(group),
        derivative_of=state,
    )


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
    dependencies: Mapping[str, tuple[str, ...] | None], names: Mapping[str, str]
) -> dict[str, tuple[str, ...] | None]:
    """Return what arrays depend on: what any of their elements does; None: one does not say."""
    merged: dict[str, tuple[str, ...] | None] = {}
    for scalar, needs in dependencies.items():
        array = names[scalar]
        known = merged.get(array, ())
        if needs is None or known is None:
            merged[array] = None
        else:
            merged[array] = tuple(dict.fromkeys((*known, *_array_names(needs, names))))
    return merged


def _initial_dependencies(
    description: Description, variables: Sequence[Variable], names: Mapping[str, str]
) -> dict[str, tuple[str, ...] | None]:
    # a calculated array is no known: its elements cannot be set, not even those that were exact
    calculated = {variable.name for variable in variables if variable.initial == "calculated"}
    dependencies = _array_dependencies(description.initial_dependencies, names)
    for name, needs in dependencies.items():
        if needs is not None:
            dependencies[name] = tuple(need for need in needs if need not in calculated)
    return dependencies


def _residual_form(dae: Dae, names: Mapping[str, str]) -> Dae:
    needs: dict[str, tuple[str, ...] | None] = {}
    for formulations in dae.residuals:
        needs |= {formulation.name: formulation.dependencies for formulation in formulations}
    residuals = _array_dependencies(needs, names)
    return replace(
        dae,
        algebraic=_array_names(dae.algebraic, names),
        residuals=tuple((Formulation(name, known),) for name, known in residuals.items()),
        dependencies=_array_dependencies(dae.dependencies, names),
    )
