"""What an observer is designed on, also a linearized FMU, and how it reconstructs delta."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, TypeAlias

import numpy as np

from cosim.arrays import Matrix, Vector, as_columns
from cosim.blocks.observer import averaged_observer, consistent_observer
from cosim.core.contracts import Design
from cosim.core.linear import LinearModel
from cosim.core.recording import Recording
from cosim.core.signals import Signal
from cosim.documents import plain
from cosim.errors import AssumptionError, UsageError, nearest
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
from cosim.units import Unit

if TYPE_CHECKING:
    from cosim.blocks.averages import AveragedModel, Smoothed, Windowed
    from cosim.fmi.exporting.kernels import Kernel
    from cosim.fmi.linearizing.linearization import Linearization
    from cosim.fmi.linearizing.moving import MovingLinearization

MOST_OF_ERROR: Final = 10.0  # how many times larger than its estimate an error may be
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


# --- design models ---


class DesignModel(NamedTuple):
    """The model that an observer is designed on.

    Parameters
    ----------
    reduced : ReducedSystem
    constant : bool
        Whether the last input of ``reduced`` is the constant 1.
    units : mapping of signal name to tuple of Unit
        Those that are declared of the elements of the observer's signals u, y, x_a and delta.
    """

    reduced: ReducedSystem
    constant: bool = False
    units: Mapping[str, tuple[Unit, ...]] = MappingProxyType({})

    def declare(self, model: LinearModel) -> LinearModel:
        """Declare the units of the signals of an observer."""
        interface = model.interface
        inputs = self.declared(interface.inputs)
        outputs = self.declared(interface.outputs)
        return replace(model, interface=replace(interface, inputs=inputs, outputs=outputs))

    def declared(self, signals: Iterable[Signal]) -> tuple[Signal, ...]:
        """Return signals of an observer with their units."""
        return tuple(
            signal.in_units(self.units.get(signal.name) or (Unit(None),) * signal.size)
            for signal in signals
        )


def design_model(linearization: Linearization, disturbances: Sequence[str]) -> DesignModel:
    """Build the design model of a linearization: (9)-(10) without x_b.

    It is ``x' = A x + B_1 u + B_2 delta + c``, ``y = C x + C_4 u + C_5 delta + d``. c and d are
    what an operating point away from an equilibrium at zero leaves: they act through one more
    input, the constant 1.

    Raises
    ------
    UsageError
        If a disturbance is none of the inputs, or is named twice.
    """
    known, unknown = split(linearization, disturbances)
    c, d = linearization.constants
    constant = bool(c.any() or d.any())
    reduced = _reduced(
        (linearization.A, linearization.B, linearization.C, linearization.D),
        known,
        unknown,
        constants=(c, d) if constant else None,
        error=linearization.errors["D"] or 0.0,
    )
    units = {
        "u": _units(linearization, [linearization.inputs[i] for i in known]),
        "delta": _units(linearization, [linearization.inputs[i] for i in unknown]),
        "y": _units(linearization, linearization.outputs),
        "x_a": _units(linearization, linearization.states),
    }
    return DesignModel(reduced, constant, units)


def _reduced(
    matrices: tuple[Matrix, Matrix, Matrix, Matrix],
    known: Sequence[int],
    unknown: Sequence[int],
    *,
    constants: tuple[Vector, Vector] | None,
    error: float,
) -> ReducedSystem:
    """Return the design model of A, B, C, D, with constants c, d as one more input.

    ``error`` is that of an entry of D.
    """
    A, B, C, D = matrices
    B_1 = B[:, known]
    C_4 = D[:, known]
    if constants is not None:
        c, d = constants
        B_1 = np.column_stack([B_1, c])
        C_4 = np.column_stack([C_4, d])
    return ReducedSystem(
        A_a=A,
        B_1a=B_1,
        B_2a=B[:, unknown],
        C3=C,
        C4=C_4,
        C5=_direct(D[:, unknown], error),
        Kx=np.zeros((0, len(A))),
        Ku=np.zeros((0, B_1.shape[1])),
        Kd=np.zeros((0, len(unknown))),
    )


def _direct(D: Matrix, error: float) -> Matrix:
    """Return the direct paths from delta to y; what may be the error of a difference is none."""
    return np.where(np.abs(D) > MOST_OF_ERROR * error, D, 0.0)


class MovingModel:
    """An FMU as the design model of an observer, linearized wherever its estimate is.

    Parameters
    ----------
    fmu : MovingLinearization
    known, unknown : sequence of int
        Columns of u and of delta among the inputs.

    Attributes
    ----------
    x, delta : Vector
        Its own, at the operating point.
    """

    def __init__(
        self, fmu: MovingLinearization, known: Sequence[int], unknown: Sequence[int]
    ) -> None:
        self._fmu = fmu
        self._known = list(known)
        self._unknown = list(unknown)
        self.x = fmu.x
        self.delta = fmu.u[self._unknown]

    def local(self, t: float, x: Vector, u: Vector, delta: Vector) -> ReducedSystem:
        """Linearize at a point; the last input is the constant 1.

        Raises
        ------
        FmuError, RunError
            If the FMU cannot be linearized there.
        """
        inputs = np.zeros_like(self._fmu.u)
        inputs[self._known] = u
        inputs[self._unknown] = delta
        at = self._fmu.at(t, x, inputs)
        n = len(x)
        A = at.jacobian[:n, :n]
        B = at.jacobian[:n, n:]
        C = at.jacobian[n:, :n]
        D = at.jacobian[n:, n:]
        c = at.dx - A @ x - B @ inputs
        d = at.y - C @ x - D @ inputs
        error = 0.0 if at.error is None else float(at.error[n:, n:].max(initial=0.0))
        return _reduced((A, B, C, D), self._known, self._unknown, constants=(c, d), error=error)


def _units(linearization: Linearization, names: Sequence[str]) -> tuple[Unit, ...]:
    """Return the units of the elements of a signal; none where one of them has none."""
    units = [Unit(linearization.units.get(name), linearization.bases.get(name)) for name in names]
    return () if any(unit.name is None for unit in units) else tuple(units)


def split(linearization: Linearization, disturbances: Sequence[str]) -> tuple[list[int], list[int]]:
    """Return the columns of the known inputs and those of the disturbances.

    Disturbances may be named by port or by element.

    Raises
    ------
    UsageError
        If a disturbance is none of the inputs, or is named twice.
    """
    unknown: list[int] = []
    for name in disturbances:
        columns = [
            i
            for i, element in enumerate(linearization.inputs)
            if name in (element, linearization.ports.get(element))
        ]
        if not columns:
            advice = nearest(name, linearization.inputs)
            raise UsageError(
                f"disturbance {name!r} is not an input of {linearization.name}; {advice}"
            )
        if set(columns) & set(unknown):
            raise UsageError(f"disturbance {name!r} is named twice")
        unknown += columns
    known = [i for i in range(len(linearization.inputs)) if i not in unknown]
    return known, unknown


def model_toml(linearization: Linearization, disturbances: Sequence[str]) -> str:
    """Write a linearization as a table of [models], in the general form.

    Raises
    ------
    UsageError
        If a disturbance is none of the inputs, or no states or outputs are there.
    """
    known, unknown = split(linearization, disturbances)
    signals = {
        "x": linearization.states,
        "u": [linearization.inputs[i] for i in known],
        "delta": [linearization.inputs[i] for i in unknown],
        "y": linearization.outputs,
    }
    listed = "; ".join(f"{name}: {', '.join(own)}" for name, own in signals.items() if own)
    if not (signals["x"] and signals["y"]):
        raise UsageError(
            f"{linearization.name}: a table of [models] requires a state and an output; there are "
            f"{listed or 'none'}"
        )
    names = [*linearization.states, *linearization.inputs]
    values = [*linearization.x.tolist(), *linearization.u.tolist()]
    point = ", ".join(f"{name} = {value!r}" for name, value in zip(names, values, strict=True))
    lines = [
        f"[models.{re.sub(r'[^A-Za-z0-9_-]', '_', linearization.name)}]",
        f"# {linearization.name} linearized at t = {linearization.t} s, {point}",
    ]
    c, d = linearization.constants
    if c.any() or d.any():
        lines.append(
            f"# for deviations from this point: it lacks c = {c.tolist()} of x' = ... + c "
            f"and d = {d.tolist()} of y = ... + d"
        )
    lines.append(f"# {listed}")
    lines = [" ".join(line.splitlines()) for line in lines]  # a name of an FMU may have several
    matrices = {
        "A": linearization.A,
        "Bu": linearization.B[:, known],
        "Bd": linearization.B[:, unknown],
        "C": linearization.C,
        "Du": linearization.D[:, known],
        "Dd": _direct(linearization.D[:, unknown], linearization.errors["D"] or 0.0),
    }
    for name, matrix in matrices.items():
        if matrix.any() or (matrix.size and not name.startswith("D")):
            rows = (matrix + 0.0).tolist()  # + 0.0: no -0.0 in the file
            lines.append(f"{name} = {rows!r}")
    return "\n".join(lines) + "\n"


# --- reconstruction of delta ---


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
