"""Components by name, the connections between their signals, and the order in which they advance.

Components on a cycle of the graph form a loop; every other component is a cascade, which advances a
whole block in one call. Feedthrough orders only the inside of loops and the initialization.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from functools import cached_property
from itertools import chain

import numpy as np

from cosim.arrays import Mask, Vector
from cosim.core.arguments import (
    check_choice,
    check_iterations,
    check_recorded_designs,
    check_step,
    check_threads,
    checked_components,
    checked_periods,
)
from cosim.core.connections import Connection, SourceText
from cosim.core.contracts import Component, Design, InputWiring, Transfer
from cosim.core.initialization.initial_values import InitialValues
from cosim.core.port import Port
from cosim.core.recorded.run import RecordedRun
from cosim.core.recording import Plan
from cosim.core.signals import Channel, Variability, column_names
from cosim.core.stages.calls import GuardedComponent
from cosim.core.stages.coupling import Stage
from cosim.core.stages.left_limits import JumpColumns
from cosim.core.stages.member import Member, first_non_finite
from cosim.core.stages.stage_builder import InputInterpolation, LoopMethod, StageBuilder
from cosim.core.stages.substep_control import SubstepControl, SubstepTolerance
from cosim.core.stages.wires import Wire, constant_wires, wires_of
from cosim.core.structure.checked_connections import CheckedConnections
from cosim.core.structure.connection_checks import element_warnings, unit_warnings
from cosim.core.structure.feedthrough import early_event_text
from cosim.core.structure.jumping import JumpingOutputs
from cosim.core.structure.order import Coupling
from cosim.core.structure.ports import Ports, layout_of
from cosim.core.structure.variability import Variabilities
from cosim.errors import GraphError, nearest
from cosim.instants import StepNs, step_seconds
from cosim.native.stages.loop_solver import LoopSolver
from cosim.units import Conversion

COUPLINGS: tuple[Coupling, ...] = ("gauss-seidel", "jacobi", "newton")
INTERPOLATIONS: tuple[str, ...] = ("linear", "zero-order", "latest")


class Graph:
    """A checked, ordered and then immutable network of components.

    Parameters
    ----------
    components : mapping of name to Component
    connections : mapping of ``component.input`` to Connection, or to what it takes as its source
        An input is connected as a whole, or by elements: ``component.input[1]``,
        ``component.input[0:2]``, each driven once.
    coupling : {"gauss-seidel", "jacobi", "newton"}
        How the components of a loop advance: one after the other, together, or again and again
        until all inputs at the end of a step are what drives them then (second order).
    input_interpolation : {"linear", "zero-order", "latest"}, optional
        "linear": continuous signals are interpolated linearly inside a step. "zero-order": every
        input holds its value from the start of the step, as in most masters; first order only.
        "latest": it holds the latest value of its source, that at the end of the step where the
        source has advanced before (the classic Gauss-Seidel); first order only. Left out: "linear";
        but inputs that can have one value only over a step get the latest known one, in place of
        the mean of both ends, where what drives them is not continuous by construction and no loop
        solves for its inputs ("newton", iterations, substeps).
    means : collection of str
        Components whose inputs that have one value over a step get the mean all the same.
    iterations : int
        How often a loop takes a step, each time with what the last one gave for the inputs at its
        end, with "gauss-seidel" or "jacobi".
    periods : mapping of component name to int
        Communication steps between the rows that a component's log channel keeps; 1 where not
        named.
    substeps : SubstepTolerance, optional
        What the error of a loop in a step may be: it divides its steps where it is larger.
    threads : {1, 2}, optional
        How many may advance branches that do not depend on each other; two do where that is faster.
        2: also FMUs, but not two with one binary at once; left out: only cosim's own components.
        The bits are the same.
    native : bool
        Advance components by their compiled steps where they have one. The bits are the same
        without, which is how this is tested.

    Attributes
    ----------
    ports : Ports
        Inputs and outputs by their names.
    connections : dict of Port to Connection
        By input, or elements of it.
    conversions : dict of Port to tuple of Conversion
        Where a connection converts units: its conversion for each element of the input.
    unconnected : dict of Port to tuple of float
        The inputs, or elements of them, that nothing drives, and the values that they keep.
    held : dict of component name to Mask, shape (n_u,)
        Which input elements have a zero-order hold.
    means : frozenset of str
        Components that get means whatever drives them, as they were given.
    latest : dict of component name to Mask, shape (n_u,)
        Which have their latest known value over a step, where they can have one only.
    initializations : int
        How often the components were initialized.
    watched : frozenset of component names
        Whose loops end a run where they run away (:mod:`cosim.core.stages.runaway`); to be set.

    Raises
    ------
    GraphError
        All problems together: unknown names, unconnected inputs, sizes, units.
    AlgebraicLoopError
        If there is a discrete signal in a cycle of outputs that feed through to each other.
    """

    def __init__(
        self,
        components: Mapping[str, Component],
        connections: Mapping[str, SourceText | Connection] | Mapping[Port, Connection],
        *,
        coupling: Coupling = "gauss-seidel",
        input_interpolation: InputInterpolation | None = None,
        means: Collection[str] = (),
        iterations: int = 1,
        periods: Mapping[str, int] | None = None,
        substeps: SubstepTolerance | None = None,
        threads: int | None = None,
        native: bool = True,
    ) -> None:
        check_threads(threads)
        self.threads = threads
        self.native = native
        self.watched: frozenset[str] = frozenset()
        self.components = checked_components(components)
        check_choice("coupling", coupling, COUPLINGS)
        interpolation = "linear" if input_interpolation is None else input_interpolation
        check_choice("input_interpolation", interpolation, INTERPOLATIONS)
        self.periods = checked_periods({} if periods is None else periods, self.components)
        check_iterations(iterations, coupling, interpolation)
        self.iterations = iterations
        self.substeps = substeps
        self.coupling = coupling
        self.input_interpolation = input_interpolation
        self.layout = layout_of(self.components, self.periods)
        self.ports = Ports(self.layout)
        self._checked = CheckedConnections(self.ports, connections)
        self.connections = self._checked.by_port
        self.conversions = self._checked.conversions
        self.unconnected = self._checked.unconnected
        self._parts = self._checked.parts
        self._sources = self._checked.sources
        self.means = frozenset(means)
        asked = input_interpolation is not None or substeps is not None
        asked = asked or coupling == "newton" or iterations > 1
        self._variabilities = Variabilities(
            self.ports,
            self.connections,
            self._parts,
            self._sources,
            zero_order=interpolation != "linear",
            means=frozenset(self.components) if asked else self.means,
        )
        self._jumping = JumpingOutputs(self.ports.channels, self._variabilities)
        self.layout = self.layout.with_left_limits(self._columns_of(self._jumping.ports))
        self._jump_sources = self._jumping.sources()
        wires: dict[Port, tuple[Wire, ...]] = {}
        self._members: dict[str, Member] = {}
        for name in self.components:
            wires_of_inputs = self._wires_of(name)
            wires.update(wires_of_inputs)
            self._members[name] = self._member(name, wires_of_inputs)
        method = LoopMethod(coupling, interpolation, iterations, substeps)
        builder = StageBuilder(
            self._members,
            self._checked,
            self._variabilities,
            method,
            jumping=self._jumping.ports,
            left_limits=self.layout.left_limits,
        )
        self.stages = builder.stages(self.components)
        self._torn = builder.torn
        self._early_events = builder.early_events
        self.initializations = 0
        self._initial_values = InitialValues(self.layout, self._members, self._sources, wires)
        self.held: dict[str, Mask] = {}
        self.latest: dict[str, Mask] = {}
        self._wiring: dict[str, InputWiring] = {}
        for stage in self.stages:
            loop = frozenset(member.name for member in stage.members)
            moving = self._variabilities.moving_in(loop)
            for name, channel in ((member.name, member.channel) for member in stage.members):
                extrapolated = stage.extrapolated.get(name, frozenset())
                if coupling != "jacobi":
                    # what a delayed input has at the end of a step is known before it is used
                    extrapolated -= frozenset(channel.interface.delayed)
                held = self._variabilities.held(channel, extrapolated, loop, self._torn)
                self.held[name] = held
                self.latest[name] = self._variabilities.latest(channel, held)
                sources = set(chain.from_iterable(self._sources[name].values()))
                self._wiring[name] = InputWiring(
                    self._variabilities.driven_by(channel, sources),
                    held,
                    self.latest[name],
                    self._variabilities.driven_by(channel, moving, alone=True),
                )

    def wire(self, name: str) -> None:
        """Say to a component what drives its inputs, as ``prepare`` does."""
        self._members[name].component.take_wiring(self._wiring[name])

    def prepare(self, step_ns: StepNs, recorded: Mapping[str, Design] | None = None) -> Plan:
        """Prepare every component for the communication step; return what is fixed by that.

        Parameters
        ----------
        step_ns : int
            Communication step [ns].
        recorded : mapping of component name to Design, optional
            Recorded designs to use instead of computing them.

        Raises
        ------
        GraphError
            If the step is no positive number, or a recorded design is that of no component.
        RunError
            If a component raises a foreign exception, or its design is not finite numbers.
        """
        check_step(step_ns)
        taken: Mapping[str, Design] = {} if recorded is None else recorded
        check_recorded_designs(taken, self.components)
        designs: dict[str, Design] = {}
        for name, member in self._members.items():
            recorded_design = taken.get(name, {})
            designs[name] = self._prepare(name, member.component, step_ns, recorded_design)
        schedule = tuple(stage.description for stage in self.stages)
        return Plan(self.layout, step_ns, designs, self.held, schedule)

    def exchange(self, components: Mapping[str, Component], step_ns: StepNs) -> dict[str, Design]:
        """Put other components in the places of some, and prepare those; return their designs.

        Parameters
        ----------
        components : mapping of component name to Component
        step_ns : int
            Communication step [ns].

        Raises
        ------
        GraphError
            If there is no such component, or it has another interface.
        """
        others = {}
        for name, component in checked_components(components).items():
            if name not in self.components:
                raise GraphError(
                    f"there is no component {name!r}; {nearest(name, self.components)}"
                )
            if component is not self.components[name]:
                others[name] = component
                self._members[name].component.check_exchange(component)
        designs: dict[str, Design] = {}
        for name, component in others.items():
            self.components[name] = component
            self._members[name].component.exchange(component)
            designs[name] = self.prepare_one(name, step_ns, {})
        return designs

    def prepare_one(self, name: str, step_ns: StepNs, recorded: Design) -> Design:
        """Prepare a component in its place; return its design.

        Parameters
        ----------
        name : str
        step_ns : int
            Communication step [ns].
        recorded : Design
            To use instead of computing it; empty: it is computed.
        """
        return self._prepare(name, self._members[name].component, step_ns, recorded)

    def prepare_variant(
        self,
        name: str,
        component: Component,
        step_ns: StepNs,
        recorded: Design,
        *,
        transfers: bool = False,
    ) -> Design:
        """Prepare a component that may take the place of another one, with its state, in a run.

        Parameters
        ----------
        name : str
            Of the other one.
        component : Component
        step_ns : int
            Communication step [ns].
        recorded : Design
            To use instead of computing it; empty: it is computed.
        transfers : bool
            Its state is handed over by what knows both.

        Raises
        ------
        GraphError
            If it has another interface, or states cannot be handed over.
        """
        channel = self.layout[name]
        self._members[name].component.check_exchange(component)
        if not (transfers or component.interface.rollback):
            raise GraphError(
                f"component {name!r}: its state cannot be passed on: it does not declare rollback "
                "(save and restore)"
            )
        return self._prepare(name, GuardedComponent(channel, component), step_ns, recorded)

    def _prepare(
        self, name: str, guarded: GuardedComponent, step_ns: StepNs, recorded: Design
    ) -> Design:
        """Prepare a component that is in a place, or may come there."""
        guarded.take_wiring(self._wiring[name])
        lengths = self._lengths(name, step_ns)
        return guarded.prepare(step_seconds(step_ns), self.held[name], recorded, lengths)

    def _lengths(self, name: str, step_ns: StepNs) -> tuple[float, ...]:
        """Return the lengths of the substeps that a component may have to take [s]."""
        for control in self.substep_controls:
            if name in control.components:
                return control.tolerance.lengths(step_ns)
        return ()

    def put(self, name: str, component: Component) -> None:
        """Put a component that is prepared in the place of a variant of it."""
        self.components[name] = component
        self._members[name].component.exchange(component)

    def hand_over(
        self,
        name: str,
        component: Component,
        t: float,
        row: Vector,
        *,
        transfer: Transfer | None = None,
    ) -> None:
        """Put a variant that is prepared in the place of a component, with its state.

        Parameters
        ----------
        name : str
        component : Component
        t : float
            The time reached [s].
        row : Vector, shape (width,)
            The signals there.
        transfer : Transfer, optional
            Left out: the variant takes the state that the other one saves.
        """
        member = self._members[name]
        self.components[name] = component
        member.component.hand_over(component, t, row[member.inputs], transfer)

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # the check below names them
    def initialize(self, t: float, row: Vector) -> None:
        """Initialize all components together; see :mod:`cosim.core.initialization.initial_values`.

        Overrides are released.

        Parameters
        ----------
        t : float
            Start time [s].
        row : Vector, shape (width,)
            Is filled.

        Raises
        ------
        GraphError
            If initial values depend on each other and no solution was found.
        NonFiniteError
            If an initial value is not finite.
        """
        self.initializations += 1
        for kept in self.kept_by_loops:
            kept.reset()
        for member in self._members.values():
            member.overrides.clear()
        origins = self._initial_values.find(t, row)
        for stage in self.stages:
            bad = first_non_finite(stage.members, row[np.newaxis])
            if bad is not None:
                names = {member.name for member in stage.members}
                inside = [origin for name, origin in origins.items() if name in names]
                raise (inside or [bad])[-1].error(t)

    def take_solutions(self, recording: RecordedRun, recorded: Collection[str]) -> None:
        """Take from a recording what was solved for in the loops that have recorded components.

        A recorded component does not answer, so that nothing can be solved for again, and no
        substep be chosen.

        Parameters
        ----------
        recording : RecordedRun
        recorded : collection of component names
        """
        for stage in self._innermost_stages:
            names = {member.name for member in stage.members}
            if names.isdisjoint(recorded):
                continue
            if stage.torn is not None:
                stage.torn.take(recording)
            for control in stage.controls:
                control.take(recording, stage.members, recorded)

    def with_coupling(self, coupling: Coupling) -> Graph:
        """Return a graph of the same components and connections with another coupling.

        One of the two may run. It has the same iterations; but one with "newton", which takes as
        many as it needs.

        Raises
        ------
        GraphError
            If the components cannot be coupled so.
        """
        return Graph(
            self.components,
            self.connections,
            coupling=coupling,
            input_interpolation=self.input_interpolation,
            means=self.means,
            iterations=1 if coupling == "newton" else self.iterations,
            periods=self.periods,
            substeps=self.substeps,
            threads=self.threads,
            native=self.native,
        )

    def measure(self) -> dict[str, float]:
        """Measure the calls of every component from now on; return its wall time [s] by name.

        The times grow as the graph runs.
        """
        seconds: dict[str, float] = {}
        for member in self._members.values():
            member.component.measure(seconds)
        return seconds

    @cached_property
    def members(self) -> Mapping[str, Member]:
        """The components in their places by name, in the order of the stages."""
        members: dict[str, Member] = {}
        for stage in self.stages:
            for member in stage.members:
                members[member.name] = member
        return members

    @property
    def kept_by_loops(self) -> list[LoopSolver | SubstepControl]:
        """What loops keep from step to step beside their components, in the order of the stages."""
        kept: list[LoopSolver | SubstepControl] = []
        for stage in self._innermost_stages:
            if stage.torn is not None:
                kept.append(stage.torn.solver)
            kept += stage.controls
        return kept

    @property
    def substep_controls(self) -> list[SubstepControl]:
        """What chooses the substeps of loops, in the order of the stages."""
        controls: list[SubstepControl] = []
        for stage in self.stages:
            controls += stage.controls
        return controls

    @property
    def _innermost_stages(self) -> list[Stage]:
        """The stages in their order, those inside a step in the place of a loop with such."""
        stages: list[Stage] = []
        for stage in self.stages:
            stages += [stage] if stage.nested is None else stage.nested.stages
        return stages

    @property
    def warnings(self) -> list[tuple[str, str]]:
        """What was assumed, and where the interpolation of inputs errs, as (component, text)."""
        warnings = list(unit_warnings(self.ports, self.connections))
        warnings += element_warnings(self.ports, self.connections)
        warnings += self._variabilities.warnings()
        warnings += self._jumping.warnings(self._sources, self._torn)
        warnings += [(name, early_event_text(name, self.coupling)) for name in self._early_events]
        for stage in self.stages:
            warnings += stage.warnings
        return warnings

    @property
    def mean_inputs(self) -> dict[str, list[str]]:
        """The connected inputs that get the mean of both ends of a step, by component."""
        means: dict[str, list[str]] = {}
        for channel in self.layout.channels:
            name = channel.name
            moves = ~self.held[name] & ~self.latest[name]
            columns = channel.interface.input_columns()
            for signal in channel.interface.one_value:
                if moves[columns[signal]].any() and self._sources[name][signal]:
                    means.setdefault(name, []).append(signal)
        return means

    def variability(self, output: Port) -> Variability:
        """Return the variability of an output.

        An inherited one is discrete where every input of its component is. It stays inherited where
        nothing is behind it that changes: constants hold and are interpolated alike.
        """
        return self._variabilities.of(output)

    def jumps(self, output: Port) -> list[Port]:
        """Return the discrete outputs whose jumps are known to be in an output, itself first."""
        return self._variabilities.jumps(output)

    def sources_of(self, port: Port) -> tuple[Port, ...]:
        """Return the outputs, or elements of them, that drive an input, in its order."""
        return self._checked.sources_of(port)

    def labels(self) -> list[str]:
        """Return the name of every column: ``component.signal`` or ``component.signal[i]``."""
        return column_names(self.layout)

    # --- structure ---

    def _wires_of(self, name: str) -> dict[Port, tuple[Wire, ...]]:
        """Return the wires that feed each input of a component."""
        wires: dict[Port, tuple[Wire, ...]] = {}
        channel = self.layout[name]
        for signal in channel.interface.inputs:
            port = Port(name, signal.name)
            feeding: list[Wire] = []
            for to in self._parts[port]:
                feeding += self._wires_to(to)
            for part in self._checked.undriven(port, signal):
                columns = self.ports.columns(port, part.elements_of(signal))
                feeding += constant_wires(columns, self.unconnected[part])
            wires[port] = tuple(feeding)
        return wires

    def _wires_to(self, to: Port) -> tuple[Wire, ...]:
        """Return the wires of a connection."""
        connection = self.connections[to]
        sources = [self.ports.output(source) for source in connection.sources]
        end = self.ports.input(to)
        copies = (Conversion(),) * end.size
        return wires_of(end.columns, connection, sources, self.conversions.get(to, copies))

    def _member(self, name: str, wires: Mapping[Port, tuple[Wire, ...]]) -> Member:
        flat = chain.from_iterable(wires.values())
        channel = self.layout[name]
        takes_latest = self.input_interpolation == "latest" and not (
            # at first no source has advanced before: the latest are those of the start
            (self.coupling == "jacobi" and self.iterations == 1)
            # a delay takes its inputs there, whatever becomes of them in the step
            or channel.interface.delayed
            or channel.interface.samples
        )
        return Member(
            channel,
            self.components[name],
            tuple(flat),
            takes_latest=takes_latest,
            jumps=self._jumps_of(channel),
        )

    def _jumps_of(self, channel: Channel) -> JumpColumns | None:
        """Return what of a component jumps, and is followed; None: nothing."""
        sources = self._jump_sources.get(channel.name, ())
        if not sources and all(port.component != channel.name for port in self._jumping.ports):
            return None
        columns = [self.ports.output(port).columns for port in sources]
        return JumpColumns(self.layout, columns, channel.outputs)

    def _columns_of(self, outputs: Iterable[Port]) -> list[int]:
        columns: list[int] = []
        for port in outputs:
            own = self.ports.output(port).columns
            columns += range(own.start, own.stop)
        return columns
