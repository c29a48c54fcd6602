"""The observer of the method: states and disturbance from the output."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar, Literal, NamedTuple

from numpy.typing import NDArray
from pydantic import Field

from cosim.blocks.observer import observer_model
from cosim.core.linear import LinearModel
from cosim.scenario.kinds.base import (
    BuildContext,
    LinearKind,
)
from cosim.scenario.kinds.plants import StartField
from cosim.scenario.linearizing import DesignModel, design_model
from cosim.scenario.schema import Number, NumberRow, NumberRows, TomlTable, matrix
from cosim.theory import observer
from cosim.theory.descriptor import reduce

# filter_rate x step above which a zero-order hold distorts the derivative by more than 2.5 %
HOLD_LIMIT = 0.05


class FmuModel(TomlTable):
    """Design model of an observer, linearized from an FMU."""

    fmu: str = Field(description="path of an .fmu for model exchange")
    disturbance: str | tuple[str, ...] = Field(
        description="name or names of the inputs that are unknown"
    )
    inputs: tuple[str, ...] | None = Field(
        None, description="names of the inputs that make up u; default: all others"
    )
    outputs: tuple[str, ...] = Field(("y",), description="names of the outputs that make up y")
    at: Number = Field(
        0.0,
        description="time of the operating point, reached with constant inputs [s]",
    )
    start: dict[str, StartField] = Field(
        {}, description="start values by variable, inputs included"
    )

    @property
    def disturbances(self) -> tuple[str, ...]:
        """The names of the unknown inputs."""
        return (self.disturbance,) if isinstance(self.disturbance, str) else self.disturbance


class DesignedObserver(NamedTuple):
    """An observer, and the model that it is designed on."""

    model: DesignModel
    design: observer.ObserverDesign


class UnknownInputObserverKind(LinearKind):
    """Unknown-input observer with disturbance reconstruction (18)-(20)."""

    ports: ClassVar[str] = "u, y -> x_a, delta, x_b, z, q"
    kind: Literal["unknown-input-observer"]
    model: str | FmuModel = Field(
        description="design model: name of a table in [models], "
        'or { fmu = "x.fmu", disturbance = "d" }'
    )
    L: NumberRow | NumberRows | None = Field(None, description="gain; or give poles")
    poles: NumberRow | None = Field(
        None, description="eigenvalues of M - L C3 that L can move [1/s]"
    )
    x_a0: NumberRow | None = Field(
        None, description="initial estimate; default: consistent with y(0)"
    )
    filter_rate: Number = Field(description="lambda_f of the derivative filter (19) [rad/s]")
    q0: NumberRow | None = Field(
        None, description="initial state of the filter; default: no transient"
    )

    def linear_model(self, name: str, context: BuildContext) -> LinearModel:
        model, design = self.design(name, context)
        metadata = {
            "eigenvalues": _plain_eigenvalues(design.eigenvalues),
            "fixed_modes": _plain_eigenvalues(design.fixed_modes),
            "lambda_obs": design.lambda_obs,
        }
        context.add_metadata(name, metadata)
        linear = observer_model(
            model.reduced, design, x_a0=self.x_a0, q0=self.q0, constant=model.constant
        )
        return model.declare(linear)

    def advice(self, held: Mapping[str, bool], h: float) -> list[str]:
        product = self.filter_rate * h
        names = " and ".join(name for name, is_held in held.items() if is_held)
        if not names or product <= HOLD_LIMIT:
            return []
        gain = product / -math.expm1(-product) - 1.0
        return [
            f"zero-order hold of {names} over the step (discrete, extrapolated in a "
            f"loop, or by input_interpolation), filter_rate x step = {product:g}: the derivative "
            f"filter reads a ramp {gain:.0%} too high and a jump filter_rate times; "
            "do not trust delta"
        ]

    def design(self, name: str, context: BuildContext) -> DesignedObserver:
        """Design the observer (14)-(18)."""
        model = self._design_model(name, context)
        L = None
        if self.L is not None:
            rows = tuple(row if isinstance(row, tuple) else (row,) for row in self.L)
            L = matrix(rows, "L")
        design = observer.design(model.reduced, L=L, poles=self.poles, filter_rate=self.filter_rate)
        return DesignedObserver(model, design)

    def _design_model(self, name: str, context: BuildContext) -> DesignModel:
        from cosim.fmi.linearizing.request import LinearizationRequest

        model = self.model
        if isinstance(model, str):
            return DesignModel(reduce(context.model(model)))
        inputs = None
        if model.inputs is not None:
            inputs = (*model.inputs, *model.disturbances)
        request = LinearizationRequest(
            at=model.at, start=model.start, inputs=inputs, outputs=model.outputs
        )
        linearization = context.linearization(name, model.fmu, request)
        return design_model(linearization, model.disturbances)


def _plain_eigenvalues(eigenvalues: NDArray[Any]) -> list[float | str]:
    """Return eigenvalues as JSON can write them: complex ones as text."""
    return [str(complex(v)) if v.imag else float(v.real) for v in eigenvalues]
