"""Export a component of a scenario as an FMU."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from cosim.errors import UsageError, nearest
from cosim.fmi.exporting.export import export
from cosim.scenario.build import build, build_site
from cosim.scenario.execution import load


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

    The scenario is built as for a run: what an identifier does with its rows rests on what drives it. ``dae``: with its
    algebraic equations beside the ordinary ones.

    Raises
    ------
    UsageError
        If there is no such component, it cannot be exported, the version or a platform is not known, or the file exists.
    """
    if out.suffix != ".fmu":
        raise UsageError(f"{out}: needed a path that ends in .fmu")
    if out.exists() and not force:
        raise UsageError(f"{out} exists; choose another path, or --force to replace it")
    loaded = load(scenario).set(set or {})
    if component not in loaded.specs:
        raise UsageError(f"there is no component {component!r}; {nearest(component, loaded.specs)}")
    with ExitStack() as resources:
        held = build(loaded.document, resources).graph.held[component]
        spec, site = loaded.specs[component], build_site(loaded, resources)
        model = spec.descriptor_form(component, site) if dae else spec.exportable(component, site, held)
    name, description = _identifier(f"{loaded.name}_{component}"), f"{component} of scenario {loaded.name}"
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        return export(model, out, name=name, fmi=fmi, platforms=platforms, description=description).lines
    except OSError as error:
        raise UsageError(f"{out} cannot be written: {error.strerror or error}") from error


def _identifier(name: str) -> str:
    """Make an identifier of C of a name, which begins with a letter."""
    return re.sub(r"[^A-Za-z0-9_]", "_", name)
