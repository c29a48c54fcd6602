"""What a unit says about itself: the content of a modelDescription.xml, independent of the FMI version.

``describe`` gives it for a model of ours; ``reading/`` takes it from an FMU, ``exporting/`` writes it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

from cosim.arrays import Mask
from cosim.core.signals import Interface, Signal
from cosim.errors import FmuError, nearest
from cosim.fmi.references import ReferenceMap
from cosim.fmi.variable import Variable

InterfaceType: TypeAlias = Literal["me", "cs"]  # model exchange, co-simulation
INTERFACE_TYPES: tuple[InterfaceType, ...] = ("me", "cs")
INTERFACE_TYPE_NAMES: Mapping[InterfaceType, str] = {"me": "model exchange", "cs": "co-simulation"}
NO_VALUE = "NaN: no value yet"  # begins the description of a variable that may have none; FMI has no other word for it


@dataclass(frozen=True, slots=True)
class Capabilities:
    """What one kind of a unit can do (FMI 2.0.4 sections 3.3.1 and 4.3.1, FMI 3.0 sections 3.3.1 and 4.3.1)."""

    identifier: str = ""
    directional_derivatives: bool = False
    adjoint_derivatives: bool = False  # FMI 3
    saves_state: bool = False
    serializes_state: bool = False
    interpolates_inputs: bool = (
        False  # co-simulation: input derivatives (FMI 1 and 2), Intermediate Update (FMI 3)
    )
    variable_step: bool = False  # co-simulation
    fixed_step: float | None = None  # co-simulation, FMI 3 [s]
    event_mode: bool = False  # co-simulation, FMI 3
    early_return: bool = False  # co-simulation, FMI 3: may return early of its own
    completed_step: bool = True  # model exchange: wants completed_integrator_step
    once_per_process: bool = False
    needs_tool: bool = False  # to run


@dataclass(frozen=True, slots=True)
class Formulation:
    """A variable that is zero on the solution.

    Parameters
    ----------
    name : str
    dependencies : tuple of str or None
        What it depends on; None: not said.
    index : int or None
        How often it must be differentiated, where that is said.
    """

    name: str
    dependencies: tuple[str, ...] | None = None
    index: int | None = None


@dataclass(frozen=True, slots=True)
class Dae:
    """The residual form beside the ordinary one (FMI-LS-DAE, a draft): x' = f(t, x, z, u), 0 = g(t, x, z, u), y = h(t, x, z, u).

    Parameters
    ----------
    version : str
        Of the layered standard.
    algebraic : tuple of str
        Names of the variables z, which may be set while time moves.
    residuals : tuple of tuple of Formulation
        Of each equation: itself and, where they are given, its derivatives.
    dependencies : mapping of output or derivative name to variable names, or to None
        As in ``Description``, with z among what may be depended on.
    problems : tuple of str
        What is wrong with it; it is then not to be used.
    """

    version: str
    algebraic: tuple[str, ...] = ()
    residuals: tuple[tuple[Formulation, ...], ...] = ()
    dependencies: Mapping[str, tuple[str, ...] | None] = field(default_factory=dict)
    problems: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Description:
    """A unit's description.

    Parameters
    ----------
    name, token : str
        Name of the model; GUID or instantiation token.
    version : str
        FMI version.
    variables : tuple of Variable
        In the order of the file.
    states : tuple of str
        Names of the variables that are continuous states, in the order of the derivatives.
    dependencies : mapping of output or derivative name to variable names, or to None
        What each depends on directly; None: not said.
    initial_dependencies : mapping of unknown name to variable names, or to None
        The same in initialization mode (InitialUnknowns), for the unknowns that are listed there.
    unnamed_states : int
        Number of continuous states that have no names: all of FMI 1.
    capabilities : mapping of Mode to Capabilities
        The kinds that are there.
    event_indicators : int
        Number of their elements.
    indicators : tuple of str
        Names of the variables that are event indicators (FMI 3).
    clocks : tuple of str
        Names of the variables that are clocks.
    platforms : tuple of str
        Folders under ``binaries/`` that hold something.
    read : tuple of str
        Local variables that are read with the outputs: the states of a loaded unit, since a log holds every state.
    default_step, default_tolerance : float or None
        Of DefaultExperiment.
    tool : str
        What made it.
    dae : Dae or None
        Its residual form, where it has one.
    """

    name: str
    token: str
    version: str
    variables: tuple[Variable, ...]
    states: tuple[str, ...] = ()
    dependencies: Mapping[str, tuple[str, ...] | None] = field(default_factory=dict)
    initial_dependencies: Mapping[str, tuple[str, ...] | None] = field(default_factory=dict)
    unnamed_states: int = 0
    capabilities: Mapping[InterfaceType, Capabilities] = field(default_factory=dict)
    event_indicators: int = 0
    indicators: tuple[str, ...] = ()
    clocks: tuple[str, ...] = ()
    platforms: tuple[str, ...] = ()
    read: tuple[str, ...] = ()
    default_step: float | None = None
    default_tolerance: float | None = None
    tool: str = ""
    dae: Dae | None = None
    _named: dict[str, Variable] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_named", {variable.name: variable for variable in self.variables})

    def __contains__(self, name: str) -> bool:
        """Whether there is a variable of that name."""
        return name in self._named

    def __getitem__(self, name: str) -> Variable:
        """Find a variable.

        Raises
        ------
        FmuError
            If there is none of that name; with the nearest one.
        """
        found = self._named.get(name)
        if found is None:
            raise FmuError(f"{self.name}: no variable {name!r}; {nearest(name, self._named)}")
        return found

    def ports(self, causality: str) -> tuple[tuple[Signal, tuple[Variable, ...]], ...]:
        """Give the signals of one causality with the variables that carry their elements, in order.

        What is ``read`` beside the outputs stands behind them. Second names (``alias_of``) are left out.
        """
        beside = [self[name] for name in self.read] if causality == "output" else []
        carried = [
            v
            for v in self.variables
            if v.causality == causality and v.is_signal and v.alias_of is None
        ] + beside
        return tuple((self._signal(name, group), group) for name, group in _vectors(carried))

    def references(self, causality: str) -> ReferenceMap:
        """Return all inputs or outputs with their value references, in the order of the interface."""
        variables: list[Variable] = []
        for _, group in self.ports(causality):
            variables += group
        return ReferenceMap.of(variables)

    def references_of(self, names: Iterable[str]) -> ReferenceMap:
        """Return variables with their value references, by name."""
        return ReferenceMap.of(self[name] for name in names)

    @property
    def discrete_inputs(self) -> Mask:
        """Which elements of the input vector hold their value between events, shape (n_u,)."""
        return self.references("input").where(lambda v: v.variability != "continuous")

    @property
    def undoes_discarded_steps(self) -> bool:
        """Whether a step that it discards leaves it as it was; else the master must restore a saved state (FMI 1 and 2)."""
        return not self.version.startswith(("1.", "2."))

    @property
    def interpolated_inputs(self) -> Mask:
        """Which elements of the input vector can follow a straight line inside a step, if the unit interpolates, shape (n_u,)."""
        return self.references("input").where(
            lambda v: v.variability == "continuous" and v.type == "Float64" and v.inside_steps
        )

    @property
    def n_states(self) -> int:
        """Number of continuous state elements."""
        return self.unnamed_states + sum(self[name].size for name in self.states)

    @property
    def interface(self) -> Interface:
        """Inputs, outputs and feedthrough, vectors put together again."""
        inputs, outputs = self.ports("input"), self.ports("output")
        port_of = {v.name: signal.name for signal, group in inputs for v in group}
        states = set(self.states)
        direct = {
            v.name: () if v.name in states else self.dependencies.get(v.name)
            for _, group in outputs
            for v in group
        }
        at_start = direct | dict(self.initial_dependencies)
        feedthrough = {signal.name: _feeds(group, direct, port_of) for signal, group in outputs}
        initial = {
            signal.name: _feeds(group, at_start, port_of)
            for signal, group in outputs
            if any(v.name in self.initial_dependencies for v in group)
        }
        return Interface(
            tuple(s for s, _ in inputs), tuple(s for s, _ in outputs), feedthrough, initial
        )

    def resized(self, structural: Mapping[str, int]) -> Description:
        """Give the description with other values of structural parameters (FMI 3.0 section 2.4.7.5.1).

        Arrays whose size changes lose their start values, as the standard says.

        Raises
        ------
        FmuError
            If there is no such structural parameter, or the value is none that it may have.
        """
        for name, value in structural.items():
            variable = self[name]
            if variable.causality != "structuralParameter":
                raise FmuError(
                    f"{self.name}: {name!r} is no structural parameter, but of causality {variable.causality}"
                )
            if value % 1 != 0 or not max(1, variable.minimum) <= value <= variable.maximum:
                needed = f"a whole number from {max(1, variable.minimum):g} to {variable.maximum:g}"
                raise FmuError(
                    f"{self.name}: structural parameter {name!r}: found {value}, needed {needed}"
                )
        variables = tuple(self._sized(variable, structural) for variable in self.variables)
        sizes = {variable.name: variable.size for variable in variables}
        indicators = (
            sum(sizes[name] for name in self.indicators)
            if self.indicators
            else self.event_indicators
        )
        return replace(self, variables=variables, event_indicators=indicators)

    def _sized(self, variable: Variable, structural: Mapping[str, int]) -> Variable:
        name = variable.alias_of or variable.name
        if name in structural:
            return replace(variable, start=(float(structural[name]),))
        if not any(dimension in structural for dimension in variable.dimensions):
            return variable
        lengths = [
            d
            if isinstance(d, int)
            else int(structural[d])
            if d in structural
            else int((self[d].start or (1,))[0])
            for d in variable.dimensions
        ]
        size = math.prod(lengths)
        return (
            variable
            if size == variable.size
            else replace(variable, size=size, start=None, text=None)
        )

    def _signal(self, name: str, group: Sequence[Variable]) -> Signal:
        first = group[0]
        is_state = all(v.name in self.states for v in group)
        return Signal(
            name,
            size=sum(v.size for v in group),
            unit=first.unit,
            variability="continuous" if first.variability == "continuous" else "discrete",
            kind=first.kind,
            role="input" if first.causality == "input" else "state" if is_state else "output",
            optional=all(v.doc.startswith(NO_VALUE) for v in group),
            base=first.base,
            start=_starts(group) if first.causality == "input" else (),
        )


def _feeds(
    group: Sequence[Variable],
    dependencies: Mapping[str, tuple[str, ...] | None],
    port_of: Mapping[str, str],
) -> tuple[str, ...] | None:
    """Give the inputs on which a group of variables depends; None: not said of one of them."""
    found: set[str] = set()
    for variable in group:
        names = dependencies[variable.name]
        if names is None:
            return None
        found.update(port_of[name] for name in names if name in port_of)
    return tuple(name for name in dict.fromkeys(port_of.values()) if name in found)


def _starts(group: Sequence[Variable]) -> tuple[float, ...]:
    """Give the start values of an input's elements, 0 where there is none; empty where all are."""
    found = tuple(value for v in group for value in (v.start or (0.0,) * v.size))
    return found if any(found) else ()


def _vectors(variables: Sequence[Variable]) -> list[tuple[str, tuple[Variable, ...]]]:
    """Put scalars ``n[0], n[1], ...`` (or from 1) of equal kind and unit together again; others stand alone."""
    families: dict[str, dict[int, Variable]] = {}
    for variable in variables:
        element = re.fullmatch(r"(.*[^\]])\[(\d+)\]", variable.name)
        if element and variable.size == 1:
            families.setdefault(element[1], {})[int(element[2])] = variable
    names, found, done = {v.name for v in variables}, [], set()
    for variable in variables:
        base = variable.name.rpartition("[")[0]
        family = families.get(base, {})
        numbers, first = sorted(family), min(family, default=0)
        alike = len({(v.kind, v.unit, v.base, v.variability) for v in family.values()}) == 1
        if (
            variable in family.values()
            and alike
            and first in (0, 1)
            and base not in names
            and numbers[-1] - first < len(numbers)
        ):
            if base not in done:
                found.append((base, tuple(family[i] for i in numbers)))
                done.add(base)
        else:
            found.append((variable.name, (variable,)))
    return found
