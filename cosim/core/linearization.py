"""Components linearized at an operating point: what their steps do to small deviations."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Literal, TypeAlias

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.errors import GraphError

InputUse: TypeAlias = Literal["linear", "mean", "start"]
AT_REST: Final = 1e-9  # of the sum of the terms of x': what is left of them is rounding


@dataclass(frozen=True, slots=True)
class Linearized:
    """``x' = A x + B u``, ``y = C x + D u``: deviations from an operating point.

    Parameters
    ----------
    A, B, C, D : Matrix, shapes (n_x, n_x), (n_x, n_u), (n_y, n_x), (n_y, n_u)
    input_use : {"linear", "mean", "start"}
        How a step takes the inputs that have no zero-order hold: by linear interpolation, by the
        mean of both ends, or by their value from its start.
    corrected : Mask, shape (n_y,), optional
        The outputs that follow the inputs at the end of a step: ``D u1``. The others belong to what
        the step took as its inputs, and are not evaluated again for others. Left out: all follow.
    is_discrete : bool
        ``x+ = A x + B u`` over every step of its own, in place of x'.
    own_steps : int
        Communication steps in a step of its own, at whose end its outputs change; 0: it has no
        steps of its own.
    shown_every : int
        Communication steps between two changes of its outputs, where it advances at every one; 0:
        they change at every one.
    delay : int
        Communication steps that its inputs are late; then there is no state.
    offset : int
        Communication steps until the first step of its own begins.
    latest : Mask, shape (n_u,), optional
        The inputs of which a step takes the value at its end, in place of the mean; left out: none.
    rate : Vector, shape (n_x,), optional
        x' at the operating point itself; left out: it is not known.
    is_local : bool
        It is known not to hold far from the operating point.

    Raises
    ------
    GraphError
        If the shapes do not fit together.
    """

    A: Matrix
    B: Matrix
    C: Matrix
    D: Matrix
    input_use: InputUse = "linear"
    corrected: Mask | None = None
    is_discrete: bool = False
    own_steps: int = 0
    shown_every: int = 0
    delay: int = 0
    offset: int = 0
    latest: Mask | None = None
    rate: Vector | None = None
    is_local: bool = False

    def __post_init__(self) -> None:
        n_x = len(self.A)
        n_y, n_u = self.D.shape
        needed = {"A": (n_x, n_x), "B": (n_x, n_u), "C": (n_y, n_x)}
        for name, shape in needed.items():
            found = getattr(self, name).shape
            if found != shape:
                raise GraphError(f"linearized: {name}: expected shape {shape}, got {found}")

    @property
    def period(self) -> int:
        """Communication steps after which its steps repeat."""
        return max(1, self.own_steps, self.shown_every)

    @property
    def is_continuous(self) -> bool:
        """Whether it is a system in continuous time that advances at every communication step."""
        return self.period == 1 and not (self.is_discrete or self.own_steps or self.delay)

    @property
    def follows(self) -> Mask:
        """``corrected`` in full."""
        if self.corrected is None:
            return np.ones(len(self.D), np.bool_)
        return self.corrected

    def at(self, x: Vector, u: Vector, rate: Vector) -> Linearized:
        """Return it with the x' of a state and inputs; what is rounding of its terms is zero."""
        terms = np.abs(self.A) @ np.abs(x) + np.abs(self.B) @ np.abs(u)
        return replace(self, rate=np.where(np.abs(rate) <= AT_REST * terms, 0.0, rate))

    def sampled(self, n: int, *, hold: bool, offset: int = 0) -> Linearized | None:
        """Return it with steps of its own, n communication steps long; None: it has others.

        ``hold``: its inputs are those at the start of these, of which the first is at ``offset``.
        """
        if self.delay or self.shown_every or self.own_steps > 1:
            return None
        use = "start" if hold else self.input_use
        return replace(self, own_steps=n, input_use=use, offset=offset)

    def decimated(self, n: int) -> Linearized | None:
        """Return it with outputs that change at every n-th step; None: they do otherwise."""
        if n == 1:
            return self
        if self.period > 1 or self.is_discrete or self.delay:
            return None
        return replace(self, shown_every=n)

    def refined(self, parts: int) -> Linearized:
        """Return it for communication steps that are some times shorter."""
        return replace(
            self,
            own_steps=self.own_steps * parts,
            shown_every=self.shown_every * parts,
            delay=self.delay * parts,
            offset=self.offset * parts,
        )


def static(D: Matrix) -> Linearized:
    """Return ``y = D u``."""
    n_y, n_u = D.shape
    return Linearized(np.zeros((0, 0)), np.zeros((0, n_u)), np.zeros((n_y, 0)), D)
