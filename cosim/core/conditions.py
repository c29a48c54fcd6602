"""Conditions over the rows of a run: ``abs(observer.delta - delta.y) < 1e-3 for 1 s``.

:mod:`cosim.native.numerics.expression` describes the language. A condition looks at rows as they
are recorded; where an input jumps at a communication point, that is its left limit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from decimal import Decimal
from fractions import Fraction
from typing import final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.core.arguments import check_type
from cosim.core.clock import Clock, seconds, whole_steps
from cosim.core.contracts import Stopped
from cosim.core.recorded.signals import find_signal
from cosim.core.signals import Layout
from cosim.errors import ClockError, UnknownSignalError, UsageError, quoted
from cosim.instants import NANOSECONDS, Grid, StepNs
from cosim.native.numerics.expression import compile_condition
from cosim.native.numerics.programs import RowProgram


@final
class Condition:
    """A condition, and how long it has held.

    It *is met* at a row where it is true and was not at the row before; at the first row of a
    run where it is true. With ``for`` a duration it is true where it held without a break for so
    long, up to that row.

    Parameters
    ----------
    text : str
    layout : Layout
        Of the rows.
    step_ns : int
        Communication step [ns].

    Attributes
    ----------
    text : str
    held : int
        Rows without a break, up to the last one that was passed, at which it held. To go back, set
        it to what it was.

    Raises
    ------
    UsageError
        If the text is no condition, if there is no such signal, or it has several elements, or the
        duration is no whole number of communication steps.
    """

    def __init__(self, text: str, layout: Layout, step_ns: StepNs) -> None:
        compiled = compile_condition(text)
        start = f"condition {quoted(text)}"
        columns = signal_columns(compiled.program.signals, layout, start)
        self.text = text
        self.held = 0
        self._step_ns = step_ns
        self._program = RowProgram(compiled.program.with_columns(columns))
        self._needed = 1 + _duration_steps(compiled.duration_ns, step_ns, start)

    @property
    def is_true(self) -> bool:
        """Whether it is true at the last row that was passed."""
        return self.held >= self._needed

    def comes_true(self, time: Vector, rows: Matrix) -> int | None:
        """Return the first of the next rows at which it is met; None: at none of them.

        Nothing is changed: :meth:`pass_over` goes on, by these rows or some of them.

        Parameters
        ----------
        time : Vector, shape (N,)
            Instants of the rows [s].
        rows : Matrix, shape (N, width)
            Behind the last one that was passed.
        """
        is_true = self._held_at(time, rows) >= self._needed
        was_true = np.concatenate([[self.is_true], is_true[:-1]])
        rises = is_true & ~was_true
        return int(rises.argmax()) if rises.any() else None

    def pass_over(self, time: Vector, rows: Matrix) -> None:
        """Go on over the next rows, as of :meth:`comes_true`."""
        if len(rows):
            self.held = int(self._held_at(time, rows)[-1])

    def _held_at(self, time: Vector, rows: Matrix) -> NDArray[np.int64]:
        """Return the number of rows without a break, up to each, at which it held."""
        if isinstance(self._step_ns, Fraction):  # t of a condition is what the log has
            numbers = np.rint(time * NANOSECONDS / float(self._step_ns)).astype(np.int64)
            time = seconds(Grid(0, self._step_ns).stamp(numbers))
        holds = self._program.evaluate(time, rows) == 1.0
        numbers = np.arange(len(rows))
        breaks = np.where(holds, -1 - self.held, numbers)
        return numbers - np.maximum.accumulate(breaks)


@final
class RunConditions:
    """The conditions that a run looks for.

    Parameters
    ----------
    until : Condition, optional
        Ends the run where it is met.
    others : sequence of Condition
        Interrupt it there.

    Attributes
    ----------
    came_true : tuple of Condition
        Those that came true at the last row that was passed.
    """

    def __init__(self, until: Condition | None = None, others: Sequence[Condition] = ()) -> None:
        self.came_true: tuple[Condition, ...] = ()
        self._until = until
        self._conditions = (*(() if until is None else (until,)), *others)

    def __bool__(self) -> bool:
        return bool(self._conditions)

    def begin(self, t: float, row: Vector) -> None:
        """Pass the first row of a run, at ``t`` [s], and nothing before it."""
        for condition in self._conditions:
            condition.held = 0
        self.pass_over(np.array([t]), row[np.newaxis])

    @property
    def is_over(self) -> bool:
        """Whether the run ends at the last row that was passed."""
        return self._until is not None and self._until.is_true

    def end_at(self, t: float) -> Stopped | None:
        """Return the stop at ``t`` [s], of the last row passed; None: the run goes on."""
        if self._until is None or not self._until.is_true:
            return None
        reason = f"{until_text(self._until.text)}: came true at t = {t} s"
        return Stopped(np.empty((0, 0)), reason, failed=False)

    @property
    def held(self) -> dict[str, int]:
        """For how many rows each condition has held; to go back, set it to what it was."""
        return {condition.text: condition.held for condition in self._conditions}

    @held.setter
    def held(self, held: Mapping[str, int]) -> None:
        self.came_true = ()
        for condition in self._conditions:
            condition.held = held.get(condition.text, 0)

    def pass_over(self, time: Vector, rows: Matrix) -> int:
        """Go on over the next rows, up to the first one at which a condition is met.

        Parameters
        ----------
        time : Vector, shape (N,)
            Instants of the rows [s].
        rows : Matrix, shape (N, width)
            Behind the last one that was passed.

        Returns
        -------
        int
            How many rows were passed.
        """
        rows_true = [condition.comes_true(time, rows) for condition in self._conditions]
        first = min((row for row in rows_true if row is not None), default=None)
        count = len(rows) if first is None else first + 1
        self.came_true = ()
        for condition, row in zip(self._conditions, rows_true, strict=True):
            condition.pass_over(time[:count], rows[:count])
            if row is not None and row == first:
                self.came_true += (condition,)
        return count


def conditions_until(
    until: str | None, layout: Layout, clock: Clock, others: Sequence[str] = ()
) -> RunConditions:
    """Return what a run looks for.

    Parameters
    ----------
    until : str or None
        Ends the run where it is met.
    layout : Layout
    clock : Clock
    others : sequence of str
        Interrupt it there.

    Raises
    ------
    UsageError
        As from :class:`Condition`; also if it is no text.
    """
    end: Condition | None = None
    if until is not None:
        check_type("until", until, str, UsageError)
        end = Condition(until, layout, clock.step_ns)
    return RunConditions(end, [Condition(text, layout, clock.step_ns) for text in others])


def until_text(text: str) -> str:
    """Return how messages name the condition that ends a run."""
    return f"until {quoted(text)}"


def signal_columns(signals: Sequence[str], layout: Layout, start: str) -> list[int]:
    """Return the columns of signals of one element each.

    Parameters
    ----------
    signals : sequence of str
    layout : Layout
    start : str
        What names them, for messages.

    Raises
    ------
    UsageError
        If there is no such signal, or it has several elements.
    """
    channels = {channel.name: channel for channel in layout.channels}
    columns = []
    for name in signals:
        try:
            signal = find_signal(channels, name, source="the graph")
        except UnknownSignalError as error:
            raise UsageError(f"{start}: {error}") from error
        if signal.size != 1:
            raise UsageError(
                f"{start}: expected one element, got '{name}' with {signal.size} elements; use "
                f"for example {signal.channel.name}.{signal.signal.elements[0]}"
            )
        columns.append(signal.channel.start + signal.columns.start)
    return columns


def _duration_steps(duration_ns: int, step_ns: StepNs, start: str) -> int:
    """Return a duration in communication steps."""
    try:
        return whole_steps(str(Decimal(duration_ns) / NANOSECONDS), step_ns, "for")
    except ClockError as error:
        raise UsageError(f"{start}: {error}") from error
