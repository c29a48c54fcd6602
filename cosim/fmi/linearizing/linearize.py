"""An instance for model exchange, linearized at an operating point.

::

    x' = dx + A (x - x0) + B (u - u0),    y = y0 + C (x - x0) + D (u - u0)

It is initialized at t = 0 with constant inputs and, where asked for, runs to the operating point.
There, in continuous-time mode, the columns of A, B, C and D come from its directional derivatives
by unit seeds (FMI 2.0.4 section 2.1.9, FMI 3.0 section 2.2.11: known are states and continuous
inputs, unknown are derivatives and outputs), or from central differences where it has none. An
output that is a state is known, not unknown: its row is completed from the structure.

An operating point that a solver runs to is known up to the solver's error, and so are the matrices
of a nonlinear model there. The instance runs to it with two tolerances, of which the finer is a
hundred times smaller. How far apart the states are, at the most, relative to their size, is taken
as the error of each: what the matrices change by where all states are so much off is added to the
error of theirs. The difference of each state alone would not do, as it passes through zero.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from cosim.arguments import fmu_argument, mapping_argument, number_argument, texts_argument
from cosim.arrays import Matrix, Vector
from cosim.errors import FmuError, RunError, nearest
from cosim.fmi.binary.process import ROUNDING, Process, describe_changes
from cosim.fmi.component import Fmu, load
from cosim.fmi.description import Description
from cosim.fmi.driving.initialization import Starts
from cosim.fmi.instance import ModelExchangeInstance
from cosim.fmi.linearizing.elements import Element, Selection
from cosim.fmi.linearizing.linearization import METHODS, Linearization, Method
from cosim.fmi.linearizing.operating_point import OperatingPoint
from cosim.fmi.linearizing.request import LinearizationRequest
from cosim.fmi.options import FmuOptions
from cosim.fmi.reading.model_description import Archive, read
from cosim.units import BaseUnit

GOOD: Final = 1e-7  # relative error from which on a matrix is noted as poor
ROUGH: Final = 1e-9  # relative tolerances on the way to the operating point
FINE: Final = 1e-11


def linearize(
    fmu: str | Path | ModelExchangeInstance,
    *,
    at: float = 0.0,
    start: Starts | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    states: Sequence[str] | None = None,
    method: Method | None = None,
) -> Linearization:
    """Linearize an .fmu, or an instance for model exchange.

    Parameters
    ----------
    fmu : str, Path or ModelExchangeInstance
        The path of an .fmu; or an instance: of an opened FMU its ``instance``. It is reset before
        and after.
    at : float
        The operating point is where the instance is at this time [s], from t = 0 with constant
        inputs.
    start : mapping of variable name to StartValue
        Values at t = 0 instead of the FMU's own: inputs, parameters, states, with ``at`` 0 any
        state; see ``cosim.fmi.driving.initialization``. Elements of inputs and of such states may
        be named too.
    inputs, outputs : sequence of str, optional
        Names of ports, variables or their elements, in this order; None: all that are real and
        continuous.
    states : sequence of str, optional
        The same for states; those that are not named are constant.
    method : Method, optional
        None: directional derivatives where the FMU has them, else central differences.

    Raises
    ------
    UsageError
        If an argument has another type.
    FmuError
        If a name or a value is wrong, there is no such method, or something is not finite at the
        operating point; or if the file cannot be used: co-simulation alone does not show the
        states.
    RunError
        If the instance cannot go on, or changes the rounding mode.
    """
    request = LinearizationRequest(
        at=number_argument("at", at),
        start=mapping_argument("start", start),
        inputs=texts_argument("inputs", inputs),
        outputs=texts_argument("outputs", outputs),
        states=texts_argument("states", states),
        method=method,
    )
    if isinstance(fmu, ModelExchangeInstance):
        return linearize_instance(fmu, request)
    return linearize_file(fmu, request)


def linearize_file(path: str | Path, request: LinearizationRequest) -> Linearization:
    """Linearize an .fmu for model exchange; raises as :func:`linearize`."""
    return linearize_archive(read(fmu_argument(path)), request)


def linearize_archive(archive: Archive, request: LinearizationRequest) -> Linearization:
    """Linearize an .fmu for model exchange whose description is read; raises as `linearize`."""
    opening = open_for_linearization(archive, request.start)
    with opening as opened, opened.component.outside(None):
        return linearize_instance(opened.instance, request)


def open_for_linearization(archive: Archive, start: Starts) -> Fmu:
    """Open an FMU for model exchange with its structural parameters, which size its arrays.

    Raises
    ------
    FmuError
        If it is for co-simulation only, or cannot be loaded.
    """
    description = archive.description
    if "me" not in description.capabilities:
        raise FmuError(
            f"{archive.path}: is for co-simulation only, which does not show the states; "
            "linearizing needs model exchange: export it for that too"
        )
    structural = {}
    for name, value in start.items():
        if name in description and description[name].causality == "structuralParameter":
            structural[name] = value
    options = FmuOptions(interface_type="me", start=structural)
    return load(archive.path, options, archive=archive)


def linearize_instance(
    instance: ModelExchangeInstance, request: LinearizationRequest
) -> Linearization:
    """Linearize an instance for model exchange, reset before and after; raises as `linearize`.

    What the instance changes of the process is put back; a changed rounding mode is an error, as
    the matrices were computed with it, in part at least.
    """
    process = Process()
    process.save()
    try:
        linearization = _linearize(instance, request)
    finally:
        changes = process.restore()
    if not changes:
        return linearization
    text = (
        f"{linearization.name}: changed {describe_changes(changes)} while it was linearized; it "
        "is as before again"
    )
    if changes & ROUNDING:
        raise RunError(f"{text}, but what was computed until then is not to be relied on")
    return replace(linearization, notes=(*linearization.notes, text))


def _linearize(instance: ModelExchangeInstance, request: LinearizationRequest) -> Linearization:
    description = instance.description
    at = request.at
    if not (math.isfinite(at) and at >= 0.0):
        raise FmuError(
            f"{description.name}: time to linearize at: expected 0 s or later, got {at} s"
        )
    method = choose_method(description, request.method)
    selection = Selection.of(
        description, states=request.states, inputs=request.inputs, outputs=request.outputs
    )
    rough_x = None
    try:
        if at > 0.0:
            rough_x = _reach(instance, selection, request, ROUGH).all_states
        point = _reach(instance, selection, request, FINE)
        jacobian, error = point.jacobian(method)
        if rough_x is not None:
            error = _with_error_of_states(point, method, rough_x, jacobian, error)
    finally:
        with suppress(RunError):  # an instance that has failed for good cannot be reset either
            instance.reset()
    return _result(point, jacobian, error, method)


def _reach(
    instance: ModelExchangeInstance,
    selection: Selection,
    request: LinearizationRequest,
    rtol: float,
) -> OperatingPoint:
    """Reset the instance and run it to the operating point."""
    instance.reset()
    return OperatingPoint(instance, selection, request.at, request.start, rtol=rtol)


def _with_error_of_states(
    point: OperatingPoint,
    method: Method,
    rough_x: Vector,
    jacobian: Matrix,
    error: Matrix | None,
) -> Matrix | None:
    """Add what is due to the error of the states to that of the Jacobian; see the module."""
    displaced, _ = point.displaced(rough_x).jacobian(method)
    change = np.abs(displaced - jacobian)
    if error is None:
        # Where the states do not matter the derivatives are as exact as before.
        return change if change.any() else None
    return error + change


def choose_method(description: Description, method: Method | None) -> Method:
    """Return how an instance is linearized.

    Raises
    ------
    FmuError
        If there is no such method, or the FMU has no directional derivatives.
    """
    directional, differences = METHODS
    has_derivatives = description.capabilities["me"].directional_derivatives
    if method is None:
        return directional if has_derivatives else differences
    if method not in METHODS:
        raise FmuError(f"{description.name}: no method {method!r}; {nearest(method, METHODS)}")
    if method == directional and not has_derivatives:
        raise FmuError(
            f"{description.name}: has no directional derivatives; leave the method out, "
            f"or use {differences!r}"
        )
    return method


def _result(
    point: OperatingPoint, jacobian: Matrix, error: Matrix | None, method: Method
) -> Linearization:
    selection = point.selection
    matrices = _matrices(jacobian, len(selection.states))
    errors: dict[str, float | None] = dict.fromkeys(matrices)
    if error is not None:
        for letter, part in _matrices(error, len(selection.states)).items():
            errors[letter] = float(part.max(initial=0.0))
    return Linearization(
        name=point.instance.description.name,
        states=_names(selection.states),
        inputs=_names(selection.inputs),
        outputs=_names(selection.outputs),
        **matrices,
        t=point.t,
        x=point.x,
        u=point.u,
        y=point.y,
        dx=point.dx,
        made=dict.fromkeys(_names(selection.columns), method),
        errors=errors,
        ports={element.name: element.port for element in selection.inputs},
        units=_units(selection),
        bases=_bases(selection),
        notes=(*_notes(point), *_notes_on_errors(matrices, errors, method)),
    )


def _names(elements: Sequence[Element]) -> tuple[str, ...]:
    return tuple(element.name for element in elements)


def _matrices(jacobian: Matrix, n: int) -> dict[str, Matrix]:
    """Split a matrix of the Jacobian's shape into the parts of A, B, C and D."""
    parts = {
        "A": jacobian[:n, :n],
        "B": jacobian[:n, n:],
        "C": jacobian[n:, :n],
        "D": jacobian[n:, n:],
    }
    return {letter: np.ascontiguousarray(part) for letter, part in parts.items()}


def _units(selection: Selection) -> dict[str, str]:
    units = {}
    for element in (*selection.columns, *selection.outputs):
        unit = element.variable.unit
        if unit is not None:
            units[element.name] = unit
    return units


def _bases(selection: Selection) -> dict[str, BaseUnit]:
    bases = {}
    for element in (*selection.columns, *selection.outputs):
        base = element.variable.base
        if base is not None:
            bases[element.name] = base
    return bases


def _notes(point: OperatingPoint) -> Iterator[str]:
    count = point.instance.description.event_indicators
    if count:
        yield f"event indicators ({count}): linearized within the mode it is in"
    yield from point.selection.notes
    yield from point.warnings


def _notes_on_errors(
    matrices: Mapping[str, Matrix], errors: Mapping[str, float | None], method: Method
) -> Iterator[str]:
    """Yield a note on each matrix whose error is large beside the derivatives or outputs."""
    of_derivatives = np.hstack([matrices["A"], matrices["B"]])
    of_outputs = np.hstack([matrices["C"], matrices["D"]])
    derivatives = float(np.linalg.norm(of_derivatives))
    outputs = float(np.linalg.norm(of_outputs))
    sizes = {"A": derivatives, "B": derivatives, "C": outputs, "D": outputs}
    for letter, error in errors.items():
        if error is not None and error > GOOD * sizes[letter] > 0.0:
            yield f"{letter} by {method}: error up to {error:.1g}"
