"""The way of a unit through initialization mode (FMI 2.0.4 sections 3.2.3 and 4.2.4)."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from cosim.arrays import Vector
from cosim.errors import FmuError
from cosim.fmi.description import Description
from cosim.fmi.unit import Unit


class Start:
    """Keeps a unit in initialization mode as long as its inputs may still change.

    Parameters
    ----------
    unit : Unit
        Just instantiated.
    values : mapping of variable name to float
        Start values to set instead of the unit's own.

    Raises
    ------
    FmuError
        If a start value is not one; see ``check_start``.
    """

    def __init__(self, unit: Unit, values: Mapping[str, float]) -> None:
        check_start(unit.description, values)
        self._unit = unit
        self._references = unit.description.reference(values)
        self._values = np.array(list(values.values()), np.float64)
        self._inputs = unit.description.references("input")
        self._outputs = unit.description.references("output")
        self._fresh = True
        self.t: float | None = None  # not None: in initialization mode at that time

    def enter(self, t: float, u: Vector) -> Vector:
        """Start at ``t`` with inputs ``u``, from the beginning unless still there; give the outputs."""
        if self.t != t:
            if not self._fresh:
                self._unit.reset()
            self._fresh = False
            if len(self._values):
                self._unit.set_float64(self._references, self._values)
            self._unit.enter_initialization_mode(t)
            self.t = t
        self._unit.set_float64(self._inputs, np.array(u, np.float64))
        return self._unit.get_float64(self._outputs)

    def leave(self) -> bool:
        """Exit initialization mode; False: it had been left before."""
        if self.t is None:
            return False
        self.t = None
        self._unit.exit_initialization_mode()
        return True


def check_start(description: Description, values: Mapping[str, float]) -> None:
    """Check start values before they are set.

    Raises
    ------
    FmuError
        All problems together: unknown variable, one that cannot be set, NaN or infinity, outside its range.
    """
    problems = []
    for name, value in values.items():
        try:
            variable = description[name]
        except FmuError as error:
            problems.append(str(error))
            continue
        if not variable.settable or variable.size != 1:
            how = f"causality {variable.causality}, variability {variable.variability}, initial {variable.initial}"
            problems.append(f"{description.name}: {name!r} cannot be set at the start ({how})")
        elif not math.isfinite(value):
            problems.append(f"{description.name}: start value of {name!r}: found {value}, needed a finite number")
        elif not variable.minimum <= value <= variable.maximum:
            needed = f"{variable.minimum} to {variable.maximum}"
            problems.append(f"{description.name}: start value of {name!r}: found {value}, needed {needed}")
    if problems:
        raise FmuError("\n".join(problems))
