"""The regressor: from the reconstructed disturbance to the known signals mu (21)-(25)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from typing import Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.core.signals import Interface, Signal
from cosim.errors import UsageError
from cosim.native.blocks.wrapping import parts_step
from cosim.native.estimation.alphas import Alpha, AlphaSignal, PastAlphas, signals_among
from cosim.native.estimation.regression import RegressorConstants, RegressorStep
from cosim.native.step import LARGEST_MEMORY, NativeStep
from cosim.theory.disturbances.regression import Term

_DELTA: Final = "reconstructed disturbance"
_MU: Final = "signals of the regression"


class Regressor:
    """Delays delta and multiplies: inputs delta and the signals among the alphas, output mu (25).

    The output has no value (NaN) until the longest delay has passed. Between communication points
    an alpha that is a signal is a straight line.

    Parameters
    ----------
    terms : sequence of Term
        The expansion of the determinant.
    alphas : sequence of Alpha
        The known factors, one a group.
    steps : sequence of int
        The delays in communication steps.
    delays : sequence of float
        The delays [s].
    lag : float
        How far delta lags behind the disturbance [s]: the alphas are read that much earlier.

    Raises
    ------
    UsageError
        If a delay is too long to be kept, or an alpha lags behind more than delta.
    """

    def __init__(
        self,
        terms: Sequence[Term],
        *,
        alphas: Sequence[Alpha],
        steps: Sequence[int],
        delays: Sequence[float],
        lag: float = 0.0,
    ) -> None:
        for steps_back, delay in zip(steps, delays, strict=True):
            if steps_back > LARGEST_MEMORY:
                raise UsageError(
                    f"delays: {delay:g} s are {steps_back} communication steps, too many to "
                    f"store; expected at most {LARGEST_MEMORY}"
                )
        n_rows = len(delays)
        rows = [term.row for term in terms]
        factors = [_alpha_rows(term, n_rows) for term in terms]
        signs = [term.sign for term in terms]
        row = np.array(rows)
        factor = np.array(factors, np.int64)
        sign = np.array(signs, np.float64)
        ages = [lag + delay for delay in delays]
        h = max(delays) / max(steps)
        past = PastAlphas(alphas=alphas, ages=ages, h=h)
        self.constants = RegressorConstants(past, steps, row, factor, sign)
        self._kernel = RegressorStep(self.constants)
        # what lags has no value at the start
        delta = Signal("delta", role="input", optional=lag > 0.0, description=_DELTA)
        inputs = (delta, *alpha_signals(alphas))
        mu = Signal("mu", len(terms), optional=True, description=_MU)
        # without a delay of 0 all that mu depends on has passed
        fed = [signal.name for signal in inputs] if 0 in steps else []
        self.interface = Interface(
            inputs, (mu,), {"mu": tuple(fed)}, rollback=True, native=True, continuous=True
        )

    def initialize(self, t: float, u: Vector) -> Vector:
        """Forget the past."""
        self._kernel.reset()
        return self._kernel.outputs(t, u)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return mu at the time reached."""
        return self._kernel.outputs(t, u)

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Take K samples."""
        return self._kernel.step.advance(t, h, u)

    def native(self) -> NativeStep:
        """Return the compiled step."""
        return self._kernel.step

    def save(self) -> Vector:
        """Copy the delayed samples."""
        return self._kernel.step.save()

    def restore(self, state: Vector) -> None:
        """Return to saved samples."""
        self._kernel.step.restore(state)


class ElementRegressors:
    """Regressors of the elements of a disturbance, side by side: inputs as of one, output mu.

    Parameters
    ----------
    elements : sequence of Regressor
        One an element of delta; what they make stands one behind the other in mu.
    signals : sequence of sequence of AlphaSignal
        Of each element, those that drive its input alpha, one an element of that input: here they
        are elements of one input that all share.
    """

    def __init__(
        self, elements: Sequence[Regressor], signals: Sequence[Sequence[AlphaSignal]]
    ) -> None:
        self._elements = tuple(elements)
        inputs = [element.interface.inputs[0] for element in elements]
        is_optional = any(signal.optional for signal in inputs)
        delta = Signal("delta", len(inputs), role="input", optional=is_optional, description=_DELTA)
        alpha = alpha_signals(list(chain.from_iterable(signals)))
        size = sum(element.interface.outputs[0].size for element in elements)
        fed: set[str] = set()
        self._columns = []
        for e, (element, own) in enumerate(zip(elements, signals, strict=True)):
            fed |= set(element.interface.feedthrough["mu"] or ())
            self._columns.append([e, *(len(inputs) + signal.element for signal in own)])
        self.interface = Interface(
            (delta, *alpha),
            (Signal("mu", size, optional=True, description=_MU),),
            {"mu": tuple(sorted(fed))},
            rollback=True,
            native=True,
            continuous=True,
        )

    def initialize(self, t: float, u: Vector) -> Vector:
        """Forget the past."""
        parts = [element.initialize(t, u[columns]) for element, columns in self._each()]
        return np.concatenate(parts)

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return mu at the time reached."""
        parts = [element.outputs(t, u[columns]) for element, columns in self._each()]
        return np.concatenate(parts)

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Take K samples."""
        parts = []
        for element, columns in self._each():
            own = np.ascontiguousarray(u[:, columns])
            parts.append(element.advance(t, h, own))
        return np.hstack(parts)

    def native(self) -> NativeStep:
        """Return the compiled step."""
        return parts_step([(element.native(), columns) for element, columns in self._each()])

    def _each(self) -> Iterator[tuple[Regressor, list[int]]]:
        """Yield the regressors, each with its columns of the inputs."""
        return zip(self._elements, self._columns, strict=True)

    def save(self) -> tuple[Vector, ...]:
        """Copy the delayed samples."""
        return tuple(element.save() for element in self._elements)

    def restore(self, state: tuple[Vector, ...]) -> None:
        """Return to saved samples."""
        for element, own in zip(self._elements, state, strict=True):
            element.restore(own)


def alpha_signals(alphas: Sequence[Alpha]) -> tuple[Signal, ...]:
    """Return the input ``alpha`` of the alphas that are signals; none without them."""
    signals = signals_among(alphas)
    if not signals:
        return ()
    lags = any(signal.lag > 0.0 for signal in signals)
    text = "known functions of the terms"
    return (Signal("alpha", len(signals), optional=lags, role="input", description=text),)


def _alpha_rows(term: Term, rows: int) -> list[int]:
    """Return the indices ``group * rows + row`` of the alphas of a term."""
    indices: list[int] = []
    for b, part in enumerate(term.parts):
        begin = b * rows
        indices.extend(begin + row for row in part)
    return indices
