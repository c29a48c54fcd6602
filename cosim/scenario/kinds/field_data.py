"""Field data: samples of a file, at their own times, in the place of a plant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar, Final, Literal

import numpy as np
from pydantic import Field

from cosim.arrays import Vector
from cosim.blocks.field_data import (
    FieldData,
    FieldRecording,
    at_points,
    check_covers,
    check_step,
    units_of_samples,
)
from cosim.blocks.renaming import Renaming
from cosim.core.contracts import Component
from cosim.core.port import Port
from cosim.core.signals import SAMPLE_TIMES, Interface, PortUnit, samples_of
from cosim.errors import UsageError
from cosim.instants import StepNs
from cosim.native.step import LARGEST_MEMORY
from cosim.scenario.data_files.field_file import (
    FieldForm,
    field_data,
    message_data,
    read_samples,
)
from cosim.scenario.document.schema import Number, Whole
from cosim.scenario.kinds.base import BuildContext
from cosim.scenario.kinds.capabilities import DecidedByStep, HasSamples, RenamesMore
from cosim.scenario.kinds.plants import PlantKind
from cosim.scenario.kinds.values import StepDependence

MOST_SAMPLES: Final = 1000  # in one communication step
FEWEST_SAMPLES: Final = 3  # in a run: fewer are a straight line


class FieldDataKind(FieldForm, PlantKind, DecidedByStep, HasSamples, RenamesMore):
    """Recorded samples of a table or of an MCAP of another tool, at their own times."""

    ports: ClassVar[str] = "-> columns or fields of the file, samples of each, sample_times"
    is_recorded: ClassVar[bool] = True
    follows_inputs: ClassVar[bool] = False
    kind: Literal["field-data"]
    maximum_gap: Number | None = Field(
        None,
        description="longest time between two samples [s]; default: ten times the median; with "
        "zero-order interpolation no limit, but a warning",
    )
    extrapolation: Literal["error", "hold"] = Field(
        "error",
        description='after the recording: "error", or "hold" (last sample); a sample that '
        'interpolation = "zero-order" holds is held to the end of the recording in any case',
    )
    interpolation: Literal["linear", "zero-order"] | None = Field(
        None,
        description='between samples: "linear" interpolation (default) or "zero-order" hold; '
        "required for an MCAP if the step is shorter than the sample interval",
    )

    places: Whole | None = Field(
        None, gt=0, description="most samples per communication step; default: as found in the file"
    )

    @property
    def step_dependence(self) -> StepDependence:
        return StepDependence(jumps_at_points=False)

    def units_of(self, interface: Interface) -> Mapping[str, PortUnit]:
        """Return the units of the table by port, those of the samples too."""
        units = dict(self.units)
        signals = interface.by_name
        for port, unit in self.units.items():
            samples = signals.get(samples_of(port))
            if port in signals and samples is not None:
                most = samples.size // signals[port].size
                units.setdefault(samples.name, units_of_samples(unit, most))
        return units

    def decided(
        self, table: Mapping[str, Any], metadata: Mapping[str, Any], step_ns: StepNs
    ) -> Mapping[str, Any]:
        """Return the table with its interpolation, which has to be named with a smaller step.

        And with the places for samples, so that the rows have the same columns.
        """
        interpolation = self.interpolation or "linear"
        return {**table, "interpolation": interpolation, "places": metadata["samples_in_a_step"]}

    def samples_of(self, output: str) -> str | None:
        return samples_of(output)

    @property
    def samples_at_points(self) -> bool:
        return False

    def renamings(self, interface: Interface, given: Sequence[Renaming]) -> Sequence[Renaming]:
        """Add the samples of each renamed output."""
        outputs = interface.by_name
        most = outputs[SAMPLE_TIMES].size
        added = []
        for renaming in given:
            sources = []
            for source in renaming.sources:
                signal, elements = source.find(outputs) or (None, range(0))
                name = "" if signal is None else samples_of(signal.name)
                if name in outputs:
                    places = range(elements.start * most, elements.stop * most)
                    sources.append(Port(source.component, name, places))
            if len(sources) == len(renaming.sources):
                port = _samples_shown(renaming.port, most)
                added.append(Renaming(port, tuple(sources), renaming.causality))
        return [*given, *added]

    def build(self, name: str, context: BuildContext) -> Component:
        data = self._data(name, context)
        points = context.clock.points
        hold = self.interpolation == "zero-order"
        extrapolate = self.extrapolation == "hold"
        notes = check_covers(data, points, self.maximum_gap, hold=hold, extrapolate=extrapolate)
        if self.is_mcap and self.interpolation is None:
            check_step(data, context.clock.h)
        for text in (*data.diagnostics, *notes):
            context.warn(name, text)
        if data.discrete and not hold:
            context.warn(
                name,
                f"{data.source}: linear interpolation between Booleans or enumerations, "
                f"{', '.join(data.discrete)}: between two samples they are neither; "
                'interpolation = "zero-order" keeps the last one',
            )
        most = self._most(data, points)
        if most > MOST_SAMPLES or most * len(points) > LARGEST_MEMORY:
            raise UsageError(
                f"{data.source}: expected at most {MOST_SAMPLES} samples per communication step, "
                f"and {LARGEST_MEMORY} in all steps at the largest number, got {most} in one of "
                f"{len(points) - 1} steps; use a smaller step, or a file without the burst"
            )
        in_run = (data.t >= points[0]) & (data.t <= points[-1])
        samples = int(np.count_nonzero(data.measured & in_run))
        if samples < FEWEST_SAMPLES and not (hold and len(data.t) < FEWEST_SAMPLES):
            distance = float(np.median(np.diff(data.t))) if len(data.t) > 1 else 0.0
            text = (
                f"{data.source}: {samples} of {len(data.t)} samples are within the run, "
                f"{points[0]:g} s to {points[-1]:g} s, as their median distance is {distance:g} s"
            )
            if self.time_unit is None:
                text += '; are the times in another unit than s? Then time_unit says so, as "ms"'
            context.warn(name, text)
        context.add_metadata(name, {"samples": samples, "samples_in_a_step": most})
        if data.zero_ns is not None:
            context.add_metadata(name, {"zero_ns": data.zero_ns})
        return FieldRecording(data, most=most, hold=hold, end=np.inf if extrapolate else None)

    def most_in_a_step(self, name: str, context: BuildContext) -> int:
        """Return for how many samples in a communication step there is a place."""
        recorded = context.recorded(name)
        if recorded is not None and SAMPLE_TIMES in recorded.by_name:
            return recorded.by_name[SAMPLE_TIMES].size
        return self._most(self._data(name, context), context.clock.points)

    def _most(self, data: FieldData, points: Vector) -> int:
        return max(data.most_in_a_step(points), self.places or 1)

    def fields(self, mapped: Sequence[Port]) -> dict[str, list[str]]:
        """Return the fields of an MCAP by output: those of ``columns``, and what a map names."""
        fields = self.listed_columns
        for port in mapped:
            if fields.keys().isdisjoint({port.name, port.signal}):
                fields[port.name] = [port.name]
        return fields

    def _data(self, name: str, context: BuildContext) -> FieldData:
        """Return the samples; those of communication points have these as their times."""

        def read() -> FieldData:
            path = context.file(self.path)
            data = self._of_mcap(name, path, context) if self.is_mcap else field_data(path, self)
            return at_points(data, context.clock.points)

        return context.designed(name, read)

    def _of_mcap(self, name: str, path: Path, context: BuildContext) -> FieldData:
        """Read fields of an MCAP in one pass with those of the components from the same file.

        All of them have a sample at t = 0.
        """
        columns = self.fields(context.mapped(name))
        together = list(chain.from_iterable(columns.values()))
        for other, spec in context.of_kind(FieldDataKind).items():
            if (spec.path, spec.time, spec.time_unit) == (self.path, self.time, self.time_unit):
                together += chain.from_iterable(spec.fields(context.mapped(other)).values())
        samples = partial(
            context.made_once,
            "fields",
            f"{path} by {self.time} in {self.time_unit}",
            partial(read_samples, self, path, together),
        )
        return message_data(self, path, columns, samples)


def _samples_shown(shown: Port, most: int) -> Port:
    """Return the port that shows the samples of what ``shown`` shows, ``most`` an element."""
    places: range | None = None
    match shown.element:
        case int(index):
            places = range(index * most, (index + 1) * most)
        case range() as indices:
            places = range(indices.start * most, indices.stop * most)
    return replace(shown, signal=samples_of(shown.signal), element=places)
