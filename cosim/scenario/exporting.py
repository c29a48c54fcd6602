"""Export a component of a scenario as an FMU."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, final

from cosim.arrays import Mask
from cosim.core.graph import Graph
from cosim.core.linear import DescriptorModel
from cosim.core.port import Port
from cosim.core.signals import Interface
from cosim.errors import UsageError, nearest
from cosim.fmi.exporting.export import export
from cosim.fmi.exporting.specifications import Exportable
from cosim.scenario.build import Scenario, build_context, draft, upstream
from cosim.scenario.execution import load
from cosim.scenario.kinds import EXPORTABLE, DescriptorKind, ExportableKind

HOLDS = (
    "its inputs hold over a step here, so its outputs do too; co-simulation in FMI 2.0 has no events to say so, and they are "
    "declared continuous: FMI 3.0 declares them discrete"
)


def export_component(
    scenario: str,
    component: str,
    out: Path,
    *,
    fmi: str = "2",
    platforms: Sequence[str] = (),
    force: bool = False,
    dae: bool = False,
    set: Mapping[str, Any] | None = None,
) -> list[str]:
    """Write a component as an FMU; give lines that say what was written.

    Only what the component rests on is built: an identifier treats its rows as they come from what drives it. ``dae``: with its
    algebraic equations beside the ordinary ones.

    Raises
    ------
    UsageError
        If there is no such component, it cannot be exported, or the file exists or cannot be written.
    FmuError
        If the version or a platform is not known.
    ScenarioError
        If the file is wrong, or what the component rests on cannot be built.
    """
    if out.suffix != ".fmu":
        raise UsageError(f"{out}: needed a path that ends in .fmu")
    if out.exists() and not force:
        raise UsageError(f"{out} exists; choose another path, or --force to replace it")
    loaded = load(scenario).set(set or {})
    if component not in loaded.specs:
        raise UsageError(f"there is no component {component!r}; {nearest(component, loaded.specs)}")
    with ExitStack() as resources:
        place, spec, context = (
            _Wiring(loaded, component, resources),
            loaded.specs[component],
            build_context(loaded, resources),
        )
        model: DescriptorModel | Exportable
        if dae:
            if not isinstance(spec, DescriptorKind):
                raise UsageError(
                    f"{component!r} is of kind {spec.kind!r}, which has no algebraic equations; "
                    f"what has: descriptor"
                )
            model, holds = spec.descriptor_form(context), False
        else:
            if not isinstance(spec, ExportableKind):
                raise UsageError(
                    f"{component!r} is of kind {spec.kind!r}, which cannot be exported; "
                    f"what can be: {', '.join(EXPORTABLE)}"
                )
            ours = spec.exportable(component, context, place)
            holds = _inherits(ours.interface) and place.is_discrete
            model = (
                replace(ours, interface=_discrete(ours.interface)) if holds and fmi == "3" else ours
            )
    name, description = (
        _identifier(f"{loaded.name}_{component}"),
        f"{component} of scenario {loaded.name}",
    )
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        lines = export(
            model, out, name=name, fmi=fmi, platforms=platforms, description=description
        ).lines
    except OSError as error:
        raise UsageError(f"{out} cannot be written: {error.strerror or error}") from error
    return [*lines, HOLDS] if holds and fmi == "2" else lines


@final
class _Wiring:
    """Where a component stands; what drives it is built when that is asked for, and nothing else."""

    def __init__(self, scenario: Scenario, component: str, resources: ExitStack) -> None:
        self._scenario, self._component, self._resources = scenario, component, resources

    @cached_property
    def _graph(self) -> Graph:
        return upstream(draft(self._scenario.document, self._resources), self._component)

    @property
    def held(self) -> Mask:
        """Which input elements keep their value over a communication step, shape (n_u,)."""
        return self._graph.held[self._component]

    @property
    def is_discrete(self) -> bool:
        """Whether outputs that inherit their variability are discrete."""
        face = self._graph.components[self._component].interface
        return all(
            self._graph.variability(Port(self._component, signal.name)) == "discrete"
            for signal in face.outputs
        )


def _inherits(face: Interface) -> bool:
    return any(signal.variability == "inherited" for signal in face.outputs)


def _discrete(face: Interface) -> Interface:
    """Give an interface all of whose signals hold over a step."""
    inputs, outputs = (
        tuple(replace(signal, variability="discrete") for signal in part)
        for part in (face.inputs, face.outputs)
    )
    return replace(face, inputs=inputs, outputs=outputs)


def _identifier(name: str) -> str:
    """Make an identifier of C of a name, which begins with a letter."""
    return re.sub(r"[^A-Za-z0-9_]", "_", name)
