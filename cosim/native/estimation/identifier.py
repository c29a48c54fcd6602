"""The online identifier: output error, its start searched by the Rayleigh quotient."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from ctypes import byref, c_double, c_int32, c_int64, c_void_p
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from cosim.arrays import Vector
from cosim.errors import UsageError
from cosim.native.estimation.alphas import PastAlphas
from cosim.native.estimation.between import BetweenConstants
from cosim.native.estimation.output_error import (
    KnownInput,
    OutputErrorConstants,
    OutputErrorModel,
    known_input_struct,
)
from cosim.native.estimation.predictor import ModePredictorConstants
from cosim.native.estimation.rayleigh import RayleighConstants, RayleighModel
from cosim.native.estimation.regression import RegressorConstants, regressor_struct
from cosim.native.estimation.samples import SampleMemory, SavedSamples, used_parts
from cosim.native.estimation.start_grid import StartGridConstants, StartGridModel, StartGridStruct
from cosim.native.library import address, declare, int32, library, pointer
from cosim.native.step import NativeStep


class IdentifierStruct(ctypes.Structure):
    """cosim_identifier."""

    _fields_ = (
        *(
            (name, c_int32)
            for name in ("period", "width", "average", "weighs", "disturbances", "grids")
        ),
        *((name, c_int64) for name in ("window", "capacity")),
        *((name, c_double) for name in ("start", "settled")),
        *((name, c_void_p) for name in ("products", "lagging", "rayleigh", "on_delta", "on_y")),
        *((name, c_void_p) for name in ("known", "lower", "upper", "scale", "threshold")),
        *((name, c_void_p) for name in ("deviations", "grid", "reach", "between", "predictor")),
        ("memory", c_void_p),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class IdentifierConstants:
    """The numbers of cosim_identifier.

    Parameters
    ----------
    period : int
        Samples between two estimates.
    average : int
        Samples of mu that make one row of the regression; 0: mu is no regression.
    window : int
        Samples of a moving window; 0: all.
    capacity : int
        Samples that may come.
    start, settled : float
        First instant of which mu, and of which delta counts [s].
    products : RegressorConstants
        Of the regressor that makes mu.
    lagging : PastAlphas
        Those of the components, as late as delta; with as many samples as those of ``products``.
    rayleigh : RayleighConstants
    on_delta : OutputErrorConstants, optional
        The model of delta; without it theta is that of the Rayleigh quotient.
    on_y : OutputErrorConstants, optional
        The model of y; without it theta is fitted to delta.
    known : KnownInput, optional
        The effect of u on y.
    lower, upper, scale : Vector, shape (P,)
        Bounds of theta, and its longest step.
    threshold : Vector, shape (components,)
        Statistic from which on a component is no noise.
    deviations : Vector, shape (n_y,)
        Of the noise that the W of on_y makes white, which is known; none: it is estimated, of one
        output with W = 1.
    grids : tuple of StartGridConstants
        Of starts on y, of equal sizes, for longer and longer data.
    reach : tuple of int
        Samples up to which each grid counts; the last one counts for all.
    between : BetweenConstants or None
        Where y is sampled at instants of its own.
    predictor : ModePredictorConstants or None
        Where y is predicted, and samples may be missing, all of communication points; then the
        gain of on_y is 0.
    disturbances : int
        Elements of delta.
    """

    period: int
    average: int
    window: int
    capacity: int
    start: float
    settled: float
    products: RegressorConstants
    lagging: PastAlphas
    rayleigh: RayleighConstants
    on_delta: OutputErrorConstants | None
    on_y: OutputErrorConstants | None
    known: KnownInput | None
    lower: Vector
    upper: Vector
    scale: Vector
    threshold: Vector
    deviations: Vector | None = None
    grids: tuple[StartGridConstants, ...] = ()
    reach: tuple[int, ...] = ()
    between: BetweenConstants | None = None
    predictor: ModePredictorConstants | None = None
    disturbances: int = 1

    @property
    def n_y(self) -> int:
        """The number of outputs: theta, its standard errors, the deviations, the amplitudes."""
        generators = self.rayleigh.generators
        if self.on_delta is None:
            return generators.parameters
        if self.on_y is None:
            return generators.parameters + generators.order
        return 2 * generators.parameters + len(self.on_y.C) + generators.order

    @property
    def weighs(self) -> bool:
        """Whether the outputs are weighed by a covariance that is estimated."""
        return self.on_y is not None and len(self.on_y.C) > 1 and self.deviations is None

    @property
    def known_deviations(self) -> Vector:
        """Those of the noise that the W of on_y makes white; 1 where they are estimated."""
        if self.deviations is not None:
            return self.deviations
        return np.ones(0 if self.on_y is None else len(self.on_y.C))


def _all_samples(count: int, steps: int) -> Vector:
    """Return room for the numbers that are kept of all steps of a run.

    Raises
    ------
    UsageError
        If this machine does not have it.
    """
    present = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if 8 * count > present:
        raise UsageError(
            f"the samples of {steps} steps need {8 * count / 2**30:.3g} GiB, and this machine has "
            f"{present / 2**30:.3g} GiB of memory; use a shorter run, a larger step, or a method "
            'that keeps none, such as "extended-kalman"'
        )
    return np.zeros(count)


class IdentifierStep:
    """The identifier bound to its memory."""

    def __init__(self, constants: IdentifierConstants) -> None:
        on_delta = _model_of(constants.on_delta, "delta")
        on_y = _model_of(constants.on_y, "y")
        rayleigh = RayleighModel(constants.rayleigh)
        known: ctypes.Structure | None = None
        keep_known: Sequence[object] = ()
        if constants.known is not None:
            known, keep_known = known_input_struct(constants.known)
        ring = np.zeros(constants.products.memory)
        products, keep_products = regressor_struct(constants.products, ring)
        lagging, keep_lagging = constants.lagging.struct()
        vectors = [
            np.array(values, np.float64)
            for values in (
                constants.lower,
                constants.upper,
                constants.scale,
                constants.threshold,
                constants.known_deviations,
            )
        ]
        stages = (
            None if on_delta is None else on_delta.struct,
            None if on_y is None else on_y.struct,
            known,
        )
        structs = (products, lagging, rayleigh.struct, *stages)
        grids = [StartGridModel(grid) for grid in constants.grids]
        grid_structs = (StartGridStruct * len(grids))(*[grid.struct for grid in grids])
        reach = int32(constants.reach)
        state = IdentifierStruct(
            constants.period,
            constants.n_y,
            constants.average,
            constants.weighs,
            constants.disturbances,
            len(grids),
            constants.window,
            constants.capacity,
            constants.start,
            constants.settled,
            *map(_address_of, structs),
            *map(pointer, vectors),
            ctypes.addressof(grid_structs),
            pointer(reach),
        )
        keep_between: tuple[object, ...] = ()
        if constants.between is not None:
            between, arrays = constants.between.struct(constants.capacity)
            state.between = ctypes.addressof(between)
            keep_between = (between, *arrays)
        keep_predictor: tuple[object, ...] = ()
        if constants.predictor is not None:
            predictor, of_predictor = constants.predictor.struct()
            state.predictor = ctypes.addressof(predictor)
            keep_predictor = (predictor, *of_predictor)
        count = int(library.cosim_identifier_memory(byref(state)))
        memory = _all_samples(count, constants.capacity)
        state.memory = pointer(memory)
        small = int(library.cosim_identifier_state(byref(state)))
        keep_models = (on_delta, on_y, rayleigh, keep_known, keep_products, keep_lagging, *structs)
        keep = (*keep_models, *grids, grid_structs, reach, *vectors, *keep_between, *keep_predictor)
        self._samples = SampleMemory(memory, small, used_parts("cosim_identifier_samples", state))
        function = address("cosim_identifier_step")
        self.step = NativeStep(function, state, n_y=constants.n_y, memory=memory, keep=keep)

    def initialize(self) -> Vector:
        """Forget all samples and return the outputs, which have no value yet."""
        self._samples.keep_beyond(0)
        y = np.empty(self.step.n_y)
        library.cosim_identifier_start(byref(self.step.state), pointer(y))
        return y

    def save(self) -> SavedSamples:
        """Return the state; the samples are copied where they are about to be replaced."""
        return self._samples.save()

    def restore(self, state: SavedSamples) -> None:
        """Return to a saved state, of this identifier or another."""
        self._samples.restore(state)


def _model_of(
    constants: OutputErrorConstants | None, signal: Literal["y", "delta"]
) -> OutputErrorModel | None:
    return None if constants is None else OutputErrorModel(constants, fitted_to=signal)


def _address_of(struct: ctypes.Structure | ctypes.Array[Any] | None) -> int:
    return 0 if struct is None else ctypes.addressof(struct)


declare(
    {
        "cosim_identifier_memory": (c_int64, (c_void_p,)),
        "cosim_identifier_state": (c_int64, (c_void_p,)),
        "cosim_identifier_start": (None, (c_void_p, c_void_p)),
    }
)
