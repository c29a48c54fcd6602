"""When an identifier starts: a given time, or one after the transients of its observer."""

from __future__ import annotations

import math
from dataclasses import asdict

from pydantic import Field

from cosim.core.clock import LARGEST_NS, Clock
from cosim.errors import AssumptionError, UsageError
from cosim.instants import StepNs, step_seconds
from cosim.native.estimation.alphas import signals_among
from cosim.scenario.document.schema import Number, TomlTable
from cosim.scenario.kinds.base import BuildContext
from cosim.scenario.kinds.identification_source import IdentifierSource
from cosim.theory.observers.observer import IdentificationStartTime, identification_start_time


class StartTable(TomlTable):
    """Identification start time T_id by (36)-(38)."""

    epsilon_observer: Number = Field(
        description="remaining fraction of the initial observer error at T_id, in (0, 1)"
    )
    epsilon_filter: Number = Field(
        description="remaining fraction of the initial filter transient at T_id, in (0, 1)"
    )


DEFAULT_START = StartTable(epsilon_observer=1e-3, epsilon_filter=1e-3)


def start_time(
    start: Number | StartTable | None, source: IdentifierSource, context: BuildContext
) -> float:
    """Return the first communication point not before T_id, and record it.

    A computed T_id is counted from the start of the run.

    Raises
    ------
    UsageError
        If it is to be computed, and there is no observer to compute it from.
    AssumptionError
        If the regressor has no value there, or it is in no run.
    """
    clock = context.clock
    if start is None:
        start = DEFAULT_START
    if isinstance(start, StartTable):
        times = _computed(start, source)
        context.add_metadata(source.identifier, asdict(times))
        T_id = times.T_id
        elapsed_ns = T_id * 1e9
    else:
        T_id = float(start)
        elapsed_ns = T_id * 1e9 - clock.start_ns
    # Rounded to 1e-3 ns: a T_id on a communication point must not become the next point.
    elapsed_ns = round(elapsed_ns, 3)
    _check_past(T_id, elapsed_ns, source, clock)
    if not T_id <= LARGEST_NS / 1e9:
        raise AssumptionError(
            f"start: expected T_id within a run, got {T_id:g} s; if it is computed: increase "
            "filter_rate, move the eigenvalues of the observer to the left, or increase the "
            "fractions"
        )
    steps = math.ceil(elapsed_ns / clock.step_ns)
    time = clock.grid.instant(steps)
    context.add_metadata(source.identifier, {"start_time": time})
    return time


def _check_past(T_id: float, elapsed_ns: float, source: IdentifierSource, clock: Clock) -> None:
    """Check that the regressor has a value at T_id."""
    longest = max(source.regression.delays)
    window = source.window
    signals_ns = source.regression.samples_of_signals * clock.step_ns
    if signals_ns:
        _check_past_of_signals(T_id, elapsed_ns, signals_ns, source)
    if elapsed_ns >= round((longest + window) * 1e9, 3):
        return
    since = f" after start_time, {clock.start_time} s" if clock.start_ns else ""
    plus = f" and the observer's window, {window} s," if window else ""
    raise AssumptionError(
        f"start: expected at least the longest delay, {longest} s{plus}{since}, got {T_id} s; "
        "the regressor has no earlier value"
    )


def _check_past_of_signals(
    T_id: float, elapsed_ns: float, needed_ns: StepNs, source: IdentifierSource
) -> None:
    """Check that the alphas that are signals have a value so late as delta at T_id."""
    if elapsed_ns < needed_ns:
        names = ", ".join(repr(alpha.text) for alpha in signals_among(source.regression.alphas))
        raise AssumptionError(
            f"start: expected at least {step_seconds(needed_ns):g} s after the start of the run "
            f"(longest delay plus lag of delta), got {T_id} s; alpha {names} has no earlier value"
        )


def _computed(start: StartTable, source: IdentifierSource) -> IdentificationStartTime:
    """Compute T_id (36)-(38) from the observer that drives the regressor."""
    observer = source.observer
    if observer is None:
        raise UsageError(
            "start: to compute T_id, exactly one observer must drive the regressor; "
            "otherwise give start as a time [s]"
        )
    return identification_start_time(
        lambda_obs=observer.design.design.lambda_obs,
        filter_rate=observer.filter_rate,
        window=observer.window or None,
        delays=source.regression.delays,
        epsilon_observer=start.epsilon_observer,
        epsilon_filter=start.epsilon_filter,
    )
