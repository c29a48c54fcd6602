"""The substeps of loops, as [scenario.substeps] has them."""

from __future__ import annotations

from collections.abc import Iterator

from cosim.core.clock import Clock, nanoseconds
from cosim.core.graph import Graph
from cosim.core.stages.substep_control import SubstepTolerance
from cosim.scenario.schema import Settings


def substep_tolerance(settings: Settings) -> SubstepTolerance | None:
    """Return the tolerance of substeps; None: there are none.

    Raises
    ------
    ClockError, GraphError
        If a value of the table is refused.
    """
    table = settings.substeps
    if table is None:
        return None
    return SubstepTolerance(table.rtol, table.atol, nanoseconds(table.min))


def check_substeps(settings: Settings) -> None:
    """Check the tolerance of substeps, and that a step can be divided.

    Raises
    ------
    ClockError, GraphError
        If a value of the table is refused, or a step cannot be divided.
    """
    tolerance = substep_tolerance(settings)
    if tolerance is not None:
        tolerance.finest_level(Clock.step_of(settings.step))


def substep_warnings(graph: Graph) -> Iterator[tuple[str, str]]:
    """Yield that substeps change nothing, where no loop takes any, as (key, text)."""
    if graph.substeps is not None and not graph.substep_controls:
        yield "scenario.substeps", "there is no loop that takes any, so that they change nothing"
