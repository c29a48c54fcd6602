"""An instance for model exchange that is linearized again and again, wherever it is asked to."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import RunError
from cosim.fmi.binary.process import ROUNDING, Process, describe_changes
from cosim.fmi.instance import ModelExchangeInstance
from cosim.fmi.linearizing.elements import Selection
from cosim.fmi.linearizing.linearize import FINE, choose_method
from cosim.fmi.linearizing.operating_point import OperatingPoint
from cosim.fmi.linearizing.request import LinearizationRequest


class LocalDerivatives(NamedTuple):
    """Derivatives and outputs at a point, and their derivatives by states and inputs.

    Shapes: ``dx (n,)``, ``y (n_y,)``, ``jacobian (n + n_y, n + n_u)``, ``error`` that of the
    Jacobian; None: it is exact.
    """

    dx: Vector
    y: Vector
    jacobian: Matrix
    error: Matrix | None


class MovingLinearization:
    """Linearizes an instance at points that follow each other; events are not handled on the way.

    Parameters
    ----------
    instance : ModelExchangeInstance
        Just reset.
    request : LinearizationRequest

    Attributes
    ----------
    x, u : Vector
        States and inputs at the operating point of the request.

    Raises
    ------
    FmuError
        If it cannot be linearized as is asked for.
    RunError
        If it does not reach the operating point.
    """

    def __init__(self, instance: ModelExchangeInstance, request: LinearizationRequest) -> None:
        description = instance.description
        self._method = choose_method(description, request.method)
        selection = Selection.of(
            description, states=request.states, inputs=request.inputs, outputs=request.outputs
        )
        self._name = description.name
        self._process = Process()
        self._process.save()
        try:
            self._point = OperatingPoint(instance, selection, request.at, request.start, rtol=FINE)
        finally:
            self._process.restore()
        self.x = self._point.x.copy()
        self.u = self._point.u.copy()

    def at(self, t: float, x: Vector, u: Vector) -> LocalDerivatives:
        """Linearize at a time, states and inputs.

        Raises
        ------
        FmuError
            If something is not finite there, or is at the edge of its range.
        RunError
            If the instance fails, or changes the rounding mode.
        """
        self._process.save()
        try:
            point = self._point.moved(t, x, u)
            jacobian, error = point.jacobian(self._method)
        finally:
            changes = self._process.restore()
        if changes & ROUNDING:
            raise RunError(
                f"{self._name}: changed {describe_changes(changes)} while it was linearized, so "
                "that what was computed is not to be relied on"
            )
        return LocalDerivatives(point.dx, point.y, np.asarray(jacobian), error)
