"""Replay of a recording of another tool: a scenario, with the mapped components recorded in it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from cosim.arguments import mapping_argument, swap_argument
from cosim.errors import UsageError, flag, option
from cosim.scenario.building.parsing import Scenario
from cosim.scenario.document.swaps import PortNames, WrittenPorts, ports_in


def with_recorded_components(
    scenario: Scenario | None,
    log: Path,
    *,
    swaps: Mapping[str, str | Path] | None,
    maps: Mapping[str, PortNames] | None,
) -> Scenario:
    """Return a scenario whose mapped components come from a recording of another tool.

    Parameters
    ----------
    scenario : Scenario or None
        None: none was given.
    log : Path
    swaps : mapping of component name to path or None
        Of other components, or of these, to take them from elsewhere.
    maps : mapping of port to names or None
        Fields of the recording; see :mod:`cosim.scenario.document.swaps`.

    Raises
    ------
    UsageError
        If there is no scenario, or nothing is mapped.
    ScenarioError
        With every problem of the scenario and the maps.
    """
    paths = swap_argument(swaps)
    names = mapping_argument("map", maps)
    needed_map = option("map", "plant.y", "/topic.field")
    if scenario is None:
        raise UsageError(
            f"{log} was written by another tool and has no scenario; expected "
            f"{option('scenario')}, the one whose components it recorded, and a map of these, "
            f"{needed_map}"
        )
    if not names:
        raise UsageError(
            f"{log} was written by another tool, so that its fields have no known place in the "
            f"scenario {scenario.name!r}; expected a map, {needed_map}; 'cosim info' lists the "
            "fields"
        )
    recorded = {name: log for name in _recorded(scenario, names)}
    return scenario.edit(swap={**recorded, **paths}, map=names)


def check_field_options(
    *, allow_code: bool, rerun: bool, window: object, components: object
) -> None:
    """Check that nothing is given that a replay of another tool's recording does not have.

    Raises
    ------
    UsageError
        If something is.
    """
    given = {
        flag("allow_code"): allow_code,
        flag("rerun"): rerun,
        "a window of time": window is not None,
        "components to compute": components is not None,
    }
    for name in filter(given.get, given):
        raise UsageError(
            f"{name} does not apply to a recording of another tool, from which mapped components "
            "are taken while all others are computed; omit it"
        )


def _recorded(scenario: Scenario, names: Mapping[str, PortNames]) -> list[str]:
    """Return the components that are recorded: those with a mapped output.

    A mapped input belongs to them, or else to the components that drive it.
    """
    ports = WrittenPorts(scenario.tree)
    recorded: dict[str, None] = {}
    inputs = []
    for port in ports_in(names):
        if ports.causality(port) == "input":
            inputs.append(port)
        else:
            recorded[port.component] = None
    for port in inputs:
        if port.component not in recorded:
            recorded |= dict.fromkeys(scenario.sources(port.whole) or [port.component])
    return list(recorded)
