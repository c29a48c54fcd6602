"""Checks of a scenario as verdicts, whatever error they end with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, TypeAlias

from cosim.errors import AssumptionError, UsageError
from cosim.scenario.building.build import out_of_range
from cosim.scenario.kinds.build_record import DependsOnInvalid
from cosim.theory.observers.assumptions import AssumptionVerdict, checked, refused, undecided

RESTS_ON_INVALID: Final = "depends on something invalid"
Evidence: TypeAlias = tuple[str, Mapping[str, Any]]  # in a sentence, and its numbers


def attempted(name: str, check: Callable[[], Evidence]) -> AssumptionVerdict:
    """Return the verdict of a check.

    Parameters
    ----------
    name : str
        Of the assumption.
    check : callable
        Returns evidence and numbers, or raises what stands against the assumption.
    """
    try:
        return checked(name, check)
    except DependsOnInvalid as error:
        return undecided(name, str(error) or RESTS_ON_INVALID)
    except (UsageError, ValueError) as error:
        return refused(name, AssumptionError(str(error)))
    except (ArithmeticError, MemoryError) as error:
        return refused(name, AssumptionError(out_of_range(error)))
