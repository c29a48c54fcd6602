"""Field data: samples of a file, at their own times, in the place of a plant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar, Final, Literal

import numpy as np
from pydantic import Field, StrictStr

from cosim.arrays import Vector
from cosim.blocks.field_data import (
    SAMPLE_TIMES,
    FieldData,
    FieldRecording,
    check_covers,
    samples_of,
)
from cosim.blocks.renaming import Renaming
from cosim.core.clock import Clock
from cosim.core.contracts import Component
from cosim.core.port import Port
from cosim.core.signals import Interface, Signal
from cosim.errors import UsageError
from cosim.instants import NANOSECONDS
from cosim.native.step import LARGEST_MEMORY
from cosim.scenario.data_files.field_file import read_field_data
from cosim.scenario.document.schema import Number, UnitName
from cosim.scenario.kinds.base import BuildContext
from cosim.scenario.kinds.plants import PlantKind

MOST_SAMPLES: Final = 1000  # in one communication step
FEWEST_SAMPLES: Final = 3  # in a run: fewer are a straight line


class FieldDataKind(PlantKind):
    """Samples of a file (.csv, .parquet) at their own times, straight lines between them."""

    ports: ClassVar[str] = "-> columns of the file, samples of each, sample_times"
    is_recorded: ClassVar[bool] = True
    kind: Literal["field-data"]
    path: str = Field(description="path of a CSV file, or of one in Parquet (.parquet)")
    time: str | None = Field(
        None, description="name of the column of the times; default: the first"
    )
    time_unit: UnitName | None = Field(
        None, description="unit of the times; default: as in the name of the column, t [ms], or s"
    )
    offset: Number | Literal["first"] = Field(
        0.0, description='time stamp that is t = 0, as the file has it; "first": the first one'
    )
    columns: dict[str, StrictStr | list[StrictStr]] | None = Field(
        None,
        description='columns by output, like { y = "level", x_a = ["s1", "s2"] }; default: every '
        "column is an output of its name, x[0], x[1], ... are the elements of x",
    )
    separator: str | None = Field(
        None,
        description="of the columns of a CSV file; default: the one in its first line, a tab, "
        "semicolon, bar or comma",
    )
    decimal: Literal[".", ","] = Field(".", description="decimal sign of a CSV file")
    maximum_gap: Number | None = Field(
        None,
        description="longest time between two samples [s]; default: ten times the median",
    )

    @property
    def jumps_at_points(self) -> bool:
        return False

    @property
    def follows_inputs(self) -> bool:
        """It has none."""
        return False

    @property
    def units(self) -> Mapping[str, str]:
        """The units of the table by port, those of the samples too."""
        units = dict(super().units)
        for port, unit in super().units.items():
            units.setdefault(samples_of(port), unit)
        return units

    def samples_of(self, output: str) -> str | None:
        return samples_of(output)

    @property
    def samples_at_points(self) -> bool:
        return False

    def renamings(self, interface: Interface, given: Sequence[Renaming]) -> Sequence[Renaming]:
        """Add the samples of each renamed output."""
        most = interface.by_name[SAMPLE_TIMES].size
        outputs = interface.by_name
        added = []
        for renaming in given:
            samples = [_samples_behind(source, outputs, most) for source in renaming.sources]
            sources = tuple(port for port in samples if port is not None)
            if len(sources) == len(samples):
                port = _samples_shown(renaming.port, most)
                added.append(Renaming(port, sources, renaming.causality))
        return [*given, *added]

    def build(self, name: str, context: BuildContext) -> Component:
        data = context.field_data(name, lambda: self._read(context))
        points = _points(context.clock)
        check_covers(data, points, self.maximum_gap)
        most = data.most_in_a_step(points)
        if most > MOST_SAMPLES or most * len(points) > LARGEST_MEMORY:
            raise UsageError(
                f"{data.source} has {most} samples in one of {len(points) - 1} communication "
                f"steps, and every step has a place for as many; needed at most {MOST_SAMPLES}, "
                f"and {LARGEST_MEMORY} places: a smaller step, or a file without the burst"
            )
        in_run = (data.t >= points[0]) & (data.t <= points[-1])
        samples = int(np.count_nonzero(data.measured & in_run))
        if samples < FEWEST_SAMPLES:
            context.warn(name, self._too_few(data, samples, points))
        context.add_metadata(name, {"samples": samples, "samples_in_a_step": most})
        return FieldRecording(data, most=most)

    def _too_few(self, data: FieldData, samples: int, points: Vector) -> str:
        """Return what may be wrong where a run has hardly a sample."""
        distance = float(np.median(np.diff(data.t)))
        text = (
            f"{data.source}: {samples} of {len(data.t)} samples are within the run, {points[0]:g} "
            f"s to {points[-1]:g} s, as their median distance is {distance:g} s"
        )
        if self.time_unit is None:
            text += '; are the times in another unit than s? Then time_unit says so, as "ms"'
        return text

    def most_in_a_step(self, name: str, context: BuildContext) -> int:
        """Return for how many samples in a communication step there is a place."""
        recorded = context.recorded(name)
        if recorded is not None and SAMPLE_TIMES in recorded.by_name:
            return recorded.by_name[SAMPLE_TIMES].size
        data = context.field_data(name, lambda: self._read(context))
        return data.most_in_a_step(_points(context.clock))

    def _read(self, context: BuildContext) -> FieldData:
        return read_field_data(
            context.file(self.path),
            time=self.time,
            time_unit=self.time_unit,
            offset=self.offset,
            columns=self.columns,
            separator=self.separator,
            decimal=self.decimal,
        )


def _samples_behind(source: Port, outputs: Mapping[str, Signal], most: int) -> Port | None:
    """Return the samples of an output, ``most`` an element; None: it has none."""
    matched = source.find(outputs)
    if matched is None:
        return None
    signal, elements = matched
    name = samples_of(signal.name)
    if name not in outputs:
        return None
    places = range(elements.start * most, elements.stop * most)
    return Port(source.component, name, places)


def _samples_shown(shown: Port, most: int) -> Port:
    """Return the port that shows the samples of what ``shown`` shows, ``most`` an element."""
    places: range | None = None
    match shown.element:
        case int(index):
            places = range(index * most, (index + 1) * most)
        case range() as indices:
            places = range(indices.start * most, indices.stop * most)
    return replace(shown, signal=samples_of(shown.signal), element=places)


def _points(clock: Clock) -> Vector:
    """Return the communication points [s]."""
    steps = np.arange(clock.steps + 1)
    points: Vector = (clock.start_ns + clock.step_ns * steps) / NANOSECONDS
    return points
