"""Scalars put together to the arrays of FMI 3."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from cosim.fmi.description import Dae, Description, Formulation
from cosim.fmi.variable import Variable


def with_arrays(description: Description) -> Description:
    """Make one array of the scalars ``x[0]``, ``x[1]``, ... where their references follow each other; it has that of the first.

    The derivatives of an array of states are an array too.
    """
    plain = [v for v in description.variables if v.derivative_of is None]
    groups = {group[0].name: group for group in _runs(plain, _order(description))}
    array_of = {v.name: _base(group) for group in groups.values() for v in group}
    variables: list[Variable] = []
    names = dict(array_of)
    for variable in description.variables:
        if variable.name in groups:
            variables.append(_together(groups[variable.name], array_of))
        if variable.derivative_of is None:
            continue
        owner = next(
            group for group in groups.values() if variable.derivative_of in [v.name for v in group]
        )
        ders = [
            v for v in description.variables if v.derivative_of in [state.name for state in owner]
        ]
        base = f"der({_base(owner)})" if len(owner) > 1 else variable.name
        names[variable.name] = base
        if variable is ders[0]:
            variables.append(replace(_together(ders, array_of), name=base))
    solved = {
        v.name for v in variables if v.initial == "calculated"
    }  # no start value can be given for one element alone
    initial = {
        name: None if needs is None else tuple(need for need in needs if need not in solved)
        for name, needs in _merge(description.initial_dependencies, names).items()
    }
    return replace(
        description,
        variables=tuple(variables),
        states=_merged(description.states, names),
        dependencies=_merge(description.dependencies, names),
        initial_dependencies=initial,
        dae=description.dae and _gathered(description.dae, names),
    )


def _gathered(dae: Dae, names: Mapping[str, str]) -> Dae:
    needs = _merge(
        {one.name: one.dependencies for formulations in dae.residuals for one in formulations},
        names,
    )
    return replace(
        dae,
        algebraic=_merged(dae.algebraic, names),
        residuals=tuple((Formulation(name, found),) for name, found in needs.items()),
        dependencies=_merge(dae.dependencies, names),
    )


def _base(group: Sequence[Variable]) -> str:
    return group[0].name if len(group) == 1 else group[0].name.rpartition("[")[0]


def _order(description: Description) -> dict[str, int]:
    """Give the reference of each state's derivative."""
    return {
        v.derivative_of: v.reference for v in description.variables if v.derivative_of is not None
    }


def _runs(variables: Sequence[Variable], order: Mapping[str, int]) -> list[list[Variable]]:
    """Split into elements 0, 1, ... of one array each, all of them states or none."""
    runs: list[list[Variable]] = []
    for variable in variables:
        last = runs[-1] if runs else []
        if last and variable.name == _next(last) and _alike(last[-1], variable, order):
            last.append(variable)
        else:
            runs.append([variable])
    return runs


def _next(run: Sequence[Variable]) -> str | None:
    """Give the name of the element that would go on with a run; None: it is no array."""
    first = re.fullmatch(r"(.+)\[0\]", run[0].name)
    return f"{first[1]}[{len(run)}]" if first else None


def _alike(one: Variable, other: Variable, order: Mapping[str, int]) -> bool:
    """Whether they may stand in one array: all of it states, whose derivatives follow each other too, or none."""
    return (
        other.reference == one.reference + 1
        and (one.causality, one.unit, one.variability)
        == (other.causality, other.unit, other.variability)
        and (one.name in order) == (other.name in order)
        and (one.name not in order or order[other.name] == order[one.name] + 1)
    )


def _together(group: Sequence[Variable], array_of: Mapping[str, str]) -> Variable:
    first = group[0]
    of = None if first.derivative_of is None else array_of[first.derivative_of]
    if len(group) == 1:
        return replace(first, derivative_of=of)
    initial = first.initial if len({v.initial for v in group}) == 1 else "calculated"
    starts = [v.start for v in group if v.start is not None]
    start = (
        tuple(value for values in starts for value in values)
        if len(starts) == len(group) and initial != "calculated"
        else None
    )
    size = len(group)
    return replace(
        first,
        name=_base(group),
        size=size,
        dimensions=(size,),
        initial=initial,
        start=start,
        derivative_of=of,
    )


def _merged(found: Iterable[str], names: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(names[name] for name in found))


def _merge(
    found: Mapping[str, tuple[str, ...] | None], names: Mapping[str, str]
) -> dict[str, tuple[str, ...] | None]:
    """Give what arrays depend on: what any of their elements does; None where one does not say."""
    merged: dict[str, tuple[str, ...] | None] = {}
    for name, needs in found.items():
        known = merged.get(names[name], ())
        merged[names[name]] = (
            None
            if needs is None or known is None
            else _merged((*known, *needs), {**names, **_itself(known)})
        )
    return merged


def _itself(found: Iterable[str]) -> dict[str, str]:
    return {name: name for name in found}
