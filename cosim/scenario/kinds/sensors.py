"""Sensors: what a measurement reports of a signal."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

from pydantic import Field

from cosim.blocks.late_samples import MOST_IN_A_STEP
from cosim.blocks.measurement import SensorParameters
from cosim.blocks.sensor import Sensor
from cosim.core.clock import nanoseconds
from cosim.core.contracts import Component
from cosim.core.signals import samples_of
from cosim.errors import UsageError
from cosim.instants import StepNs
from cosim.scenario.document.schema import (
    Flag,
    Number,
    NumberRow,
    Size,
    StepTime,
    Whole,
)
from cosim.scenario.kinds.base import (
    BuildContext,
    PeriodicKind,
    PortUnits,
    unit_of,
)
from cosim.scenario.kinds.capabilities import HasSamples
from cosim.scenario.kinds.values import Sampling, StepDependence

EACH = ", one number or one per element"


class SensorKind(PeriodicKind, HasSamples):
    """y = u with delay, jitter, bias, noise, limits, quantization, dropouts, in this order."""

    ports: ClassVar[str] = "u -> y, valid, y_samples, sample_times"
    kind: Literal["sensor"]
    delay: Number = Field(
        0.0,
        description="y(t) samples u(t - delay) [s]; u is interpolated between communication points",
    )
    jitter: Number = Field(
        0.0,
        description="largest deviation of the sampling instant [s], uniformly distributed, at most "
        "half a period; beyond t, u is extrapolated linearly",
    )
    bias: Number | NumberRow = Field(0.0, description=f"constant error of y{EACH}")
    noise: Number | NumberRow = Field(
        0.0, description=f"standard deviation of the Gaussian noise of y{EACH}"
    )
    lower: Number | NumberRow | None = Field(
        None, description=f"lower limit of y{EACH}; default: none"
    )
    upper: Number | NumberRow | None = Field(
        None, description=f"upper limit of y{EACH}; default: none"
    )
    resolution: Number | NumberRow | None = Field(
        None,
        description=f"quantization step of y{EACH}; default: none",
    )
    bits: Whole | None = Field(
        None,
        description="quantization to 2**bits levels from lower to upper, in place of resolution",
    )
    dropout: Number | None = Field(
        None,
        description="probability of losing a sample: y keeps its value, the output valid is 0; "
        "default: no losses, no output valid",
    )
    seed: Whole | None = Field(
        None,
        description="seed of noise, jitter and dropouts, required with any of them; sensors with "
        "equal seeds have equal random numbers",
    )
    period: StepTime | None = Field(
        None,
        description="sample period [s], a multiple of the communication step, with zero-order hold "
        "of y; default: one step, y interpolated like u. With period, dropout or time_stamps the "
        "outputs y_samples and sample_times give the samples alone",
    )
    time_stamps: Flag = Field(
        False,
        description="sample_times are the sampling instants t - delay + jitter, not the times of "
        "arrival",
    )
    size: Size = Field(1, description="number of elements, with independent errors")
    unit: PortUnits = Field(None, description=unit_of("u and y"))

    def with_period(self, component: Component, n: int) -> Component:
        return component

    @property
    def step_dependence(self) -> StepDependence:
        noise = self.noise if isinstance(self.noise, tuple) else (self.noise,)
        is_random = any(noise) or bool(self.jitter) or self.dropout is not None
        return StepDependence(draws=is_random and self.period is None, times=(self.delay,))

    def sampling(self, n: int) -> Sampling | None:
        return None if self.period is None else Sampling(n, 0, True)

    @property
    def _offers_samples(self) -> bool:
        """Whether y has values that are no new samples."""
        return self.period is not None or self.dropout is not None or self.time_stamps

    def samples_of(self, output: str) -> str | None:
        return samples_of(output) if output == "y" and self._offers_samples else None

    @property
    def samples_at_points(self) -> bool:
        return not self.time_stamps

    def most_in_a_step(self, name: str, context: BuildContext) -> int:
        if self.time_stamps:
            return MOST_IN_A_STEP
        return 1 if self._offers_samples else 0

    def late_steps(self, context: BuildContext) -> int:
        if not self.time_stamps:
            return 0
        latest = _steps("delay", self.delay, context.step_ns)
        latest += _steps("jitter", self.jitter, context.step_ns)
        return math.floor(latest) + 1

    def build(self, name: str, context: BuildContext) -> Sensor:
        parameters = SensorParameters(
            noise=self.noise,
            bias=self.bias,
            lower=self.lower,
            upper=self.upper,
            resolution=self.resolution,
            bits=self.bits,
            delay=_steps("delay", self.delay, context.step_ns),
            jitter=_steps("jitter", self.jitter, context.step_ns),
            dropout=self.dropout,
            seed=self.seed,
            period=self.period_steps(name, context.step_ns),
        )
        return Sensor(
            parameters,
            size=self.size,
            unit=self.unit_name,
            samples=self._offers_samples,
            stamped=self.time_stamps,
            holds=self.period is not None,
        )


def _steps(key: str, time: float, step_ns: StepNs) -> float:
    """Return a time [s] in communication steps, also parts of a step."""
    if time < 0.0:
        raise UsageError(f"{key}: expected a time >= 0 s, got {time} s")
    return float(nanoseconds(time) / step_ns)
