"""What a run says about itself, from its recording alone: errors against the truth, estimates, start times, a verdict."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from cosim.arrays import Matrix, Vector, as_columns
from cosim.core.contracts import Recording
from cosim.core.signals import Signal
from cosim.theory.uncertainty import information, verdict
from cosim.units import conversion


@dataclass(frozen=True)
class SignalError:
    """An estimated signal against the signal it should equal."""

    estimate: str
    truth: str
    since: float  # s
    largest: float  # |error| from there on
    rms: float
    last: float  # |error| at the end


@dataclass(frozen=True)
class ValueOutcome:
    """An estimated constant against its true value."""

    estimate: str
    value: float | None  # None: no value yet
    truth: float
    error: float | None


@dataclass(frozen=True)
class Identification:
    """What the data of an identifier carry."""

    component: str
    start_time: float  # s, the communication point it starts at
    times: Mapping[str, float]  # T_obs, T_f, D_max, T_id where it was computed
    eigenvalues: tuple[float, ...]  # of the information matrix of delta as it was reconstructed
    verdict: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Summary:
    """Everything the table after a run shows."""

    scenario: str
    end: float  # s
    steps: int
    status: str = "complete"
    reason: str = ""  # why it ended so
    signals: tuple[SignalError, ...] = ()
    values: tuple[ValueOutcome, ...] = ()
    identifications: tuple[Identification, ...] = ()
    last: Mapping[str, float | list[float]] = field(
        default_factory=dict
    )  # where there is no truth: every output at the end
    loops: tuple[
        str, ...
    ] = ()  # stages that advance step by step: an error of first order in the step

    def to_dict(self) -> dict[str, Any]:
        """Give plain values for JSON."""
        return asdict(self)


def truth_of(recording: Recording) -> dict[str, Any]:
    """Give what each estimate of a run should equal: the name of a signal, or values."""
    truth: dict[str, Any] = json.loads(recording.metadata.get("cosim.run", {}).get("truth", "{}"))
    return truth


def rows_of(recording: Recording, port: str, *, like: str | None = None) -> Matrix:
    """Give a signal, or one element of it, at every recorded row, shape (N, size); in the unit of ``like``, another port."""
    name, columns = _part(recording, port)
    rows = as_columns(recording[name])[:, columns]
    if like is None:
        return rows
    found = conversion(signal_of(recording, port).measure, signal_of(recording, like).measure)
    assert found is not None  # it was checked before the run
    return found(rows)


def signal_of(recording: Recording, port: str) -> Signal:
    """Give the signal of a recorded port, or of one element of it."""
    component, _, name = _part(recording, port)[0].partition(".")
    return next(signal for signal in recording.channels[component].signals if signal.name == name)


def has_signal(recording: Recording, signal: str) -> bool:
    """Whether ``component.signal`` was recorded."""
    component, _, name = signal.partition(".")
    return component in recording.channels and name in (
        one.name for one in recording.channels[component].signals
    )


def _part(recording: Recording, port: str) -> tuple[str, slice]:
    """Split a port into its signal and the columns of it; what is none of a recorded signal stays as it is."""
    element = re.fullmatch(r"(.*)\[(\d+)\]", port)
    if element is None or has_signal(recording, port) or not has_signal(recording, element[1]):
        return port, slice(None)
    index = int(element[2])
    return (
        (element[1], slice(index, index + 1))
        if index < signal_of(recording, element[1]).size
        else (port, slice(None))
    )


def difference(first: Recording, other: Recording, signal: str) -> tuple[Matrix, Matrix]:
    """Give the instants that two recordings of a signal share [s], and there the second minus the first, shape (N, size)."""
    component = signal.partition(".")[0]
    times, i, j = np.intersect1d(
        first.time_ns(component), other.time_ns(component), return_indices=True
    )
    return times / 1e9, as_columns(other[signal])[j] - as_columns(first[signal])[i]


def summarize(recording: Recording) -> Summary:
    """Summarize a run; the truth and the start times come from the recording's metadata."""
    run = recording.metadata.get("cosim.run", {})
    truth = truth_of(recording)
    metadata = {name: _component_metadata(recording, name) for name in recording.channels}
    starts = [found["start_time"] for found in metadata.values() if "start_time" in found]
    since = max(starts, default=0.0)
    loops = tuple(
        stage for stage in json.loads(run.get("schedule", "[]")) if not stage.startswith("cascade ")
    )
    signals, values = [], []
    for estimate, true in truth.items():
        if isinstance(true, str):
            signals.append(_signal_error(recording, estimate, true, since))
        else:
            values += _value_errors(
                recording, estimate, np.atleast_1d(np.array(true, dtype=np.float64))
            )
    return Summary(
        scenario=run.get("scenario", ""),
        end=recording.end_ns / 1e9,
        steps=recording.steps,
        status=recording.status,
        reason=recording.reason,
        signals=tuple(signals),
        values=tuple(values),
        last={} if truth else _last(recording),
        identifications=tuple(
            _identification(recording, name, found)
            for name, found in metadata.items()
            if "unknowns" in found
        ),
        loops=loops,
    )


def _last(recording: Recording) -> dict[str, float | list[float]]:
    names = [
        f"{name}.{signal.name}"
        for name, channel in recording.channels.items()
        for signal in channel.interface.outputs
    ]
    return {name: rows[-1].tolist() for name in names if len(rows := recording[name])}


def _component_metadata(recording: Recording, component: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(
        recording.metadata.get(f"cosim.component.{component}", {}).get("metadata", "{}")
    )
    return found


def _signal_error(recording: Recording, estimate: str, true: str, since: float) -> SignalError:
    a, b = (recording.time_ns(port.partition(".")[0]) for port in (estimate, true))
    shared, i, j = np.intersect1d(a, b, return_indices=True)
    error = np.abs(rows_of(recording, estimate)[i] - rows_of(recording, true, like=estimate)[j])
    if not shared.size or shared[-1] / 1e9 < since:  # the run ended before the identification began
        since = 0.0
    window = error[shared / 1e9 >= since]
    rms = float(np.sqrt(np.mean(window**2))) if window.size else float("nan")
    return SignalError(
        estimate,
        true,
        since,
        float(window.max(initial=0.0)),
        rms,
        float(error[-1].max()) if len(error) else float("nan"),
    )


def _value_errors(recording: Recording, estimate: str, true: Vector) -> list[ValueOutcome]:
    rows = as_columns(recording[estimate])
    found = rows[-1] if len(rows) else np.full(len(true), np.nan)
    names = [estimate] if len(true) == 1 else [f"{estimate}[{i}]" for i in range(len(true))]
    return [
        ValueOutcome(
            name,
            None if np.isnan(v) else float(v),
            float(t),
            None if np.isnan(v) else float(abs(v - t)),
        )
        for name, v, t in zip(names, found, true, strict=True)
    ]


def _identification(
    recording: Recording, component: str, metadata: Mapping[str, Any]
) -> Identification:
    """Judge the information in the rows that an identifier was given."""
    rows = as_columns(recording[f"{component}.regressor"])
    time = recording.time_ns(component) / 1e9
    used = rows[time >= metadata["start_time"]]
    times = {key: metadata[key] for key in ("T_obs", "T_f", "D_max", "T_id") if key in metadata}
    notes = tuple(metadata.get("notes", ()))
    if len(used) < 2:
        return Identification(
            component,
            metadata["start_time"],
            times,
            (),
            "the run ended before the identification began",
            notes,
        )
    eigenvalues: Vector = np.linalg.eigvalsh(
        information(used[:, 1:], float(time[1] - time[0]))
    ).astype(np.float64)
    prior = None if metadata["P0"] is None else 1.0 / metadata["P0"]
    return Identification(
        component,
        metadata["start_time"],
        times,
        tuple(map(float, eigenvalues)),
        verdict(eigenvalues, prior),
        notes,
    )
