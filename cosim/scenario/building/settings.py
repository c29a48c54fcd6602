"""Parameters that actions set: of cosim's own components by another component, of FMUs in place.

The state stays; what follows from the parameters is computed anew, before the run. A component of
cosim's own is built and designed once more, with the new values, and takes over the state. Its
design is recorded, and a replay takes it from there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import ValidationError

from cosim.blocks.declared import with_units
from cosim.core.contracts import Component, Design, Stopped
from cosim.core.graph import Graph
from cosim.core.port import Port
from cosim.core.recording import Recording, SignalEvent
from cosim.core.stepping.actions import AT_CONDITION, NO_VARIANTS, ActedOn, Action, Setting
from cosim.core.stepping.jumps import ParameterValues
from cosim.errors import LogError, RunError, UsageError, listing, nearest, quoted
from cosim.instants import StepNs
from cosim.log.contents.metadata import decode_design, encode_design
from cosim.scenario.building.parsing import Scenario
from cosim.scenario.document.places import Problem
from cosim.scenario.document.problems import TableProblems, problems_of
from cosim.scenario.kinds import Kind
from cosim.scenario.kinds.base import BuildContext, PeriodicKind
from cosim.scenario.kinds.capabilities import TunedInPlace

if TYPE_CHECKING:
    from cosim.fmi.component import Fmu


SETTINGS = "cosim.settings"  # record of the log: designs by time and component


@dataclass(frozen=True, slots=True)
class FmuSetting:
    """Tunable parameters of an FMU are set.

    Parameters
    ----------
    name : str
        Of its component.
    fmu : Fmu
    settings : mapping of parameter to values
    """

    name: str
    fmu: Fmu
    settings: ParameterValues
    variants: ClassVar[Mapping[str, Component]] = NO_VARIANTS
    transfers: ClassVar[bool] = False

    def perform(self, simulation: ActedOn) -> None:
        """Set them; the outputs follow."""
        try:
            self.fmu.tune(simulation.t, self.settings)
        except RunError as error:
            raise Stopped(np.empty((0, 0)), str(error)).at(self.name, simulation.t) from error
        simulation.change(self.name, self.settings)


class SettingBuilder:
    """Makes actions of the parameters that are set, in the order of time.

    Parameters
    ----------
    scenario : Scenario
    context : BuildContext
        In which the components of the run were built.
    components : mapping of name to Component
        Those of them that are right.
    """

    def __init__(
        self,
        scenario: Scenario,
        context: BuildContext,
        components: Mapping[str, Component],
    ) -> None:
        self._components = components
        self._scenario = scenario
        self._context = context
        self._specs = dict(scenario.specs)  # as they are at the time reached

    def is_fmu(self, name: str) -> bool:
        """Return whether the parameters of a component are those of an FMU, set in place."""
        return isinstance(self._specs[name], TunedInPlace)

    def action(self, name: str, values: Mapping[str, Any]) -> Action:
        """Return what sets parameters of a component.

        Raises
        ------
        TableProblems
            If one cannot be set, with those that can, or a value does not fit; their keys are
            parameters.
        CosimError
            If the component cannot be built with them.
        """
        spec = self._specs[name]
        self._check_names(name, spec, values)
        if isinstance(spec, TunedInPlace):
            from cosim.fmi.driving.tuning import check_tuning  # where there is an FMU

            fmu = spec.tuned_fmu(name, self._context)
            _check_starts(values)
            return FmuSetting(name, fmu, check_tuning(fmu.description, values))
        _check_values(spec, values)
        self._check_readers(name)
        spec = _changed(spec, values)
        component = self._component(name, spec)
        if component.interface != self._components[name].interface:
            raise UsageError(
                f"the new values change the signals or the direct feedthrough of {name!r}; "
                "expected values of the same sizes that keep both"
            )
        self._specs[name] = spec
        return Setting(name, component, {key: _numbers(value) for key, value in values.items()})

    def recorded(self, name: str, values: ParameterValues) -> Action:
        """Return what set parameters of a component in a recorded run."""
        spec = self._specs[name]
        plain = {key: _like(getattr(spec, key, None), own) for key, own in values.items()}
        return self.action(name, plain)

    def _check_names(self, name: str, spec: Kind, values: Mapping[str, Any]) -> None:
        known = spec.tunable_parameters
        if isinstance(spec, TunedInPlace):
            from cosim.fmi.driving.tuning import tunable_parameters  # where there is an FMU

            known = tunable_parameters(spec.tuned_fmu(name, self._context).description)
        problems: list[Problem] = []
        for key in values:
            if not key:
                there_are = f"; available: {', '.join(known)}" if known else "; none is available"
                text = f"expected a tunable parameter of {name!r}, got none{there_are}"
                problems.append(((key,), text))
            elif key not in known and key in spec.tunable:
                text = (
                    f"expected a number or a list of numbers for {key!r} in the table of {name!r}"
                )
                problems.append(((key,), text))
            elif key not in known:
                there_are = f"tunable: {', '.join(known)}" if known else "none is tunable"
                is_there = key in type(spec).model_fields
                suggestion = there_are if is_there or not known else nearest(key, known)
                problems.append(
                    ((key,), f"{name!r} has no tunable parameter {key!r}; {suggestion}")
                )
        if problems:
            raise TableProblems(problems)

    def _check_readers(self, name: str) -> None:
        """Check that no other component is designed on what is set.

        Raises
        ------
        UsageError
            If one is.
        """
        table = f"components.{name}"
        readers = []
        for other, tables in self._context.reads.items():
            if table in tables and other not in ("", name):
                readers.append(other)
        if readers:
            raise UsageError(
                f"{name!r} cannot change during the run: {listing(readers)} is derived from its "
                "table"
            )

    def _component(self, name: str, spec: Kind) -> Component:
        """Build a component with other parameters, in a context of its own."""
        scenario = replace(self._scenario, specs={**self._specs, name: spec})
        context = self._context.beside(scenario, name)
        component = spec.build(name, context)
        component = with_units(component, spec.units_of(component.interface))
        if not isinstance(spec, PeriodicKind):
            return component
        return spec.with_period(component, spec.period_steps(name, context.step_ns))


def _check_values(spec: Kind, values: Mapping[str, Any]) -> None:
    """Check that values are numbers, or lists of them, or true or false where the table has that.

    Raises
    ------
    TableProblems
        If one is something else.
    """
    problems = []
    for key, value in values.items():
        if isinstance(getattr(spec, key), bool):
            is_right = isinstance(value, bool)
            needed = "true or false"
        else:
            is_right = all(map(_is_number, _row(value)))
            needed = "a number or a list of numbers"
        if not is_right:
            problems.append(((key,), f"expected {needed}, got {quoted(value)}"))
    if problems:
        raise TableProblems(problems)


def _check_starts(values: Mapping[str, Any]) -> None:
    """Check that values for an FMU are numbers or texts, or lists of them, nested or not.

    Raises
    ------
    TableProblems
        If one is something else.
    """
    problems = []
    for key, value in values.items():
        if not _is_start(value):
            text = f"expected a number, a string, or a list of these, got {quoted(value)}"
            problems.append(((key,), text))
    if problems:
        raise TableProblems(problems)


def _is_start(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return all(map(_is_start, value))
    return isinstance(value, bool | int | float | str)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _row(value: Any) -> Sequence[Any]:
    return value if isinstance(value, list | tuple) else [value]


def _changed(spec: Kind, values: Mapping[str, Any]) -> Kind:
    """Return a table with other values.

    Raises
    ------
    TableProblems
        If one does not fit.
    """
    table = {**spec.model_dump(exclude_unset=True, by_alias=True), **values}
    try:
        return type(spec).model_validate(table)
    except ValidationError as error:
        raise TableProblems(problems_of(error, type(spec), table, ())) from error


def _numbers(value: Any) -> tuple[float, ...]:
    return tuple(map(float, _row(value)))


def _like(current: Any, values: Sequence[float]) -> Any:
    """Return recorded values as a table has them."""
    if isinstance(current, bool):
        return bool(values[0])
    if isinstance(current, tuple) or len(values) != 1:
        return list(values)
    return values[0]


def recorded_settings(
    builder: SettingBuilder, events: Sequence[SignalEvent], copied: Sequence[str]
) -> dict[tuple[int, str], Action]:
    """Return what sets the parameters in a replay, by time [ns] and component.

    Parameters
    ----------
    builder : SettingBuilder
    events : sequence of SignalEvent
        Of the recorded run, in the order of time.
    copied : sequence of str
        Components that are taken from the recording.

    Raises
    ------
    LogError
        If an event does not fit the scenario.
    """
    values: dict[tuple[int, str], dict[str, tuple[float, ...]]] = {}
    for event in events:
        if event.cause == "set":
            port = Port.parse(event.signal)
            if port.component not in copied:
                values.setdefault((event.time_ns, port.component), {})[port.name] = event.values
    actions = {}
    for (time_ns, name), own in values.items():
        try:
            actions[time_ns, name] = builder.recorded(name, own)
        except (UsageError, KeyError) as error:
            where = f"{name!r} at t = {time_ns / 1e9} s"
            raise LogError(f"the recorded event of {where} does not match: {error}") from error
    return actions


def prepare_settings(
    graph: Graph,
    step_ns: StepNs,
    settings: Mapping[tuple[int, str], Action],
    recorded: Mapping[str, Design],
) -> dict[str, str]:
    """Prepare the components that take the places of others; return their designs for the log.

    Parameters
    ----------
    graph : Graph
    step_ns : int
        Communication step [ns].
    settings : mapping of (int, str) to Action
        By time [ns] and component; ``AT_CONDITION`` where the time is not known.
    recorded : mapping of record to Design
        Those to use instead of computing them.

    Raises
    ------
    GraphError, AssumptionError
        If one cannot take the place of the other, or not be designed.
    """
    designs = {}
    for (time_ns, name), action in settings.items():
        for component in action.variants.values():
            key = f"{time_ns} {name}"
            taken = recorded.get(key) or recorded.get(f"{AT_CONDITION} {name}") or {}
            design = graph.prepare_variant(
                name, component, step_ns, taken, transfers=action.transfers
            )
            designs[key] = encode_design(design)
    return designs


def recorded_designs(recording: Recording) -> dict[str, Design]:
    """Return the designs of a log of the components that took the places of others.

    Raises
    ------
    LogError
        If they cannot be understood.
    """
    designs: dict[str, Design] = {}
    for key, text in recording.metadata.get(SETTINGS, {}).items():
        try:
            designs[key] = decode_design(text)
        except (ValueError, KeyError, TypeError) as error:
            raise LogError(f"{SETTINGS} of {recording.label} is damaged: {error}") from error
    return designs
