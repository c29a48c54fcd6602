"""Parameters of an FMU that may change while it runs: those of variability "tunable".

FMI 2.0.4 section 2.2.7 and FMI 3.0 section 2.4.7.4: in model exchange they are set in Event Mode,
in co-simulation between two communication steps, of FMI 3 with event mode in that.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cosim.arrays import Vector
from cosim.errors import FmuError, nearest
from cosim.fmi.description import Description
from cosim.fmi.driving.initialization import Starts, check_start
from cosim.fmi.references import ReferenceMap


@dataclass(frozen=True, slots=True, eq=False)
class TunedParameters:
    """Values for tunable parameters, of which all are numbers.

    Parameters
    ----------
    references : ReferenceMap
    values : Vector
    """

    references: ReferenceMap
    values: Vector


def tunable_parameters(description: Description) -> list[str]:
    """Return the names of the parameters that may change in a run, in the order of the file."""
    names = []
    for variable in description.variables:
        is_tunable = variable.causality == "parameter" and variable.variability == "tunable"
        if is_tunable and variable.is_signal and variable.alias_of is None:
            names.append(variable.name)
    return names


def check_tuning(description: Description, values: Starts) -> Mapping[str, tuple[float, ...]]:
    """Check values for tunable parameters; return their elements.

    Raises
    ------
    FmuError
        If one is not tunable, with those that are, or a value is none of its variable.
    """
    known = tunable_parameters(description)
    for name in values:
        if name not in known:
            text = "has no tunable parameter"
            raise FmuError(f"{description.name} {text} {name!r}; {nearest(name, known)}")
    return check_start(description, values).numbers


def tuned(description: Description, values: Mapping[str, tuple[float, ...]]) -> TunedParameters:
    """Return values that were checked as what is set at once."""
    elements: list[float] = []
    for own in values.values():
        elements += own
    return TunedParameters(description.references_of(values), np.array(elements, np.float64))
