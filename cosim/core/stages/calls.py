"""How components are called: guarded, and measured where that is asked for.

Components are the users' own, so nothing is trusted here: what they are handed cannot be written
to, what they return is checked, and what they raise is named.
"""

from __future__ import annotations

import math
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from numbers import Integral, Real
from time import perf_counter
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Vector, read_only
from cosim.core.contracts import (
    Component,
    Design,
    InputWiring,
    Native,
    PreparableSubsteps,
    Rollback,
    Stopped,
    Transfer,
    first_event,
    left_limits,
    linearized,
    prepare,
    prepare_substeps,
    take_wiring,
)
from cosim.core.linearization import Linearized
from cosim.core.signals import Channel
from cosim.errors import AssumptionError, CosimError, GraphError, LogError, RunError
from cosim.native.step import NativeStep

SUBSTEPS: Final = "substeps."  # of a design: what is computed for substeps
FLOAT: Final = np.dtype(np.float64)
RAISED: Final = (Exception, SystemExit)  # SystemExit would end the program without a word


class GuardedComponent:
    """A component of which every call is guarded.

    Every array that it is handed is a view that cannot be written to, or a copy.

    Parameters
    ----------
    channel : Channel
        Its name, and what it declared.
    component : Component
    """

    def __init__(self, channel: Channel, component: Component) -> None:
        self.name = channel.name
        self._interface = channel.interface
        self._component = component
        self._n_y = channel.interface.n_y
        self._seconds: dict[str, float] | None = None
        self._native_seconds = np.zeros(1)

    def check_exchange(self, component: Component) -> None:
        """Check that a component can take the place of this one.

        Raises
        ------
        GraphError
            If its interface is another one.
        """
        if component.interface != self._interface:
            raise GraphError(
                f"component {self.name!r}: the replacement has a different interface; expected "
                "the same signals and declarations"
            )

    def exchange(self, component: Component) -> None:
        """Go on with another component, which has the same interface."""
        self._component = component
        if self._seconds is not None:
            elapsed = self._seconds[self.name]
            self._component = Timed(component, self.name, self._seconds)
            self._seconds[self.name] = elapsed

    def hand_over(
        self, component: Component, t: float, u: Vector, transfer: Transfer | None
    ) -> None:
        """Go on with another component, which is prepared, from the state that this one has.

        Parameters
        ----------
        component : Component
        t : float
            The time reached [s].
        u : Vector, shape (n_u,)
            The inputs there.
        transfer : Transfer or None
            None: the other one takes the state that this one saves.

        Raises
        ------
        RunError
            If one of them raises what is no error of cosim.
        """
        state = self.save() if transfer is None else transfer.take()
        self.exchange(component)
        self.initialize(t, u)
        if transfer is None:
            self.restore(state)
        else:
            self.outputs(t, u)
            transfer.give(state)

    def measure(self, seconds: dict[str, float]) -> None:
        """Add the wall time of every call from now on to ``seconds``, under its name."""
        self._component = Timed(self._component, self.name, seconds)
        self._seconds = seconds

    @property
    def is_measured(self) -> bool:
        """Whether the wall time of its calls is measured."""
        return self._seconds is not None

    @property
    def native_seconds_address(self) -> int | None:
        """Where compiled code adds the wall time of its calls [s]; None: it is not measured."""
        return self._native_seconds.ctypes.data if self.is_measured else None

    def add_native_seconds(self) -> None:
        """Add the wall time of compiled calls since the last time that this was done."""
        if self._seconds is not None:
            self._seconds[self.name] += float(self._native_seconds[0])
            self._native_seconds[0] = 0.0

    def take_wiring(self, wiring: InputWiring) -> None:
        """Say to the component what drives its inputs."""
        take_wiring(self._component, wiring)

    def prepare(
        self, h: float, held: Mask, recorded: Design, lengths: tuple[float, ...] = ()
    ) -> Design:
        """Prepare the component, if its interface declares it; return a copy of its design.

        Parameters
        ----------
        h : float
            Communication step [s].
        held : Mask, shape (n_u,)
        recorded : Design
        lengths : tuple of float
            Of substeps [s]; their arrays are named ``substeps.NAME`` in the design.

        Raises
        ------
        LogError
            If the recorded design does not fit it.
        AssumptionError
            If it cannot be designed.
        RunError
            If it raises what is no error of cosim, or its design is not finite float64 arrays.
        """
        if not self._interface.prepares:
            return {}
        whole: dict[str, NDArray[np.float64]] = {}
        parts: dict[str, NDArray[np.float64]] = {}
        for key, array in recorded.items():
            name = key.removeprefix(SUBSTEPS)
            arrays_of_step = whole if name == key else parts
            arrays_of_step[name] = read_only(array)
        try:
            component = cast(PreparableSubsteps, self._component)
            arrays = dict(component.prepare(h, held, whole))
            if lengths:
                for name, array in component.prepare_substeps(lengths, parts).items():
                    arrays[SUBSTEPS + name] = array
        except LogError as error:  # of the recorded design, which has no name there
            raise LogError(f"{self.name!r}: {error}") from error
        except AssumptionError as error:  # of the method, which has no name there either
            evidence = f"{self.name!r}: {error.evidence}"
            raise AssumptionError(evidence, error.verdict, error.cure) from error
        except CosimError:
            raise
        except RAISED as error:
            raise RunError(f"{self.name!r}: {_raised('prepare', error)}") from error
        return {key: self._design_array(key, array) for key, array in arrays.items()}

    def initialize(self, t: float, u: Vector) -> Vector:
        """Initialize the component with inputs ``u``, a copy of its own; return a copy of y.

        Raises
        ------
        RunError
            If it raises what is no error of cosim, or returns what its interface does not promise.
        """
        try:
            y = self._component.initialize(t, read_only(u))
        except CosimError:
            raise
        except RAISED as error:
            text = f"{self.name!r} stopped at t = {t} s: {_raised('initialize', error)}"
            raise RunError(text) from error
        problem = result_problem(y, (self._n_y,))
        if problem:
            raise RunError(f"{self.name!r} stopped at t = {t} s: initialize {problem}")
        return y.copy()

    def initial_outputs(self, t: float, u: Vector) -> Vector:
        """Return a copy of the outputs that the component starts with, initialized with ``u``.

        Raises
        ------
        RunError
            As from :meth:`outputs`, with its name and the time.
        """
        try:
            return self.outputs(t, u).copy()
        except RunError as error:
            raise RunError(f"{self.name!r} stopped at t = {t} s: {error}") from error

    def outputs(self, t: float, u: Vector) -> Vector:
        """Return the outputs at ``t``.

        Raises
        ------
        RunError
            As from :meth:`advance`.
        """
        try:
            y = self._component.outputs(t, u)
        except RunError:
            raise
        except RAISED as error:
            raise RunError(_raised("outputs", error)) from error
        problem = result_problem(y, (self._n_y,))
        if problem:
            raise RunError(f"outputs {problem}")
        return y

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Advance the component.

        Raises
        ------
        RunError
            Whatever it raises, or if it returns what its interface does not promise. The stage adds
            the component and the time.
        """
        steps = len(t) - 1
        try:
            y = self._component.advance(t, h, u)
        except Stopped as stop:
            self._check_stop(stop, steps)
            raise
        except RunError:
            raise
        except RAISED as error:
            raise RunError(_raised("advance", error)) from error
        problem = result_problem(y, (steps, self._n_y))
        if problem:
            raise RunError(f"advance {problem}")
        return y

    def left_limits(self, t: Vector) -> dict[int, Vector]:
        """Return outputs before the jumps that the component makes by itself, by place in ``t``.

        Raises
        ------
        RunError
            As from :meth:`advance`.
        """
        if not self._interface.left_limits:
            return {}
        try:
            limits = dict(left_limits(self._component, read_only(t)))
        except RunError:
            raise
        except RAISED as error:
            raise RunError(_raised("left_limits", error)) from error
        for y in limits.values():
            problem = result_problem(y, (self._n_y,))
            if problem:
                raise RunError(f"left_limits {problem}")
        for place in limits:
            if not (isinstance(place, Integral) and 0 <= place < len(t)):
                raise RunError(
                    f"left_limits: expected indices from 0 to {len(t) - 1} of the given times, "
                    f"got {place!r}"
                )
        return limits

    def first_event(self) -> float:
        """Return the time of the first event inside the last step [s]; infinity: there was none.

        Raises
        ------
        RunError
            As from :meth:`advance`.
        """
        try:
            time = first_event(self._component)
        except RAISED as error:
            raise RunError(_raised("first_event", error)) from error
        if not isinstance(time, Real) or math.isnan(time):
            raise RunError(
                f"first_event: expected a time [s], or infinity for no event, got {time!r}"
            )
        return float(time)

    def save(self) -> Any:
        """Copy the state of the component, whose interface declares ``rollback``.

        Raises
        ------
        RunError
            If it raises what is no error of cosim.
        """
        try:
            return cast(Rollback[Any], self._component).save()
        except CosimError:
            raise
        except RAISED as error:
            raise RunError(f"{self.name!r}: {_raised('save', error)}") from error

    def restore(self, state: Any) -> None:
        """Go back to a saved state of the component.

        Raises
        ------
        RunError
            If it raises what is no error of cosim.
        """
        try:
            cast(Rollback[Any], self._component).restore(state)
        except CosimError:
            raise
        except RAISED as error:
            raise RunError(f"{self.name!r}: {_raised('restore', error)}") from error

    def native(self) -> NativeStep | None:
        """Return the compiled step of the component, if it has one."""
        if not self._interface.native:
            return None
        return cast(Native, self._component).native()

    def linearized(self, t: float, u: Vector) -> Linearized | None:
        """Return the component linearized at its state, with numbers that can be relied on.

        None: it cannot be linearized, or raises what says so. The run does not need it.
        """
        try:
            matrices = linearized(self._component, t, read_only(u))
        except RAISED:
            return None
        if type(matrices) is not Linearized:
            return None
        is_finite = all(
            np.isfinite(M).all() for M in (matrices.A, matrices.B, matrices.C, matrices.D)
        )
        fits = matrices.D.shape == (self._n_y, len(u))
        return matrices if fits and is_finite else None

    def _check_stop(self, stop: Stopped, steps: int) -> None:
        """Check the rows that a component completed before it stopped; none are of any width."""
        rows = stop.outputs
        if type(rows) is np.ndarray and rows.ndim == 2 and not len(rows):
            return
        completed = min(np.shape(rows)[0], steps) if np.ndim(rows) else 0
        problem = result_problem(rows, (completed, self._n_y))
        if problem:
            raise RunError(f"advance stopped, {str(stop)!r}, and {problem}") from stop

    def _design_array(self, key: str, array: Any) -> NDArray[np.float64]:
        if type(array) is not np.ndarray or array.dtype != FLOAT or not np.isfinite(array).all():
            raise RunError(
                f"{self.name!r}: prepare: expected a float64 array of finite numbers as {key!r}, "
                f"got {_description(array)}"
            )
        return read_only(array.copy())


class Timed:
    """Passes every call on and adds its wall time to ``seconds[name]``."""

    def __init__(self, component: Component, name: str, seconds: dict[str, float]) -> None:
        self.interface = component.interface
        self._component = component
        self._name = name
        self._seconds = seconds
        seconds[name] = 0.0

    @contextmanager
    def _measured(self) -> Iterator[None]:
        """Add the wall time of the block, if nothing is raised in it."""
        began = perf_counter()
        yield
        self._seconds[self._name] += perf_counter() - began

    def take_wiring(self, wiring: InputWiring) -> None:
        """Pass on."""
        take_wiring(self._component, wiring)

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Pass on."""
        with self._measured():
            return prepare(self._component, h, held, recorded)

    def prepare_substeps(self, lengths: tuple[float, ...], recorded: Design) -> Design:
        """Pass on."""
        with self._measured():
            return prepare_substeps(self._component, lengths, recorded)

    def initialize(self, t: float, u: Vector) -> Vector:
        """Pass on."""
        with self._measured():
            return self._component.initialize(t, u)

    def native(self) -> NativeStep | None:
        """Pass on."""
        return cast(Native, self._component).native()

    def outputs(self, t: float, u: Vector) -> Vector:
        """Pass on."""
        with self._measured():
            return self._component.outputs(t, u)

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Pass on."""
        with self._measured():
            return self._component.advance(t, h, u)

    def left_limits(self, t: Vector) -> Mapping[int, Vector]:
        """Pass on."""
        with self._measured():
            return left_limits(self._component, t)

    def first_event(self) -> float:
        """Pass on."""
        return first_event(self._component)

    def linearized(self, t: float, u: Vector) -> Linearized | None:
        """Pass on."""
        return linearized(self._component, t, u)

    def save(self) -> Any:
        """Pass on."""
        return cast(Rollback[Any], self._component).save()

    def restore(self, state: Any) -> None:
        """Pass on."""
        cast(Rollback[Any], self._component).restore(state)


def _raised(method: str, error: BaseException) -> str:
    """Return in words what a method of a component raised, and where."""
    text = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    if isinstance(error, CosimError):
        return f"{method}: {error}"
    last = traceback.extract_tb(error.__traceback__)[-1]
    text = f"{method} raised {text} ({last.filename}, line {last.lineno})"
    if isinstance(error, ValueError) and "read-only" in str(error):
        text += "; arrays passed to a component are read-only: copy them first"
    return text


def result_problem(y: Any, needed: tuple[int, ...]) -> str:
    """Return what is wrong with the outputs of a component; empty: nothing."""
    if type(y) is np.ndarray and y.dtype == FLOAT and y.shape == needed:
        return ""
    return f"returned {_description(y)}; expected a float64 array of shape {needed}"


def _description(value: Any) -> str:
    """Return the type of a value in words, and what counts of an array."""
    if type(value) is not np.ndarray:
        return f"{type(value).__module__}.{type(value).__qualname__}".removeprefix("builtins.")
    text = f"an array of {value.dtype}, shape {value.shape}"
    if value.dtype == FLOAT and not np.isfinite(value).all():
        text = f"{text}, with NaN or infinity"
    return text
