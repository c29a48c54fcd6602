"""Export a component of a scenario as an FMU."""

from __future__ import annotations

import re
from collections.abc import Container, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import final

from cosim.arguments import check_fmu_to_write
from cosim.arrays import Mask
from cosim.blocks.declared import declare_units
from cosim.core.graph import Graph
from cosim.core.linear import DescriptorModel
from cosim.core.port import Port
from cosim.core.signals import Signal
from cosim.errors import UsageError, nearest
from cosim.fmi.exporting.export import export
from cosim.fmi.exporting.kernels import DiscreteModel
from cosim.fmi.exporting.specifications import Exportable
from cosim.scenario.building.build import Builder
from cosim.scenario.kinds import KINDS, ExportableKind
from cosim.scenario.kinds.base import BuildContext, Scenario
from cosim.scenario.kinds.plants import DescriptorKind
from cosim.scenario.running.execution import load

ZERO_ORDER_HOLD_OUTPUTS = (
    "its inputs have a zero-order hold over a step here, and so have its outputs; co-simulation "
    "in FMI 2.0 has no events, so they are declared continuous: FMI 3.0 declares them discrete"
)


def export_component(
    scenario: str | Scenario,
    component: str,
    out: Path | None = None,
    *,
    fmi: str = "2",
    platforms: Sequence[str] = (),
    force: bool = False,
    dae: bool = False,
) -> list[str]:
    """Write a component as an FMU; return lines that describe what was written.

    Only what the component rests on is built: an identifier treats its rows as they come from what
    drives it. ``out``: ``fmus/<scenario>-<component>.fmu`` where it is None. ``dae``: with its
    algebraic equations beside the ordinary ones.

    Raises
    ------
    UsageError
        If there is no such component, it cannot be exported, or the file exists or cannot be
        written.
    FmuError
        If the version or a platform is not known.
    ScenarioError
        If the file is wrong, or what the component rests on cannot be built.
    """
    loaded = scenario if isinstance(scenario, Scenario) else load(scenario)
    # whose times are on its grid, whatever the component takes of them
    _ = loaded.file.scenario.clock
    out = out or Path("fmus") / f"{loaded.name}-{component}.fmu"
    check_fmu_to_write(out, force=force)
    if component not in loaded.specs:
        raise UsageError(f"there is no component {component!r}; {nearest(component, loaded.specs)}")
    name = model_identifier(f"{loaded.name}_{component}")
    description = f"{component} of scenario {loaded.name}"
    with ExitStack() as resources:
        if dae:
            model: DescriptorModel | Exportable = _descriptor_model(loaded, component, resources)
            has_held_outputs = False
        else:
            # only in FMI 3 has co-simulation events, in which discrete signals jump
            model, has_held_outputs = _model(loaded, component, resources, has_events=fmi == "3")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        exported = export(
            model, out, name=name, fmi=fmi, platforms=platforms, description=description
        )
    except OSError as error:
        raise UsageError(f"{out} cannot be written: {error.strerror or error}") from error
    if has_held_outputs and fmi == "2":
        return [*exported.lines, ZERO_ORDER_HOLD_OUTPUTS]
    return exported.lines


def model_identifier(name: str) -> str:
    """Make an identifier of C of a name, another one for every name.

    Characters that C does not have are written as ``_x2d_``, their number in hexadecimal; so is an
    underscore that begins what looks like that.
    """
    escaped = r"[^A-Za-z0-9_]|_(?=x[0-9a-f]+([^A-Za-z0-9]|$))"
    return re.sub(escaped, lambda match: f"_x{ord(match[0]):x}_", name)


# --- what is exported of a component ---


def _descriptor_model(scenario: Scenario, component: str, resources: ExitStack) -> DescriptorModel:
    spec = scenario.specs[component]
    if not isinstance(spec, DescriptorKind):
        raise UsageError(
            f"{component!r} is of kind {spec.kind!r}, which has no algebraic equations; expected "
            "a component of kind 'descriptor'"
        )
    return spec.descriptor_form(BuildContext(scenario, resources))


def _model(
    scenario: Scenario, component: str, resources: ExitStack, *, has_events: bool
) -> tuple[Exportable, bool]:
    """Return the model of a component, and whether all its signals have a zero-order hold.

    ``has_events``: its signals that jump are discrete ones.
    """
    spec = scenario.specs[component]
    if not isinstance(spec, ExportableKind):
        exportable = [name for name, kind in KINDS.items() if issubclass(kind, ExportableKind)]
        raise UsageError(
            f"{component!r} is of kind {spec.kind!r}, which cannot be exported; available: "
            f"{', '.join(exportable)}"
        )
    wiring = _GraphWiring(scenario, component, resources)
    model = spec.exportable(component, BuildContext(scenario, resources), wiring)
    interface = declare_units(model.interface, spec.units_of(model.interface))
    inherits = any(signal.variability == "inherited" for signal in interface.outputs)
    is_held = inherits and wiring.is_discrete
    if has_events and is_held:  # over a step
        inputs = _jumping(interface.inputs, interface.by_name)
        outputs = _jumping(interface.outputs, interface.by_name)
        interface = replace(interface, inputs=inputs, outputs=outputs)
    elif has_events and isinstance(model, DiscreteModel) and not model.kernel.affine:
        # inputs that jump, for no derivative leads beyond one
        names = [signal.name for signal in interface.inputs]
        inputs = _jumping(interface.inputs, list(filter(wiring.is_driven_by_discrete, names)))
        interface = replace(interface, inputs=inputs)
    return replace(model, interface=interface), is_held


@final
class _GraphWiring:
    """How a component is connected; what drives it is built when that is needed, nothing else."""

    def __init__(self, scenario: Scenario, component: str, resources: ExitStack) -> None:
        self._scenario = scenario
        self._component = component
        self._resources = resources

    @cached_property
    def _graph(self) -> Graph:
        needed = self._scenario.upstream(self._component)
        return Builder(needed, self._resources).graph()

    @property
    def held(self) -> Mask:
        """Which input elements keep their value over a communication step, shape (n_u,)."""
        return self._graph.held[self._component]

    def is_driven_by_discrete(self, name: str) -> bool:
        """Return whether all that drives an input is discrete."""
        sources = self._graph.sources_of(Port(self._component, name))
        variabilities = {self._graph.variability(port) for port in sources}
        return variabilities == {"discrete"}

    @property
    def is_discrete(self) -> bool:
        """Whether outputs that inherit their variability are discrete."""
        outputs = self._graph.components[self._component].interface.outputs
        ports = [Port(self._component, signal.name) for signal in outputs]
        return all(self._graph.variability(port) == "discrete" for port in ports)


def _jumping(signals: Iterable[Signal], names: Container[str]) -> tuple[Signal, ...]:
    """Return signals of which those of some names are discrete."""
    jumping = []
    for signal in signals:
        is_discrete = signal.name in names
        jumping.append(replace(signal, variability="discrete") if is_discrete else signal)
    return tuple(jumping)
