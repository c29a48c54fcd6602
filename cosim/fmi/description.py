"""The content of a modelDescription.xml, independent of the FMI version.

``describing.py`` builds it for a model of ours; ``reading/`` reads it from an FMU, ``exporting/``
writes it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal, TypeAlias

from cosim.arrays import Mask
from cosim.core.recorded.selection import is_pattern, matches
from cosim.core.signals import Interface, Need, Role, Signal
from cosim.errors import FmuError, nearest
from cosim.fmi.references import ReferenceMap
from cosim.fmi.variable import Variable
from cosim.units import Unit

InterfaceType: TypeAlias = Literal["me", "cs"]  # model exchange, co-simulation
PortVariables: TypeAlias = tuple[tuple[Signal, tuple[Variable, ...]], ...]
VariableDependencies: TypeAlias = Mapping[str, tuple[str, ...] | None]  # None: not declared
INTERFACE_TYPES: tuple[InterfaceType, ...] = ("me", "cs")
INTERFACE_TYPE_NAMES: Mapping[InterfaceType, str] = {"me": "model exchange", "cs": "co-simulation"}
ELEMENT: Final = re.compile(r"(?P<name>.*[^\]])\[(?P<number>[0-9]{1,9})\]")
# Begins the description of a variable that may have no value; FMI has no other word for it.
NO_VALUE: Final = "NaN: no value yet"


@dataclass(frozen=True, slots=True)
class Capabilities:
    """What an FMU can do with one interface type (FMI 2.0.4 and 3.0 sections 3.3.1 and 4.3.1)."""

    identifier: str = ""
    directional_derivatives: bool = False
    adjoint_derivatives: bool = False  # FMI 3
    saves_state: bool = False
    serializes_state: bool = False
    # Co-simulation: by input derivatives (FMI 1 and 2), in Intermediate Updates (FMI 3).
    interpolates_inputs: bool = False
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
        What it depends on; None: not declared.
    index : int or None
        How often it must be differentiated, where that is said.
    """

    name: str
    dependencies: tuple[str, ...] | None = None
    index: int | None = None


@dataclass(frozen=True, slots=True)
class Dae:
    """The residual form beside the ordinary one (FMI-LS-DAE, a draft).

    ::

        x' = f(t, x, z, u)
        0  = g(t, x, z, u)
        y  = h(t, x, z, u)

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
        What is wrong with the form; if there are problems, it is not to be used.
    """

    version: str
    algebraic: tuple[str, ...] = ()
    residuals: tuple[tuple[Formulation, ...], ...] = ()
    dependencies: VariableDependencies = field(default_factory=dict)
    problems: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Description:
    """The description of an FMU or of a generated model.

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
        What each depends on directly; None: not declared.
    initial_dependencies : mapping of unknown name to variable names, or to None
        The same in Initialization Mode (InitialUnknowns), for the unknowns that are listed there.
    unnamed_states : int
        Number of continuous states that have no names: all of FMI 1.
    capabilities : mapping of InterfaceType to Capabilities
        The interface types that are there.
    event_indicators : int
        Number of their elements.
    indicators : tuple of str
        Names of the variables that are event indicators (FMI 3).
    clocks : tuple of str
        Names of the variables that are clocks.
    platforms : tuple of str
        Folders under ``binaries/`` that hold something.
    local_states : tuple of str
        Names of the states of a loaded FMU that are local variables. They are read with the
        outputs, since a log holds every state.
    recorded : tuple of str
        Names of further variables of a loaded FMU that are read with the outputs, since the user
        asks for them.
    apart : frozenset of str
        Names of variables that are signals of their own, though they may look like elements.
    default_step, default_tolerance : float or None
        Of DefaultExperiment.
    tool : str
        What made it.
    set_inputs : frozenset of str
        Names of the inputs whose ``start`` was set instead of the FMU's own.
    dae : Dae or None
        Its residual form, where it has one.
    scheduled_execution : bool
        Whether it has the interface type Scheduled Execution (FMI 3), which is not supported.
    drives_clocks : bool
        Whether its clocks are activated. Those that are triggered are ports then, Booleans that
        are 1 where the clock ticks.
    """

    name: str
    token: str
    version: str
    variables: tuple[Variable, ...]
    states: tuple[str, ...] = ()
    dependencies: VariableDependencies = field(default_factory=dict)
    initial_dependencies: VariableDependencies = field(default_factory=dict)
    unnamed_states: int = 0
    capabilities: Mapping[InterfaceType, Capabilities] = field(default_factory=dict)
    event_indicators: int = 0
    indicators: tuple[str, ...] = ()
    clocks: tuple[str, ...] = ()
    platforms: tuple[str, ...] = ()
    local_states: tuple[str, ...] = ()
    recorded: tuple[str, ...] = ()
    apart: frozenset[str] = frozenset()
    default_step: float | None = None
    default_tolerance: float | None = None
    tool: str = ""
    set_inputs: frozenset[str] = frozenset()
    dae: Dae | None = None
    scheduled_execution: bool = False
    drives_clocks: bool = False
    _named: dict[str, Variable] = field(init=False, repr=False, compare=False)
    _ports: dict[str, PortVariables] = field(
        init=False, repr=False, compare=False
    )  # those asked for
    _references: dict[str, ReferenceMap] = field(init=False, repr=False, compare=False)  # the same

    def __post_init__(self) -> None:
        named = {variable.name: variable for variable in self.variables}
        object.__setattr__(self, "_named", named)
        object.__setattr__(self, "_ports", {})
        object.__setattr__(self, "_references", {})

    def __contains__(self, name: str) -> bool:
        """Return whether there is a variable of that name."""
        return name in self._named

    def __getitem__(self, name: str) -> Variable:
        """Return a variable by name.

        Raises
        ------
        FmuError
            If there is none of that name; with the nearest one.
        """
        variable = self._named.get(name)
        if variable is None:
            raise FmuError(f"{self.name}: no variable {name!r}; {nearest(name, self._named)}")
        return variable

    def ports(self, causality: str) -> PortVariables:
        """Return the signals of one causality, in order, with the variables of their elements.

        Local states, then other variables that are recorded, stand behind the outputs. Aliases
        (``alias_of``) are left out, unless they are recorded.
        """
        if causality not in self._ports:
            self._ports[causality] = self._find_ports(causality)
        return self._ports[causality]

    def _find_ports(self, causality: str) -> PortVariables:
        variables = []
        for variable in self.variables:
            is_port = variable.is_signal or (self.drives_clocks and variable.is_triggered)
            if variable.causality == causality and is_port and variable.alias_of is None:
                variables.append(variable)
        if causality == "output":
            variables += [self[name] for name in (*self.local_states, *self.recorded)]
        groups = _vectors(variables, self.apart)
        return tuple((self._signal(name, group), group) for name, group in groups.items())

    def texts(self, causality: str) -> tuple[str, ...]:
        """Return the names of the Strings and Binaries of one causality: they are no signals."""
        variables = [v for v in self.variables if v.causality == causality and v.alias_of is None]
        return tuple(v.name for v in variables if v.type in ("String", "Binary"))

    def references(self, causality: str) -> ReferenceMap:
        """Return all inputs or outputs with their value references, in the interface's order."""
        if causality not in self._references:
            variables: list[Variable] = []
            for _, group in self.ports(causality):
                variables += group
            self._references[causality] = ReferenceMap.of(variables)
        return self._references[causality]

    def values(self, causality: str) -> ReferenceMap:
        """Return the inputs or outputs that have values, a selection of all: clocks have none."""
        references = self.references(causality)
        if not self.drives_clocks:
            return references
        return references.select(references.where(lambda variable: variable.is_signal))

    def unclocked(self, causality: str) -> ReferenceMap:
        """Return the inputs or outputs that belong to no clock, a selection of all."""
        references = self.references(causality)
        if not self.drives_clocks:
            return references
        return references.select(references.where(_is_unclocked))

    def references_of(self, names: Iterable[str]) -> ReferenceMap:
        """Return variables with their value references, by name."""
        return ReferenceMap.of(self[name] for name in names)

    @property
    def missing_interface(self) -> str:
        """What to say where there is neither model exchange nor co-simulation."""
        if self.scheduled_execution:
            return (
                "scheduled execution only (FMI 3.0 section 5), which is not supported; expected "
                "model exchange or co-simulation"
            )
        return "neither model exchange nor co-simulation; expected one of them"

    @property
    def discrete_inputs(self) -> Mask:
        """Which elements of the input vector keep their value between events, shape (n_u,)."""
        return self.references("input").where(lambda v: v.variability != "continuous")

    @property
    def has_discrete_parts(self) -> bool:
        """Whether it shows that it may have events of its own: by indicators, clocks, variables."""
        if self.event_indicators or self.clocks:
            return True
        own = [variable for variable in self.variables if variable.causality != "input"]
        return any(variable.variability == "discrete" for variable in own)

    @property
    def undoes_discarded_steps(self) -> bool:
        """Whether a step that the FMU discards leaves it as it was (FMI 3).

        In FMI 1 and 2, the master must restore a saved state.
        """
        return not self.version.startswith(("1.", "2."))

    @property
    def interpolated_inputs(self) -> Mask:
        """Which elements of the input vector can be interpolated inside a step, shape (n_u,).

        Only an FMU with that capability does so.
        """
        return self.references("input").where(_can_be_interpolated)

    @property
    def one_value_inputs(self) -> tuple[str, ...]:
        """The continuous inputs that have one value over a step in co-simulation."""
        moves = ~self.discrete_inputs
        if self.capabilities["cs"].interpolates_inputs:
            moves &= ~self.interpolated_inputs
        names = []
        first = 0
        for signal, _ in self.ports("input"):
            if moves[first : first + signal.size].any():
                names.append(signal.name)
            first += signal.size
        return tuple(names)

    @property
    def n_states(self) -> int:
        """Number of continuous state elements."""
        return self.unnamed_states + sum(self[name].size for name in self.states)

    @property
    def interface(self) -> Interface:
        """Inputs, outputs and feedthrough, vectors put together again."""
        inputs = self.ports("input")
        outputs = self.ports("output")
        input_of: dict[str, str] = {}
        for signal, group in inputs:
            input_of |= {variable.name: signal.name for variable in group}
        direct: dict[str, tuple[str, ...] | None] = {}
        for _, group in outputs:
            direct |= {variable.name: self._direct(variable) for variable in group}
        initially = {**direct, **self.initial_dependencies}
        feedthrough = {}
        initial_feedthrough = {}
        for signal, group in outputs:
            feedthrough[signal.name] = _inputs_behind(group, direct, input_of)
            if any(variable.name in self.initial_dependencies for variable in group):
                initial_feedthrough[signal.name] = _inputs_behind(group, initially, input_of)
        input_signals = tuple(signal for signal, _ in inputs)
        output_signals = tuple(signal for signal, _ in outputs)
        return Interface(input_signals, output_signals, feedthrough, initial_feedthrough)

    def _direct(self, variable: Variable) -> tuple[str, ...] | None:
        """Return what an output depends on directly: a state on nothing; None: not declared.

        Nor does a parameter, a constant or a time-based clock.
        """
        if variable.name in self.states or variable.is_time_based:
            return ()
        is_constant = variable.variability in ("constant", "fixed", "tunable")
        names = self.dependencies.get(variable.name, () if is_constant else None)
        # It also depends on its clocks, whether the file lists them or not (FMI 3.0 section 2.2.9).
        return names if names is None else (*names, *variable.clocks)

    def calling(self, names: Collection[str]) -> Description:
        """Return the description with each input by the one of its names that is given, if any is.

        Raises
        ------
        FmuError
            If two names of one input are given.
        """
        called = self._called(names)
        if not called:
            return self
        new_names = {first: variable.name for first, variable in called.items()}
        variables = []
        for variable in self.variables:
            if variable.name in called:  # its place goes to the other name
                variable = replace(called[variable.name], alias_of=None)
            elif variable.alias_of in called:
                first = self[variable.alias_of]
                is_called = variable.name == new_names[first.name]
                variable = replace(first if is_called else variable, alias_of=new_names[first.name])
            variables.append(variable)
        return replace(
            self,
            variables=tuple(variables),
            dependencies=_renamed(self.dependencies, new_names),
            initial_dependencies=_renamed(self.initial_dependencies, new_names),
        )

    def _called(self, names: Collection[str]) -> dict[str, Variable]:
        """Return the aliases of inputs that are given, by the inputs' first names."""
        called: dict[str, Variable] = {}
        for variable in self.variables:
            first = variable.alias_of
            is_input = variable.causality == "input" and variable.is_signal
            if first is None or variable.name not in names or not is_input or variable.negated:
                continue
            other = first if first in names else called.setdefault(first, variable).name
            if other != variable.name:
                raise FmuError(
                    f"{self.name}: {other!r} and {variable.name!r} are one input by two names; "
                    "connect one of them"
                )
        return called

    def without(
        self, capability: Literal["saves_state", "event_mode"], interface_type: InterfaceType
    ) -> Description:
        """Return the description of an FMU that cannot do what it says that it can."""
        cannot: dict[str, Any] = {capability: False}
        own = replace(self.capabilities[interface_type], **cannot)
        drives_clocks = self.drives_clocks and capability != "event_mode"
        capabilities = {**self.capabilities, interface_type: own}
        return replace(self, capabilities=capabilities, drives_clocks=drives_clocks)

    def recording(self, names: Sequence[str]) -> Description:
        """Return the description with further variables among the outputs.

        Parameters
        ----------
        names : sequence of str
            Of variables, or of vectors of which scalars ``n[1], n[2], ...`` are the elements, or
            patterns, such as ``damper.*``. Outputs may be among them.

        Raises
        ------
        FmuError
            If there is no such variable, it is an input or no number, or is named twice, or a
            pattern matches none that can be recorded.
        """
        named: dict[str, Variable] = {}
        for name in names:
            if name not in self and is_pattern(name):
                continue
            for variable in [self[name]] if name in self else self._vector(name):
                problem = self._recording_problem(variable)
                if problem:
                    raise FmuError(f"{self.name}: outputs: {name!r} {problem}")
                if variable.name in named:
                    raise FmuError(f"{self.name}: outputs: {variable.name!r} is named twice")
                named[variable.name] = variable
        for name in names:
            if name not in self and is_pattern(name):
                named |= self._matching(name)
        recorded = []
        for variable in named.values():
            is_output = variable.causality == "output" and variable.alias_of is None
            if not is_output and variable.name not in self.local_states:
                recorded.append(variable.name)
        return replace(self, recorded=tuple(recorded))

    def _matching(self, pattern: str) -> dict[str, Variable]:
        """Return the variables that a pattern stands for, of those that can be recorded."""
        found = {}
        for variable in self.variables:
            if matches(pattern, variable.name) and not self._recording_problem(variable):
                found[variable.name] = variable
        if not found:
            names = [variable.name for variable in self.variables]
            raise FmuError(
                f"{self.name}: outputs: no variable that can be recorded matches {pattern!r}; "
                f"{nearest(pattern, names)}"
            )
        return found

    def _vector(self, name: str) -> list[Variable]:
        """Return the elements of a vector of scalars; refuse a name that is none."""
        prefix = f"{name}["
        candidates = [v for v in self.variables if v.name.startswith(prefix) and v.is_signal]
        for family in _families(candidates).values():
            if next(iter(family.values())).name.startswith(prefix) and _is_vector(family):
                return [family[number] for number in sorted(family)]
        return [self[name]]

    def _recording_problem(self, variable: Variable) -> str | None:
        """Return why a variable cannot be an output."""
        if variable.is_time_based or (variable.is_triggered and variable.causality != "input"):
            return None if self.drives_clocks else "is a clock, and none is activated"
        if variable.causality == "input":
            return "is an input, and recorded as one"
        if not variable.is_signal:
            return f"has the type {variable.type}, which is not recorded"
        return None

    def resized(self, structural: Mapping[str, int]) -> Description:
        """Return the description with other values of structural parameters.

        Arrays whose size changes lose their start values (FMI 3.0 section 2.4.7.5.1).

        Raises
        ------
        FmuError
            If there is no such structural parameter, or the value is none that it may have.
        """
        for name, value in structural.items():
            self._check_structural(self[name], value)
        variables = tuple(self._resized(variable, structural) for variable in self.variables)
        event_indicators = self.event_indicators
        if self.indicators:
            sizes = {variable.name: variable.size for variable in variables}
            event_indicators = sum(sizes[name] for name in self.indicators)
        return replace(self, variables=variables, event_indicators=event_indicators)

    def with_inputs(self, values: Mapping[str, tuple[float, ...]]) -> Description:
        """Return the description with other start values of its inputs, of those that are named.

        Raises
        ------
        FmuError
            If an input is one vector with others that have no start value.
        """
        names: set[str] = set()
        variables = []
        for variable in self.variables:
            value = values.get(variable.name)
            if variable.causality == "input" and value is not None:
                variable = replace(variable, start=value)
                names.add(variable.name)
            variables.append(variable)
        described = replace(self, variables=tuple(variables), set_inputs=frozenset(names))
        for signal, group in described.ports("input"):
            if signal.connection != "required":
                continue
            if any(variable.name in names for variable in group):
                missing = ", ".join(v.name for v in group if v.start is None)
                raise FmuError(
                    f"{self.name}: input {signal.name!r} has start values for some of its "
                    f"elements; expected one for {missing} too"
                )
        return described

    def _check_structural(self, variable: Variable, value: int) -> None:
        where = f"{self.name}: structural parameter {variable.name!r}"
        if variable.causality != "structuralParameter":
            raise FmuError(
                f"{self.name}: {variable.name!r} is no structural parameter, "
                f"but of causality {variable.causality}"
            )
        smallest = max(1, variable.minimum)
        if value % 1 != 0 or not smallest <= value <= variable.maximum:
            expected = f"an integer from {smallest:g} to {variable.maximum:g}"
            raise FmuError(f"{where}: expected {expected}, got {value}")

    def _resized(self, variable: Variable, structural: Mapping[str, int]) -> Variable:
        name = variable.alias_of or variable.name
        if name in structural:
            return replace(variable, start=(float(structural[name]),))
        if not any(dimension in structural for dimension in variable.dimensions):
            return variable
        size = 1
        for dimension in variable.dimensions:
            size *= self._length(dimension, structural)
        if size == variable.size:
            return variable
        return replace(variable, size=size, start=None, text=None)

    def _length(self, dimension: int | str, structural: Mapping[str, int]) -> int:
        """Return the length of a dimension: a number, or the value of a structural parameter."""
        if isinstance(dimension, int):
            return dimension
        if dimension in structural:
            return int(structural[dimension])
        start = self[dimension].start or (1,)
        return int(start[0])

    def reduced(self, names: Iterable[str]) -> Description:
        """Return the description without the variables that a run with its outputs does not need.

        What is kept: ports, states and derivatives, event indicators, clocks, structural
        parameters, and ``names``.
        """
        needed = {*names, *self.states, *self.indicators, *self.clocks, *self.recorded}
        if self.dae is not None:
            return self
        ports = ("input", "output", "structuralParameter")
        variables = []
        for variable in self.variables:
            is_needed = variable.name in needed or variable.derivative_of is not None
            if is_needed or variable.causality in ports:
                variables.append(variable)
        return replace(self, variables=tuple(variables))

    def _signal(self, name: str, group: Sequence[Variable]) -> Signal:
        first = group[0]
        role: Role = "output"
        element = ELEMENT.fullmatch(first.name)
        is_vector = element is not None and element["name"] == name
        start: tuple[float, ...] = ()
        connection: Need = "required"
        if first.causality == "input" and not first.is_time_based:
            role = "input"
            start = _start(group)
            connection = self._need(group)
        elif all(variable.name in self.states for variable in group):
            role = "state"
        signal = Signal(
            name,
            size=sum(variable.size for variable in group),
            unit=first.unit,
            variability="continuous" if first.variability == "continuous" else "discrete",
            type=first.signal_type,
            role=role,
            optional=all(variable.doc.startswith(NO_VALUE) for variable in group),
            base=first.base,
            first=int(element["number"]) if element is not None and is_vector else 0,
            start=start,
            connection=connection,
            nominal=_nominal(group),
            description=_doc(group),
        )
        units = [Unit(variable.unit, variable.base) for variable in group]
        return signal if len(set(units)) == 1 else signal.in_units(units)

    def _need(self, group: Sequence[Variable]) -> Need:
        """Return whether something must drive an input: where an element has no start value."""
        if any(variable.start is None and variable.is_signal for variable in group):
            return "required"
        is_set = any(variable.name in self.set_inputs for variable in group)
        return "forbidden" if is_set else "optional"


def _doc(group: Sequence[Variable]) -> str:
    """Return what the variables of a group are, each text once."""
    texts = (variable.doc.removeprefix(NO_VALUE).removeprefix("; ") for variable in group)
    return "; ".join(dict.fromkeys(text for text in texts if text))


def _nominal(group: Sequence[Variable]) -> tuple[float, ...]:
    """Return the nominal values of the elements of a group; empty: none declares one."""
    if all(variable.nominal is None for variable in group):
        return ()
    values: list[float] = []
    for variable in group:
        values += [usable_nominal(variable.nominal)] * variable.size
    return tuple(values)


def _renamed(dependencies: VariableDependencies, names: Mapping[str, str]) -> VariableDependencies:
    """Return dependencies on variables by other names."""
    renamed: dict[str, tuple[str, ...] | None] = {}
    for unknown, knowns in dependencies.items():
        renamed[unknown] = knowns and tuple(names.get(known, known) for known in knowns)
    return renamed


def usable_nominal(nominal: float | None) -> float:
    """Return a nominal value to scale with: 1 where there is none.

    One of 0 says nothing, and a negative one is meant by its size (FMI 3.0 section 2.4.7.4).
    """
    size = abs(nominal or 1.0)
    return size if size < math.inf else 1.0


def _is_unclocked(variable: Variable) -> bool:
    return variable.is_signal and not variable.clocks


def _can_be_interpolated(variable: Variable) -> bool:
    is_real = variable.type == "Float64"
    return is_real and variable.variability == "continuous" and variable.inside_steps


def _inputs_behind(
    group: Sequence[Variable],
    dependencies: VariableDependencies,
    input_of: Mapping[str, str],
) -> tuple[str, ...] | None:
    """Return the inputs on which a group of variables depends; None: not declared for one."""
    inputs: set[str] = set()
    for variable in group:
        names = dependencies[variable.name]
        if names is None:
            return None
        inputs.update(input_of[name] for name in names if name in input_of)
    in_order = dict.fromkeys(input_of.values())
    return tuple(name for name in in_order if name in inputs)


def _start(group: Sequence[Variable]) -> tuple[float, ...]:
    """Return the start values of an input, 0 where an element has none; empty if all are 0."""
    values: list[float] = []
    for variable in group:
        values += variable.start or (0.0,) * variable.size
    return tuple(values) if any(values) else ()


def _vectors(
    variables: Sequence[Variable], apart: Collection[str]
) -> dict[str, tuple[Variable, ...]]:
    """Combine scalars ``n[0], n[1], ...`` (or from 1) to vectors; others, or ``apart``, stay alone.

    A vector stands where the first of its elements stands in the file.
    """
    vectors: dict[str, tuple[Variable, ...]] = {}
    vector_of: dict[str, str] = {}
    for name, family in _families(variables).items():
        is_apart = any(variable.name in apart for variable in family.values())
        if _is_vector(family) and not is_apart:
            vectors[name] = tuple(family[number] for number in sorted(family))
            vector_of |= {variable.name: name for variable in vectors[name]}
    groups: dict[str, tuple[Variable, ...]] = {}
    for variable in variables:
        vector = vector_of.get(variable.name)
        if vector is None:
            groups[variable.name] = (variable,)
        else:
            groups[vector] = vectors[vector]
    return groups


def _families(variables: Sequence[Variable]) -> dict[str, dict[int, Variable]]:
    """Return the scalars whose names differ only in a number, by name and number.

    The name before the number must be no other variable's.
    """
    names = {variable.name for variable in variables}
    families: dict[str, dict[int, Variable]] = {}
    for variable in variables:
        element = ELEMENT.fullmatch(variable.name)
        if element and variable.size == 1 and element["name"] not in names:
            family = families.setdefault(element["name"], {})
            family[int(element["number"])] = variable
    return families


def _is_vector(family: Mapping[int, Variable]) -> bool:
    """Return whether scalars, by their numbers, are the elements of one vector.

    Those of different units are so where they are numbered from 0: an element of the vector then
    has the name of its variable.
    """
    first = min(family)
    has_gaps = max(family) - first >= len(family)
    types = {(v.signal_type, v.variability) for v in family.values()}
    units = {(v.unit, v.base) for v in family.values()}
    names = {name for name, _ in units}
    has_units = len(units) == 1 or (first == 0 and None not in names)
    return first in (0, 1) and not has_gaps and len(types) == 1 and has_units
