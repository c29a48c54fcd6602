"""How an observer reconstructs delta: what that costs, and the choice by the noise."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias

import numpy as np

from cosim.arrays import Matrix, Vector, as_columns
from cosim.blocks.observer import averaged_observer, consistent_observer
from cosim.core.contracts import Design
from cosim.core.recording import Recording
from cosim.documents import plain
from cosim.errors import AssumptionError, UsageError
from cosim.native.numerics.linear import DiscretizedDynamics, first_order_hold
from cosim.scenario.kinds.variants import Variant, without_default
from cosim.scenario.record import Reconstruction
from cosim.theory.observers import observer
from cosim.theory.plants.descriptor import ReducedSystem
from cosim.theory.reconstruction.filters import (
    ConsistentFilter,
    DirectReconstruction,
    FirstOrderFilter,
    SavitzkyGolay,
)
from cosim.theory.reconstruction.noise_gain import noise_gain, windowed_noise_gain

if TYPE_CHECKING:
    from cosim.blocks.averages import AveragedModel, Smoothed, Windowed
    from cosim.fmi.exporting.kernels import Kernel

AveragedReconstruction: TypeAlias = ConsistentFilter | SavitzkyGolay
AnyReconstruction: TypeAlias = DirectReconstruction | FirstOrderFilter | AveragedReconstruction
FilterName: TypeAlias = Literal["first-order", "consistent", "savitzky-golay", "auto"]
DEFAULT_ORDER: Final = 4  # of the polynomial of a window

FILTERS: Mapping[FilterName, Variant] = MappingProxyType(
    {
        "first-order": Variant(needed=("filter_rate",)),
        "consistent": Variant(needed=("filter_rate",)),
        "savitzky-golay": Variant(
            needed=("half_width",),
            own={**without_default("half_width"), "order": DEFAULT_ORDER},
        ),
        "auto": Variant(own=without_default("noise", "noise_from", "amplitude", "bandwidth")),
    }
)


def plain_reconstruction(reconstruction: AnyReconstruction) -> dict[str, Any]:
    """Return what a recording keeps of a reconstruction."""
    told = Reconstruction(reconstruction.name, reconstruction.lag, reconstruction.bias)
    if isinstance(reconstruction, SavitzkyGolay):
        told = replace(told, half_width=reconstruction.lag, order=reconstruction.order)
    elif not isinstance(reconstruction, DirectReconstruction):
        told = replace(told, filter_rate=reconstruction.rate)
    return plain(told)


def averaging_observer(
    model: AveragedModel, reduced: ReducedSystem, reconstruction: AveragedReconstruction
) -> Windowed | Smoothed:
    """Build the observer with its averages."""
    from cosim.blocks.averages import Windowed  # rarely needed

    if isinstance(reconstruction, SavitzkyGolay):
        return Windowed(model, reconstruction.weights)
    return consistent_observer(model, reduced, reconstruction.rate)


def averaging_kernel(arrays: Design) -> Kernel:
    """Write the observer for export, with the arrays of its design."""
    from cosim.blocks.averages import window_constants
    from cosim.fmi.exporting import kernels  # a run needs none of it

    X0 = arrays["X0"]
    Xu = arrays["Xu"]
    if "weights" in arrays:
        return kernels.window(window_constants(arrays), X0=X0, Xu=Xu)
    discrete = DiscretizedDynamics(arrays["Ad"], arrays["B0"], arrays["B1"])
    return kernels.discretized(discrete, C=arrays["C"], D=arrays["D"], X0=X0, Xu=Xu)


def delta_transient(
    reduced: ReducedSystem, design: observer.ObserverDesign, reconstruction: AnyReconstruction
) -> observer.StateSpace:
    """Return the modes of the errors of delta, and how they enter it; there are no inputs."""
    n_a = len(reduced.A_a)
    if not isinstance(reconstruction, AveragedReconstruction):
        system = observer.realize(reduced, design)
        return _autonomous(system.A, system.C[observer.delta_rows(reduced)][0])
    realization = observer.realize_averages(reduced, design)
    A = realization.system.A
    of_delta = realization.system.C[-2 * realization.width]
    if isinstance(reconstruction, SavitzkyGolay):
        return _autonomous(A, of_delta)
    rate = reconstruction.rate
    filtered = np.append(rate * of_delta, -rate)
    of_observer = np.hstack([A, np.zeros((n_a, 1))])
    with_filter = np.vstack([of_observer, filtered])
    return _autonomous(with_filter, np.eye(n_a + 1)[n_a])


def _autonomous(A: Matrix, row: Vector) -> observer.StateSpace:
    no_input = np.zeros((len(A), 0))
    no_feedthrough = np.zeros((1, 0))
    return observer.StateSpace(A, no_input, row[np.newaxis], no_feedthrough)


def noise_gains(
    reduced: ReducedSystem,
    design: observer.ObserverDesign,
    reconstruction: AnyReconstruction,
    *,
    h: float,
    held: bool,
) -> Matrix:
    """Compute the deviation of delta for white noise of deviation 1 in each element of y."""
    n_y, n_u = reduced.C4.shape
    n_d = len(design.G)
    of_y = slice(n_u, n_u + n_y)
    mask = np.full(n_u + n_y, held)
    if not isinstance(reconstruction, AveragedReconstruction):
        system = observer.realize(reduced, design)
        discrete = first_order_hold(system.A, system.B, h, mask)
        delta = observer.delta_rows(reduced)
        gains = noise_gain(discrete, system.C[delta], system.D[delta])
        return gains[:, of_y]
    model = averaged_observer(reduced, design)
    component = averaging_observer(model, reduced, reconstruction)
    arrays = component.design(h, mask)
    discrete = DiscretizedDynamics(arrays["Ad"], arrays["B0"], arrays["B1"])
    if isinstance(reconstruction, SavitzkyGolay):
        Jx = arrays["Jx"][:n_d]
        J0 = arrays["J0"][:n_d]
        J1 = arrays["J1"][:n_d]
        gains = windowed_noise_gain(discrete, (Jx, J0, J1), arrays["weights"])
        return gains[:, of_y]
    first = len(arrays["C"]) - model.width
    delta = slice(first, first + n_d)
    gains = noise_gain(discrete, arrays["C"][delta], arrays["D"][delta])
    return gains[:, of_y]


def choice(
    G: Matrix, noise: Vector, known: tuple[float, float, str], step: float
) -> dict[str, Any]:
    """Choose a window for the element of delta that has the most noise; G is the design's."""
    from cosim.theory.reconstruction.filter_choice import Conditions, choose  # rarely needed

    amplitude, bandwidth, assumption = known
    if not G.any():
        raise AssumptionError(
            "filter = 'auto' weighs the noise of a derivative, but delta feeds through to y; "
            "expected another filter"
        )
    of_delta = np.sqrt(np.sum((G * noise) ** 2, axis=1))
    conditions = Conditions(float(of_delta.max()), amplitude, bandwidth, step)
    chosen = choose(conditions)
    return {
        "noise": noise.tolist(),
        "amplitude": amplitude,
        "bandwidth": bandwidth,
        "half_width_steps": chosen.window.half_width,
        "order": chosen.window.order,
        "error_by_noise": chosen.error.noise,
        "error_by_bias": chosen.error.bias,
        "assumption": assumption,
    }


def recorded_noise(recording: Recording, name: str, n_y: int) -> Vector:
    """Estimate the noise of each element of y from what an observer read in a log."""
    from cosim.theory.reconstruction.noise_level import noise_level  # rarely needed

    port = f"{name}.y"
    is_recorded = name in recording.channels and "y" in recording.channels[name].by_name
    if not is_recorded:
        raise UsageError(
            f"noise_from: expected a log of this observer, got {recording.label} without {port!r}"
        )
    y = as_columns(recording[port])
    if y.shape[1] != n_y:
        raise UsageError(
            f"noise_from: {port!r} in {recording.label}: expected size {n_y}, got {y.shape[1]}"
        )
    levels = []
    for column in y.T:
        try:
            levels.append(noise_level(column))
        except AssumptionError as error:
            raise UsageError(f"noise_from: {port!r} in {recording.label}: {error}") from error
    return np.array(levels)


def numbers_hash(arrays: Iterable[Matrix]) -> str:
    """Return a hash of numbers, of their bits."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(repr(array.shape).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
