"""The substeps of loops, as [scenario.substeps] has them."""

from __future__ import annotations

from cosim.core.clock import nanoseconds
from cosim.core.stages.substep_control import SubstepTolerance
from cosim.scenario.document.schema import Settings


def substep_tolerance(settings: Settings) -> SubstepTolerance | None:
    """Return the tolerance of substeps; None: there are none.

    Raises
    ------
    ClockError, GraphError
        If it is none.
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
        If it is none, or a step cannot.
    """
    tolerance = substep_tolerance(settings)
    if tolerance is not None:
        tolerance.finest_level(nanoseconds(settings.step))
