"""Parts without memory: sum, gain, product, limit, switch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from cosim.arrays import Matrix
from cosim.blocks import arithmetic
from cosim.blocks.product import Product
from cosim.core.contracts import Component
from cosim.core.linear import LinearModel
from cosim.core.signals import Interface
from cosim.fmi.exporting import kernels
from cosim.fmi.exporting.kernels import DiscreteModel
from cosim.fmi.exporting.specifications import Exportable
from cosim.scenario.document.schema import (
    Flag,
    Number,
    NumberRow,
    NumberRows,
    Size,
    matrix,
)
from cosim.scenario.kinds.base import BuildContext, ExportableKind, PortUnits, Wiring, unit_of
from cosim.scenario.kinds.capabilities import Advising


class SumKind(ExportableKind):
    """y = signs[0] u1 + signs[1] u2 + ..."""

    ports: ClassVar[str] = "u1, u2, ... -> y"
    is_static: ClassVar[bool] = True
    tunable: ClassVar[tuple[str, ...]] = ("signs",)
    kind: Literal["sum"]
    signs: NumberRow = Field(description="one factor per input, such as [1, -1]")
    size: Size = Field(1, description="number of elements of each signal")
    unit: PortUnits = Field(None, description=unit_of("y and all inputs"))

    def build(self, name: str, context: BuildContext) -> Component:
        return arithmetic.sum_of(self.signs, size=self.size, unit=self.unit_name)

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        D = np.kron(np.array([self.signs]), np.eye(self.size))
        return _static_model(self.build(name, context).interface, D)


class GainKind(ExportableKind):
    """y = K u."""

    ports: ClassVar[str] = "u -> y"
    is_static: ClassVar[bool] = True
    tunable: ClassVar[tuple[str, ...]] = ("K",)
    kind: Literal["gain"]
    K: Number | NumberRows = Field(description="gain, a number or a matrix")

    def build(self, name: str, context: BuildContext) -> Component:
        return arithmetic.gain(self._matrix, unit=self.unit_name)

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        return _static_model(self.build(name, context).interface, self._matrix)

    @property
    def _matrix(self) -> Matrix:
        if isinstance(self.K, (int, float)):
            return np.array([[self.K]])
        return matrix(self.K, "K")


class ProductKind(ExportableKind):
    """y = u1 u2 ... or u1/u2 ..., element by element."""

    ports: ClassVar[str] = "u1, u2, ... -> y"
    is_static: ClassVar[bool] = True
    kind: Literal["product"]
    operations: str = Field(description='* or / per input, such as "*/" for u1/u2')
    size: Size = Field(1, description="number of elements of each signal")

    def build(self, name: str, context: BuildContext) -> Product:
        return Product(self.operations, size=self.size, unit=self.unit_name)

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        interface = self.build(name, context).interface
        reason = "a product is nonlinear"
        return DiscreteModel(interface, kernels.product(self.operations), 0, reason)


class LimitKind(ExportableKind):
    """y = u, limited to lower and upper."""

    ports: ClassVar[str] = "u -> y"
    is_static: ClassVar[bool] = True
    tunable: ClassVar[tuple[str, ...]] = ("lower", "upper")
    kind: Literal["limit"]
    lower: Number = Field(description="lower limit")
    upper: Number = Field(description="upper limit")
    size: Size = Field(1, description="number of elements")
    unit: PortUnits = Field(None, description=unit_of("u and y"))

    def build(self, name: str, context: BuildContext) -> Component:
        return arithmetic.limit(
            lower=self.lower, upper=self.upper, size=self.size, unit=self.unit_name
        )

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        interface = self.build(name, context).interface
        kernel = kernels.limit(float(self.lower), float(self.upper))
        reason = "a limit is not differentiable"
        return DiscreteModel(interface, kernel, 0, reason)


RAMP = (
    "control is interpolated linearly, and where it passes the threshold y jumps: between two "
    "communication points the jump becomes a ramp over that step, an error of first order in the "
    "step; a discrete control jumps at communication points only"
)
LATE = (
    "control is interpolated linearly, and where it passes the threshold y jumps: between two "
    "communication points that shows at the second, an error of first order in the step"
)


class SwitchKind(ExportableKind, Advising):
    """y = u1 where control >= threshold, else u2."""

    ports: ClassVar[str] = "u1, u2, control -> y"
    is_static: ClassVar[bool] = True
    tunable: ClassVar[tuple[str, ...]] = ("threshold",)
    kind: Literal["switch"]
    threshold: Number = Field(0.5, description="y = u1 for control >= threshold")
    size: Size = Field(1, description="number of elements of u1, u2 and y")
    discrete: Flag = Field(
        False,
        description="hold y over each step; default: true if u1, u2 and control are discrete",
    )
    unit: PortUnits = Field(None, description=unit_of("u1, u2 and y"))

    def advice(
        self, name: str, context: BuildContext, *, held: Mapping[str, bool], h: float
    ) -> list[str]:
        if held["control"]:
            return []
        return [LATE if self.discrete else RAMP]

    def build(self, name: str, context: BuildContext) -> Component:
        return arithmetic.switch(
            threshold=self.threshold, size=self.size, discrete=self.discrete, unit=self.unit_name
        )

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        interface = self.build(name, context).interface
        kernel = kernels.switch(float(self.threshold))
        return DiscreteModel(interface, kernel, 0, "a switch is not differentiable")


def _static_model(interface: Interface, D: Matrix) -> LinearModel:
    """Return y = D u as a linear model without states."""
    n_y, n_u = D.shape
    A = np.zeros((0, 0))
    B = np.zeros((0, n_u))
    C = np.zeros((n_y, 0))
    X0 = np.zeros(0)
    Xu = np.zeros((0, n_u))
    return LinearModel(interface, (), A=A, B=B, C=C, D=D, X0=X0, Xu=Xu)
