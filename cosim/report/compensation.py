"""What a compensator did: when its internal model became active, and what that changed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cosim.arrays import Matrix, Vector, as_columns
from cosim.core.recording import Recording
from cosim.errors import LogError
from cosim.scenario.record import Compensation, recorded_start
from cosim.theory.compensation.activation import Activation

LAST_PART = 0.25  # of the time since then, over which the error that is left is averaged


@dataclass(frozen=True)
class CompensationSummary:
    """The internal model of a compensator in a run.

    Parameters
    ----------
    component : str
    active_since : float or None
        When it became active [s]; None: it did not.
    reason : str
        Why not.
    theta : tuple of float
        With which theta it became active.
    last_theta : tuple of float
        And with which it ended.
    before : tuple of float
        Root mean square of each regulated error y - r, as measured, until it became active, or of
        the whole run.
    after : tuple of float
        The same of the last time since it became active; empty: it did not.
    since : float
        Where that time begins [s].
    interval : tuple of (lower, upper)
        Of every theta, for which the loop is proven to be stable.
    """

    component: str
    active_since: float | None
    reason: str
    theta: tuple[float, ...]
    last_theta: tuple[float, ...]
    before: tuple[float, ...]
    after: tuple[float, ...]
    since: float
    interval: tuple[tuple[float, ...], ...]


def summarize_compensation(
    recording: Recording, name: str, record: Compensation
) -> CompensationSummary:
    """Summarize what a compensator did, from its recorded rows.

    Raises
    ------
    LogError
        If these are not those of a compensator.
    """
    time = recording.time_ns(name) / 1e9
    error = _regulated_error(recording, name, record)
    is_active = as_columns(recording[f"{name}.active"])[:, 0] > 0.0
    if not is_active.any():
        reason = _reason(recording, name, record)
        start = recorded_start(recording)
        return CompensationSummary(
            name, None, reason, (), (), _rms(error), (), start, record.interval
        )
    first = int(is_active.argmax())
    end = float(time[-1])
    begin = float(time[first])
    since = end - LAST_PART * (end - begin)
    theta: Matrix = np.zeros((len(time), 0))
    if record.interval:
        theta = as_columns(recording[f"{name}.model_theta"])
    return CompensationSummary(
        component=name,
        active_since=begin,
        reason="",
        theta=tuple(theta[first].tolist()),
        last_theta=tuple(theta[-1].tolist()),
        before=_rms(error[:first]),
        after=_rms(error[time >= since]),
        since=since,
        interval=record.interval,
    )


def _regulated_error(recording: Recording, name: str, record: Compensation) -> Matrix:
    y = as_columns(recording[f"{name}.y"])
    r = as_columns(recording[f"{name}.r"])
    regulated = list(record.regulated)
    fits = all(0 <= element < y.shape[1] for element in regulated)
    if not fits or r.shape[1] != len(regulated):
        raise LogError(f"metadata of {name!r}: the regulated outputs do not fit to its y and r")
    error: Matrix = y[:, regulated] - r
    return error


def _reason(recording: Recording, name: str, record: Compensation) -> str:
    """Return why the internal model stayed out, by the last estimate."""
    if not record.internal_model:
        return "internal_model = false"
    ends: Matrix = np.array(record.interval, np.float64).reshape(-1, 2)
    theta = _last(recording, f"{name}.theta")
    standard_error = _last(recording, f"{name}.standard_error")
    if len(ends) != len(theta) or len(ends) != len(standard_error):
        raise LogError(f"metadata of {name!r}: the interval does not fit to its theta")
    activation = Activation(ends[:, 0], ends[:, 1], record.largest_error)
    return activation.reason(theta, standard_error) or "the run ended at the first good estimate"


def _last(recording: Recording, signal: str) -> Vector:
    rows = as_columns(recording[signal])
    last: Vector = rows[-1]
    return last


def _rms(error: Matrix) -> tuple[float, ...]:
    if not len(error):
        columns: int = error.shape[1]
        return (float("nan"),) * columns
    with np.errstate(over="ignore", invalid="ignore"):  # a recording may hold any numbers
        root = np.sqrt(np.mean(error**2, axis=0))
    return tuple(map(float, root))
