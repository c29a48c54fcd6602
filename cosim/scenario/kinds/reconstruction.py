"""How an observer reconstructs delta: what that costs, and the choice by the noise."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
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
from cosim.scenario.kinds.values import Spectrum
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
    own: dict[str, Any] = {}
    if isinstance(reconstruction, SavitzkyGolay):
        own = {"half_width": reconstruction.lag, "order": reconstruction.order}
    elif not isinstance(reconstruction, DirectReconstruction):
        own = {"filter_rate": reconstruction.rate}
    return plain(
        Reconstruction(reconstruction.name, reconstruction.lag, reconstruction.bias, **own)
    )


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
) -> tuple[Matrix, Vector]:
    """Return A of the modes of the errors of delta, and the row by which they enter it.

    An average has the modes of the observer too, with other constants before them; that of a
    filter has its own beside them.
    """
    if not isinstance(reconstruction, AveragedReconstruction):
        system = observer.realize(reduced, design)
        return system.A, system.C[observer.delta_rows(reduced)][0]
    realization = observer.realize_averages(reduced, design)
    A = realization.system.A
    of_delta = realization.system.C[-2 * realization.width]
    if isinstance(reconstruction, SavitzkyGolay):
        return A, of_delta
    n_a = len(A)
    rate = reconstruction.rate
    of_observer = np.hstack([A, np.zeros((n_a, 1))])
    filtered = np.append(rate * of_delta, -rate)
    return np.vstack([of_observer, filtered]), np.eye(n_a + 1)[n_a]


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
    mask = np.full(n_u + n_y, held)
    if not isinstance(reconstruction, AveragedReconstruction):
        system = observer.realize(reduced, design)
        discrete = first_order_hold(system.A, system.B, h, mask)
        delta = observer.delta_rows(reduced)
        gains = noise_gain(discrete, system.C[delta], system.D[delta])
        return gains[:, n_u:]
    component = averaging_observer(averaged_observer(reduced, design), reduced, reconstruction)
    arrays = component.design(h, mask)
    discrete = DiscretizedDynamics(arrays["Ad"], arrays["B0"], arrays["B1"])
    if isinstance(reconstruction, SavitzkyGolay):
        n_d = len(design.G)
        increments = (arrays["Jx"][:n_d], arrays["J0"][:n_d], arrays["J1"][:n_d])
        gains = windowed_noise_gain(discrete, increments, arrays["weights"])
    else:
        delta = component.interface.output_columns()["delta"]
        gains = noise_gain(discrete, arrays["C"][delta], arrays["D"][delta])
    return gains[:, n_u:]


def choice(G: Matrix, noise: Vector, of_delta: Spectrum, step: float) -> dict[str, Any]:
    """Choose a window for the element of delta that has the most noise; G is the design's."""
    from cosim.theory.reconstruction.filter_choice import Conditions, choose  # rarely needed

    if not G.any():
        raise AssumptionError(
            "filter = 'auto' weighs the noise of a derivative, but delta feeds through to y; "
            "expected another filter"
        )
    deviations = np.sqrt(np.sum((G * noise) ** 2, axis=1))
    chosen = choose(
        Conditions(float(deviations.max()), of_delta.amplitude, of_delta.bandwidth, step)
    )
    return {
        "noise": noise.tolist(),
        "amplitude": of_delta.amplitude,
        "bandwidth": of_delta.bandwidth,
        "half_width_steps": chosen.window.half_width,
        "order": chosen.window.order,
        "error_by_noise": chosen.error.noise,
        "error_by_bias": chosen.error.bias,
        "assumption": of_delta.assumption,
    }


def recorded_noise(recording: Recording, name: str, n_y: int) -> Vector:
    """Estimate the noise of each element of y from what an observer read in a log."""
    from cosim.theory.reconstruction.noise_level import noise_level  # rarely needed

    port = f"{name}.y"
    if name not in recording.channels or "y" not in recording.channels[name].by_name:
        raise UsageError(
            f"noise_from: expected a log of this observer, got {recording.label} without {port!r}"
        )
    y = as_columns(recording[port])
    of_y = f"noise_from: {port!r} in {recording.label}"
    if y.shape[1] != n_y:
        raise UsageError(f"{of_y}: expected size {n_y}, got {y.shape[1]}")
    try:
        return np.array([noise_level(column) for column in y.T])
    except AssumptionError as error:
        raise UsageError(f"{of_y}: {error}") from error


def numbers_hash(arrays: Iterable[Matrix]) -> str:
    """Return a hash of numbers, of their bits."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(repr(array.shape).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
