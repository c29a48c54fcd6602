"""A component in its place: its columns, and the wires that feed its inputs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector, read_only
from cosim.core.contracts import Component
from cosim.core.signals import Channel, element_names
from cosim.core.stages.calls import GuardedComponent
from cosim.core.stages.left_limits import JumpColumns
from cosim.core.stages.overrides import Overrides
from cosim.core.stages.wires import Wire
from cosim.errors import NonFiniteError

END: Final = slice(1, 2)  # of the two rows of a step


@dataclass(frozen=True, slots=True)
class NonFinite:
    """A value that is infinite, or NaN where NaN does not mean "no value yet".

    ``label`` names it; ``column`` is its place in the row of the graph, ``row`` is counted from the
    first row searched. ``note`` is what is to be known of where it is.
    """

    label: str
    value: float
    column: int
    row: int = 0
    note: str = ""

    def error(self, t: float) -> NonFiniteError:
        """Return the error that names it, at time ``t`` [s]."""
        text = f"{self.label!r} became {self.value} at t = {t} s; everything before is kept"
        return NonFiniteError("; ".join(filter(None, (text, self.note))))


class Member:
    """A component with its columns and the wires that feed its inputs.

    Parameters
    ----------
    channel : Channel
        Name, interface and columns.
    component : Component
    wires : tuple of Wire

    Attributes
    ----------
    name : str
    component : GuardedComponent
    inputs, outputs, columns : slice
        In the row.
    n_u : int
        Number of input elements.
    optional : Mask, shape (n_u + n_y,)
        Which elements may have no value (NaN).
    takes_latest : bool
        Over a step its inputs have the values that they have at its end.
    jumps : JumpColumns or None
        What of it jumps, and is followed.
    overrides : Overrides
        Of its inputs.
    note : str
        What is to be known of it where a value becomes infinite: the loop that it is in.
    """

    def __init__(
        self,
        channel: Channel,
        component: Component,
        wires: tuple[Wire, ...],
        *,
        takes_latest: bool = False,
        jumps: JumpColumns | None = None,
    ) -> None:
        self.channel = channel
        self.name = channel.name
        self.component = GuardedComponent(channel, component)
        self.inputs = channel.inputs
        self.outputs = channel.outputs
        self.columns = channel.columns
        self.wires = wires
        self.takes_latest = takes_latest
        self.jumps = jumps
        self.n_u = channel.interface.n_u
        self.overrides = Overrides(self.n_u)
        self.note = ""
        optional: list[bool] = []
        for signal in channel.signals:
            optional += [signal.optional] * signal.size
        self.optional = np.array(optional, np.bool_)

    @property
    def column_numbers(self) -> NDArray[np.intp]:
        """The numbers of its columns in the row."""
        return np.arange(self.columns.start, self.columns.stop)

    def label(self, column: int) -> str:
        """Return the name of one of its elements, numbered from the first input."""
        return f"{self.name}.{element_names(self.channel.signals)[column]}"

    def non_finite(self, rows: Matrix) -> NDArray[np.bool_]:
        """Return where rows of its columns are infinite, or NaN that does not mean "no value"."""
        return ~np.isfinite(rows) & ~(np.isnan(rows) & self.optional)

    def first_non_finite_output(self, y: Vector) -> NonFinite | None:
        """Return the first of its outputs, if any, that is not finite."""
        values = np.concatenate([np.zeros(self.n_u), y])
        bad = self.non_finite(values)
        return self.non_finite_value(int(bad.argmax()), values) if bad.any() else None

    def non_finite_value(self, column: int, values: Vector, row: int = 0) -> NonFinite:
        """Describe one of its values, numbered from the first input, as not finite."""
        place = self.columns.start + column
        return NonFinite(self.label(column), float(values[column]), place, row, self.note)

    def gather(self, signals: Matrix, rows: slice) -> None:
        """Bring the inputs of some rows up to date."""
        for wire in self.wires:
            wire.copy(signals, rows)
        if self.overrides:
            self.overrides.copy(signals, rows)

    def gather_left(self, rows: Matrix) -> None:
        """Bring the inputs at the end of a step up to date, by left limits where these jump.

        Parameters
        ----------
        rows : Matrix, shape (2, width)
            The signals at both ends.
        """
        if self.jumps is None:
            self.gather(rows, END)
            return
        right = self.jumps.put(rows)
        self.gather(rows, END)
        self.jumps.put_back(rows, right)

    @property
    def returns_left_limits(self) -> bool:
        """Whether it returns left limits, and these are followed."""
        is_followed = self.jumps is not None and len(self.jumps.own) > 0
        return is_followed and bool(self.channel.interface.left_limits)

    def keep_outputs(self, rows: Matrix) -> None:
        """Fill the outputs at the end of a step with those at its start, left limits included."""
        rows[1, self.outputs] = rows[0, self.outputs]
        if self.jumps is not None:
            self.jumps.keep(rows)

    def reads_jumps(self, rows: Matrix) -> bool:
        """Return whether what it reads jumps at the end of a step."""
        return self.jumps is not None and bool(self.jumps.jumps(rows)[0])

    def inputs_over(self, rows: Matrix) -> Matrix:
        """Return its inputs at the ends of steps, shape (K+1, n_u), as it is to take them.

        Where it takes the latest values they jump between two steps: then for one step at a time.
        """
        u = rows[:, self.inputs]
        return read_only(np.vstack([u[1:], u[-1:]])) if self.takes_latest else u

    def driven(self, row: Vector) -> Vector:
        """Return a row with the inputs that their sources give, whatever overrides them."""
        rows = row[np.newaxis].copy()
        for wire in self.wires:
            wire.copy(rows, slice(0, 1))
        driven: Vector = rows[0]
        return driven


def driving_groups(groups: Sequence[Sequence[Member]]) -> list[set[int]]:
    """Return for each group of components the numbers of the groups that drive it."""
    writer: dict[int, int] = {}
    for number, members in enumerate(groups):
        for member in members:
            for column in range(member.outputs.start, member.outputs.stop):
                writer[column] = number
    drivers = []
    for members in groups:
        driving: set[int] = set()
        for member in members:
            for wire in member.wires:
                driving.update(writer[column] for column in wire.source_columns if column in writer)
        drivers.append(driving)
    return drivers


def first_non_finite(members: Iterable[Member], rows: Matrix) -> NonFinite | None:
    """Return the first value of some components that is not finite, by row.

    Of one row it is where the value arose: an output of a component whose inputs are finite, where
    there is one; else the first by component and signal.
    """
    suspects: list[tuple[Member, NDArray[np.bool_]]] = []
    for member in members:
        values = rows[:, member.columns]
        finite = np.isfinite(values)
        if not finite.all():
            bad = member.non_finite(values)
            if bad.any():
                suspects.append((member, bad))
    if not suspects:
        return None
    row = min(int(np.argmax(bad.any(axis=1))) for _, bad in suspects)
    at_row = [(member, bad[row]) for member, bad in suspects if bad[row].any()]
    causes = [(member, bad) for member, bad in at_row if not bad[: member.n_u].any()]
    member, bad_columns = (causes or at_row)[0]
    column = int(np.argmax(bad_columns))
    return member.non_finite_value(column, rows[row, member.columns], row)
