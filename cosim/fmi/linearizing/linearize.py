"""A model exchange unit linearized at an operating point.

::

    x' = dx + A (x - x0) + B (u - u0),    y = y0 + C (x - x0) + D (u - u0)

The unit starts at t = 0 with constant inputs and, where asked for, runs to the operating point. There, in continuous-time mode,
the columns of A, B, C and D come from its directional derivatives by unit seeds (FMI 2.0.4 section 2.1.9, FMI 3.0 section 2.2.11:
known are states and continuous inputs, unknown are derivatives and outputs), or from central differences where it has none. An
output that is a state is known, not unknown: its row is completed from the structure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.arrays import Matrix
from cosim.errors import FmuError, RunError, nearest
from cosim.fmi.component import load
from cosim.fmi.description import Description
from cosim.fmi.driving.initialization import Starts
from cosim.fmi.instance import ModelExchangeInstance
from cosim.fmi.linearizing.elements import Chosen
from cosim.fmi.linearizing.linearization import METHODS, Linearization, Method
from cosim.fmi.linearizing.operating_point import OperatingPoint
from cosim.fmi.options import FmuOptions
from cosim.fmi.reading.model_description import read

GOOD: Final = 1e-7  # relative error from which central differences are told to be poor


def linearize(
    unit: str | Path | ModelExchangeInstance,
    *,
    at: float = 0.0,
    start: Starts | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    states: Sequence[str] | None = None,
    method: Method | None = None,
) -> Linearization:
    """Linearize an .fmu, or a unit for model exchange; see :func:`linearize`.

    Parameters
    ----------
    unit : str, Path or ModelExchangeInstance
        The path of an .fmu; or a unit: of an opened FMU its ``unit``.
    at, start, inputs, outputs, states, method
        As in :func:`linearize`.

    Raises
    ------
    FmuError
        As :func:`linearize`, or if the file cannot be used; co-simulation alone does not show the states.
    """
    wanted: dict[str, Any] = {
        "at": at,
        "start": start,
        "inputs": inputs,
        "outputs": outputs,
        "states": states,
        "method": method,
    }
    if not isinstance(unit, str | Path):
        return linearize_instance(unit, **wanted)
    description = read(unit).description
    if "me" not in description.capabilities:
        raise FmuError(
            f"{unit}: is for co-simulation only, which does not show the states; linearizing needs model exchange: export it for "
            "that too"
        )
    structural = {
        n: v
        for n, v in (start or {}).items()
        if n in description and description[n].causality == "structuralParameter"
    }
    with load(
        unit, FmuOptions(interface_type="me", start=structural)
    ) as fmu:  # they decide the sizes of arrays
        return linearize_instance(fmu.instance, **wanted)


def linearize_instance(
    instance: ModelExchangeInstance,
    *,
    at: float = 0.0,
    start: Starts | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    states: Sequence[str] | None = None,
    method: Method | None = None,
) -> Linearization:
    """Linearize a unit for model exchange; it is reset before and after.

    Parameters
    ----------
    instance : ModelExchangeInstance
    at : float
        The operating point is where the unit arrives at this time [s], from t = 0 with constant inputs.
    start : mapping of variable name to StartValue
        Values at t = 0 instead of the unit's own: inputs, parameters, states, with ``at`` 0 any state; see ``start.py``. Elements
        of inputs and of such states may be named too.
    inputs, outputs : sequence of str, optional
        Names of ports, variables or their elements, in this order; left out: all that are real and continuous.
    states : sequence of str, optional
        The same for states; those left out are held.
    method : Method, optional
        Left out: directional derivatives where the unit has them, else central differences.

    Raises
    ------
    FmuError
        If a name or a value is wrong, the method is not there, or something is not finite at the operating point.
    RunError
        If the unit cannot go on.
    """
    description = instance.description
    if not (math.isfinite(at) and at >= 0.0):
        raise FmuError(f"{description.name}: linearized at t = {at} s; needed a time from 0 on")
    method = _method(description, method)
    chosen = Chosen.of(description, states=states, inputs=inputs, outputs=outputs)
    instance.reset()
    try:
        point = OperatingPoint(instance, chosen, at, start or {})
        jacobian, error = point.directional() if method == METHODS[0] else point.differences()
    finally:
        with suppress(RunError):  # a unit that is lost cannot be reset either
            instance.reset()
    return _result(point, jacobian, error, method)


def _method(description: Description, method: Method | None) -> Method:
    able = description.capabilities["me"].directional_derivatives
    if method is None:
        return METHODS[0] if able else METHODS[1]
    if method not in METHODS:
        raise FmuError(f"{description.name}: no method {method!r}; {nearest(method, METHODS)}")
    if method == METHODS[0] and not able:
        raise FmuError(
            f"{description.name}: has no directional derivatives; leave the method out, or use {METHODS[1]!r}"
        )
    return method


def _result(
    point: OperatingPoint, jacobian: Matrix, error: Matrix | None, method: Method
) -> Linearization:
    chosen, description = point.chosen, point.unit.description
    n = len(chosen.states)
    top, bottom = slice(n), slice(n, None)
    parts = {"A": (top, top), "B": (top, bottom), "C": (bottom, top), "D": (bottom, bottom)}
    matrices = {letter: np.ascontiguousarray(jacobian[part]) for letter, part in parts.items()}
    errors = {
        letter: None if error is None else float(error[part].max(initial=0.0))
        for letter, part in parts.items()
    }
    sizes = {
        letter: float(np.linalg.norm(jacobian[rows])) for letter, (rows, _) in parts.items()
    }  # of A and B, of C and D
    poor = [
        f"{letter} by central differences: error up to {wrong:.1g}"
        for letter, wrong in errors.items()
        if wrong is not None and wrong > GOOD * sizes[letter] > 0.0
    ]
    shown = (*chosen.columns, *chosen.outputs)
    count = description.event_indicators
    events = f"event indicators ({count}): linearized within the mode it is in" if count else ""
    return Linearization(
        name=description.name,
        states=tuple(e.name for e in chosen.states),
        inputs=tuple(e.name for e in chosen.inputs),
        outputs=tuple(e.name for e in chosen.outputs),
        **matrices,
        t=point.t,
        x=point.x,
        u=point.u,
        y=point.y,
        dx=point.dx,
        made={e.name: method for e in chosen.columns},
        errors=errors,
        units={e.name: e.variable.unit for e in shown if e.variable.unit is not None},
        bases={e.name: e.variable.base for e in shown if e.variable.base is not None},
        notes=(*([events] if events else []), *chosen.notes, *poor),
    )
