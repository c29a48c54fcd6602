"""The kernels of the Kalman filters."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import byref, c_double, c_int32, c_int64, c_void_p
from dataclasses import dataclass

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import UsageError
from cosim.native.estimation.alphas import Alpha, alphas_struct
from cosim.native.estimation.identifier import IdentifierConstants, IdentifierStep
from cosim.native.estimation.output_error import (
    KnownInput,
    OutputErrorConstants,
    OutputErrorModel,
    known_input_struct,
)
from cosim.native.estimation.samples import SampleMemory, SavedSamples, used_parts
from cosim.native.library import address, declare, library, pointer
from cosim.native.step import LARGEST_MEMORY, NativeStep


class ExtendedKalmanStruct(ctypes.Structure):
    """cosim_extended_kalman."""

    _fields_ = (
        ("terms", c_int32),
        *((name, c_void_p) for name in ("model", "known", "alphas")),
        *((name, c_double) for name in ("deviation", "size")),
        *((name, c_void_p) for name in ("theta", "spread", "threshold", "memory")),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class ExtendedKalmanConstants:
    """The numbers of cosim_extended_kalman.

    Parameters
    ----------
    terms : int
        Of mu, which is an input that is not used.
    model : OutputErrorConstants
        Of one interval, without a predictor.
    known : KnownInput
    alphas : sequence of Alpha
        One a component.
    deviation : float
        Of the noise of the outputs.
    size : float
        Deviation of x and beta at first.
    theta, spread : Vector, shape (P,)
        theta at first, and its deviation.
    threshold : Vector, shape (components,)
        Statistic from which on a component is no noise.
    """

    terms: int
    model: OutputErrorConstants
    known: KnownInput
    alphas: Sequence[Alpha]
    deviation: float
    size: float
    theta: Vector
    spread: Vector
    threshold: Vector


class ExtendedKalmanStep:
    """The extended Kalman filter bound to its memory; outputs theta and its standard errors."""

    def __init__(self, constants: ExtendedKalmanConstants) -> None:
        model = OutputErrorModel(constants.model, fitted_to=None)
        known, keep_known = known_input_struct(constants.known)
        alphas, keep_alphas = alphas_struct(constants.alphas)
        vectors = []
        for values in (constants.theta, constants.spread, constants.threshold):
            vectors.append(np.array(values, np.float64))
        structs = (model.struct, known, alphas)
        state = ExtendedKalmanStruct(
            constants.terms,
            *map(ctypes.addressof, structs),
            constants.deviation,
            constants.size,
            *map(pointer, vectors),
        )
        memory = np.zeros(int(library.cosim_extended_kalman_memory(byref(state))))
        state.memory = pointer(memory)
        keep = (model, *keep_known, *structs, *keep_alphas, *vectors)
        n_y = 2 * constants.model.generators.parameters
        function = address("cosim_extended_kalman_step")
        self.step = NativeStep(function, state, n_y=n_y, memory=memory, keep=keep)

    def initialize(self) -> Vector:
        """Forget all samples and return the outputs, which have no value yet."""
        y = np.empty(self.step.n_y)
        library.cosim_extended_kalman_start(byref(self.step.state), pointer(y))
        return y

    def save(self) -> Vector:
        """Copy the state."""
        return self.step.save()

    def restore(self, state: Vector) -> None:
        """Return to a saved state."""
        self.step.restore(state)


class AugmentedKalmanStruct(ctypes.Structure):
    """cosim_augmented_kalman."""

    _fields_ = (
        *((name, c_int32) for name in ("terms", "signals")),
        *((name, c_int32) for name in ("states", "inputs", "outputs", "parameters")),
        ("capacity", c_int64),
        *((name, c_void_p) for name in ("Phi", "B0", "B1", "C", "D", "W", "noise", "first_spread")),
        ("deviation", c_double),
        *((name, c_void_p) for name in ("projection", "memory")),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class AugmentedKalmanConstants:
    """The numbers of cosim_augmented_kalman.

    Parameters
    ----------
    Phi : Matrix, shape (n, n)
        Transition of x, delta and its derivative.
    B0, B1 : Matrix, shape (n, n_u)
    C : Matrix, shape (n_y, n)
        Of the outputs made white by W, shape (n_y, n_y).
    D : Matrix, shape (n_y, n_u)
    W : Matrix, shape (n_y, n_y)
    noise : Matrix, shape (2, n)
        Rows whose products are the covariance that a step adds.
    first_spread : Vector, shape (n,)
        Deviations at first.
    deviation : float
        Of the noise of the outputs made white.
    capacity : int
        Samples that may come.
    projection : IdentifierConstants, optional
        What makes theta of the smoothed delta; without it there are no outputs.
    """

    Phi: Matrix
    B0: Matrix
    B1: Matrix
    C: Matrix
    D: Matrix
    W: Matrix
    noise: Matrix
    first_spread: Vector
    deviation: float
    capacity: int
    projection: IdentifierConstants | None = None


class AugmentedKalmanStep:
    """The augmented Kalman filter bound to its memory; output theta.

    Raises
    ------
    UsageError
        If the samples do not fit.
    """

    def __init__(self, constants: AugmentedKalmanConstants) -> None:
        capacity = constants.capacity
        n = len(constants.Phi)
        if capacity * n * n > LARGEST_MEMORY:
            raise UsageError(
                f"smoothing stores {n * n} numbers for each of {capacity} samples, too many for "
                "memory; use a shorter run, a larger step, or another method"
            )
        projection: IdentifierStep | None = None
        terms = 0
        signals = 0
        parameters = 0
        if constants.projection is not None:
            projection = IdentifierStep(constants.projection)
            terms = len(constants.projection.rayleigh.parts)
            signals = constants.projection.lagging.signals
            parameters = constants.projection.rayleigh.generators.parameters
        arrays = []
        for values in (
            constants.Phi,
            constants.B0,
            constants.B1,
            constants.C,
            constants.D,
            constants.W,
            constants.noise,
            constants.first_spread,
        ):
            arrays.append(np.ascontiguousarray(values, np.float64))
        outputs, inputs = constants.D.shape
        state = AugmentedKalmanStruct(
            terms,
            signals,
            n,
            inputs,
            outputs,
            parameters,
            capacity,
            *map(pointer, arrays),
            constants.deviation,
            0 if projection is None else ctypes.addressof(projection.step.state),
        )
        memory = np.zeros(int(library.cosim_augmented_kalman_memory(byref(state))))
        state.memory = pointer(memory)
        function = address("cosim_augmented_kalman_step")
        keep = (projection, *arrays)
        small = int(library.cosim_augmented_kalman_state(byref(state)))
        parts = used_parts("cosim_augmented_kalman_samples", state)
        self._samples = SampleMemory(memory, small, parts)
        self.step = NativeStep(function, state, n_y=parameters, memory=memory, keep=keep)

    def initialize(self) -> Vector:
        """Forget all samples and return the output, which has no value yet."""
        self._samples.keep_beyond(0)
        y = np.empty(self.step.n_y)
        library.cosim_augmented_kalman_start(byref(self.step.state), pointer(y))
        return y

    def smooth(self, samples: int) -> Vector:
        """Smooth delta over all samples that were taken, of which there are ``samples``."""
        delta = np.empty(samples)
        library.cosim_augmented_kalman_smooth(byref(self.step.state), pointer(delta))
        return delta

    def save(self) -> SavedSamples:
        """Return the state; the samples are copied where they are about to be replaced."""
        return self._samples.save()

    def restore(self, state: SavedSamples) -> None:
        """Return to a saved state, of this filter or another."""
        self._samples.restore(state)


declare(
    {
        "cosim_extended_kalman_memory": (c_int64, (c_void_p,)),
        "cosim_extended_kalman_start": (None, (c_void_p, c_void_p)),
        "cosim_augmented_kalman_memory": (c_int64, (c_void_p,)),
        "cosim_augmented_kalman_state": (c_int64, (c_void_p,)),
        "cosim_augmented_kalman_start": (None, (c_void_p, c_void_p)),
        "cosim_augmented_kalman_smooth": (None, (c_void_p, c_void_p)),
    }
)
