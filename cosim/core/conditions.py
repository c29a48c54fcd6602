"""Conditions over the rows of a run: ``abs(observer.delta - delta.y) < 1e-3 for 1 s``.

:mod:`cosim.native.numerics.expression` describes the language. A condition looks at rows as they
are recorded; where an input jumps at a communication point, that is its left limit.
"""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal
from typing import final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.core.clock import NANOSECONDS, whole_steps
from cosim.core.recorded import find_signal
from cosim.core.signals import Layout
from cosim.errors import ClockError, UnknownSignalError, UsageError, quoted
from cosim.native.numerics.expression import compile_condition
from cosim.native.numerics.programs import RowProgram


@final
class Condition:
    """A condition, and how long it has held.

    It *comes true* at a row where it is true and was not at the row before; at the first row of a
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

    def __init__(self, text: str, layout: Layout, step_ns: int) -> None:
        compiled = compile_condition(text)
        start = f"condition {quoted(text)}"
        columns = signal_columns(compiled.program.signals, layout, start)
        self.text = text
        self.held = 0
        self._program = RowProgram(compiled.program.with_columns(columns))
        self._needed = 1 + _duration_steps(compiled.duration_ns, step_ns, start)

    @property
    def is_true(self) -> bool:
        """Whether it is true at the last row that was passed."""
        return self.held >= self._needed

    def comes_true(self, time: Vector, rows: Matrix) -> int | None:
        """Return the first of the next rows at which it comes true; None: at none of them.

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
        holds = self._program.evaluate(time, rows) == 1.0
        numbers = np.arange(len(rows))
        breaks = np.where(holds, -1 - self.held, numbers)
        return numbers - np.maximum.accumulate(breaks)


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
            found = find_signal(channels, name, source="the graph")
        except UnknownSignalError as error:
            raise UsageError(f"{start}: {error}") from error
        if found.size != 1:
            raise UsageError(
                f"{start}: '{name}' has {found.size} elements; needed one of them, such as "
                f"{found.channel.name}.{found.signal.elements[0]}"
            )
        columns.append(found.channel.start + found.columns.start)
    return columns


def _duration_steps(duration_ns: int, step_ns: int, start: str) -> int:
    """Return a duration in communication steps."""
    try:
        return whole_steps(str(Decimal(duration_ns) / NANOSECONDS), step_ns, "for")
    except ClockError as error:
        raise UsageError(f"{start}: {error}") from error
