"""Export a component of a scenario as an FMU."""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from cosim.errors import UsageError, nearest
from cosim.fmi.export import export
from cosim.scenario.build import build_site
from cosim.scenario.execution import load


def export_component(
    scenario: str,
    component: str,
    out: Path,
    *,
    force: bool = False,
    set: Mapping[str, Any] | None = None,
) -> list[str]:
    """Write a component as an FMI 2.0 FMU; give lines that say what was written.

    Raises
    ------
    UsageError
        If there is no such component, it is no linear model, or the file exists.
    """
    if out.suffix != ".fmu":
        raise UsageError(f"{out}: needed a path that ends in .fmu")
    if out.exists() and not force:
        raise UsageError(f"{out} exists; choose another path, or --force to replace it")
    loaded = load(scenario).set(set or {})
    if component not in loaded.specs:
        raise UsageError(f"there is no component {component!r}; {nearest(component, loaded.specs)}")
    if loaded.specs[component].own_step is not None:
        raise UsageError(f"{component!r} has a period, so it is discrete; only what is continuous can be exported: leave it out")
    with ExitStack() as resources:
        site = build_site(loaded, resources)
        model = loaded.specs[component].linear_model(component, site)
    name, description = _identifier(f"{loaded.name}_{component}"), f"{component} of scenario {loaded.name}"
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        written = export(model, out, name=name, description=description)
    except OSError as error:
        raise UsageError(f"{out} cannot be written: {error.strerror or error}") from error
    kinds = "FMI 2.0, model exchange and co-simulation"
    return [f"{written.path}: {kinds}, " + (f"binary for {written.platform}" if written.platform else written.note)]


def _identifier(name: str) -> str:
    return re.sub(r"\W", "_", name)
