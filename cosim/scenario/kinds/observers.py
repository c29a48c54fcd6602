"""The observer of the method: states and disturbance from the output."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import Field

from cosim.arrays import Matrix, Vector, as_columns
from cosim.blocks.measurement import per_element
from cosim.blocks.observer import averaged_observer, observer_model
from cosim.blocks.plant import initial_vector
from cosim.core.clock import whole_steps
from cosim.core.contracts import Component
from cosim.core.linear import Linear, LinearModel
from cosim.errors import AssumptionError, LogError, UsageError
from cosim.instants import StepNs, step_seconds
from cosim.scenario.document.schema import (
    Flag,
    Number,
    NumberRow,
    NumberRows,
    PoleRow,
    TomlTable,
    Whole,
    array_of,
)
from cosim.scenario.kinds.base import BuildContext, ExportableKind, LinearNearStart, Wiring
from cosim.scenario.kinds.capabilities import Advising, DecidedByStep, GivenStates, HasGivenStates
from cosim.scenario.kinds.observer_design import (
    DEFAULT_ORDER,
    FILTERS,
    AnyReconstruction,
    AveragedReconstruction,
    DesignModel,
    FilterName,
    MovingModel,
    averaging_kernel,
    averaging_observer,
    choice,
    design_model,
    noise_gains,
    numbers_hash,
    plain_reconstruction,
    recorded_noise,
    split,
)
from cosim.scenario.kinds.plants import StartFields, initial_in_form
from cosim.scenario.kinds.values import LinearSystem, Spectrum
from cosim.scenario.kinds.variants import foreign_keys, variants_with
from cosim.theory.observers import observer
from cosim.theory.observers.assumptions import plain_modes
from cosim.theory.plants.descriptor import MATRICES, ReducedSystem, reduce
from cosim.theory.reconstruction.filters import (
    HIGHEST_ORDER,
    ConsistentFilter,
    DirectReconstruction,
    FirstOrderFilter,
    SavitzkyGolay,
)

if TYPE_CHECKING:
    from cosim.blocks.averages import Smoothed, Windowed
    from cosim.blocks.relinearized_observer import RelinearizedObserver
    from cosim.fmi.exporting.specifications import Exportable
    from cosim.fmi.linearizing.request import LinearizationRequest

# filter_rate x step above which a zero-order hold distorts the derivative by more than 2.5 %
HOLD_LIMIT = 0.05
Deviation = Annotated[Number, Field(ge=0.0)]


class FmuModel(TomlTable):
    """Design model of an observer, linearized from an FMU."""

    fmu: str = Field(description="path of a model exchange .fmu")
    disturbance: str | tuple[str, ...] = Field(description="names of the unknown inputs")
    inputs: tuple[str, ...] | None = Field(
        None, description="names of the known inputs u; default: all others"
    )
    outputs: tuple[str, ...] = Field(("y",), description="names of the measured outputs y")
    at: Number = Field(
        0.0,
        description="time of the operating point [s], simulated with constant inputs",
    )
    start: StartFields = Field({}, description="start values by variable, including inputs")

    @property
    def disturbances(self) -> tuple[str, ...]:
        """The names of the unknown inputs."""
        return (self.disturbance,) if isinstance(self.disturbance, str) else self.disturbance

    @property
    def request(self) -> LinearizationRequest:
        """What the FMU is linearized for."""
        from cosim.fmi.linearizing.request import LinearizationRequest

        inputs = None
        if self.inputs is not None:
            inputs = (*self.inputs, *self.disturbances)
        return LinearizationRequest(
            at=self.at, start=self.start, inputs=inputs, outputs=self.outputs
        )


class DesignedObserver(NamedTuple):
    """An observer, and the model that it is designed on."""

    model: DesignModel
    design: observer.ObserverDesign


class UnknownInputObserverKind(
    ExportableKind, Advising, DecidedByStep, HasGivenStates, LinearNearStart
):
    """Unknown-input observer with reconstruction of the disturbance delta."""

    ports: ClassVar[str] = "u, y -> x_a, delta, x_b, z, q, or x, delta, z, q of a general model"
    tunable: ClassVar[tuple[str, ...]] = ("L", "filter_rate")
    kind: Literal["unknown-input-observer"]
    model: str | FmuModel = Field(
        description='design model: a name of [models], or { fmu = "x.fmu", disturbance = "d" }'
    )
    L: NumberRow | NumberRows | None = Field(None, description="observer gain; or give poles")
    poles: PoleRow | None = Field(
        None,
        description="eigenvalues of M - L C3 that L can move [1/s]; complex pairs as strings: "
        '["-3+2j", "-3-2j"]',
    )
    x_a0: NumberRow | None = Field(
        None, description="initial estimate of x_a; default: consistent with y(0)"
    )
    x0: NumberRow | None = Field(
        None,
        description="initial estimate of x, for models without n_a; only E x0 is used",
    )
    filter: FilterName = Field(
        "first-order",
        description='reconstruction of delta: "first-order" filters the derivative only; '
        '"consistent" filters all signals, lag 1/filter_rate; "savitzky-golay" fits a window, '
        'lag half_width; "auto" chooses the window by the noise',
    )
    filter_rate: Number | None = Field(
        None,
        description='rate of the derivative filter [rad/s]; required by "first-order" (unless '
        'delta feeds through to y) and "consistent"',
    )
    q0: NumberRow | None = Field(
        None, description="initial state of the first-order filter; default: no initial transient"
    )
    half_width: Number | None = Field(
        None,
        description="half width of the Savitzky-Golay window [s], a multiple of the communication "
        "step",
    )
    order: Whole | None = Field(
        None,
        description=f"order of its polynomial, at most {HIGHEST_ORDER}; default: {DEFAULT_ORDER}",
    )
    noise: Deviation | tuple[Deviation, ...] | None = Field(
        None, description="auto: standard deviation of the noise of y, one number or one per output"
    )
    noise_from: str | None = Field(
        None,
        description="auto: path of a log of this observer to take the noise of y from",
    )
    amplitude: Number | None = Field(
        None, description="auto: root mean square of delta; default: that of alpha"
    )
    bandwidth: Number | None = Field(
        None, description="auto: bandwidth of delta [rad/s]; default: that of alpha"
    )
    relinearize: Flag = Field(
        False,
        description="linearize the FMU and design the observer at every communication point, at "
        "the estimates; requires a first-order filter. Rounding depends on the processor: a "
        "replay substitutes the recorded outputs",
    )

    def decided(
        self, table: Mapping[str, Any], metadata: Mapping[str, Any], step_ns: StepNs
    ) -> Mapping[str, Any]:
        """Return the table with the window that was chosen."""
        if self.filter != "auto":
            return table
        window = metadata["choice"]["result"]
        kept = {key: value for key, value in table.items() if key not in FILTERS["auto"].own}
        half_width = step_seconds(window["half_width_steps"] * step_ns)
        chosen = {"filter": "savitzky-golay", "half_width": half_width, "order": window["order"]}
        return {**kept, **chosen}

    @property
    def computable(self) -> bool:
        """Designs on the way need the FMU, and linear algebra that is not the same everywhere."""
        return not self.relinearize or self._is_allowed

    def build(self, name: str, context: BuildContext) -> Component:
        model, design = self.design(name, context)
        reconstruction = self.reconstruction(name, context)
        metadata: dict[str, Any] = {
            "eigenvalues": plain_modes(design.eigenvalues),
            "fixed_modes": plain_modes(design.fixed_modes),
            "lambda_obs": design.lambda_obs,
            "reconstruction": plain_reconstruction(reconstruction),
        }
        for key, held in (("noise_gain", False), ("noise_gain_held", True)):
            gains = noise_gains(model.reduced, design, reconstruction, h=context.h, held=held)
            metadata[key] = gains.ravel().tolist()
        if reconstruction.lag:
            metadata["lags"] = dict.fromkeys(_lagging_outputs(model), reconstruction.lag)
        context.add_metadata(name, metadata)
        if model.reduced.inaccuracy:
            context.warn(name, model.reduced.inaccuracy)
        if self.relinearize:
            return self._relinearized(name, context)
        useless = [key for key in ("filter_rate", "q0") if getattr(self, key) is not None]
        if useless and isinstance(reconstruction, DirectReconstruction):
            context.warn(
                name,
                f"{' and '.join(useless)}: without effect, as delta follows from y directly, "
                "without a derivative that is to be filtered; leave it out",
            )
        return self._fixed(name, context)

    def _fixed(self, name: str, context: BuildContext) -> Linear | Windowed | Smoothed:
        """Return the observer with the one design."""
        model, design = self.design(name, context)
        reconstruction = self.reconstruction(name, context)
        reduced = model.reduced
        x_a0 = self._initial(reduced)
        if not isinstance(reconstruction, AveragedReconstruction):
            linear = observer_model(reduced, design, x_a0=x_a0, q0=self.q0, constant=model.constant)
            return Linear(model.declare(linear))
        averaged = averaged_observer(reduced, design, x_a0=x_a0, constant=model.constant)
        declared = replace(
            averaged,
            linear=model.declare(averaged.linear),
            lagging=model.declared(averaged.lagging),
        )
        return averaging_observer(declared, reduced, reconstruction)

    def _relinearized(self, name: str, context: BuildContext) -> RelinearizedObserver:
        """Return the observer that is designed anew on the way."""
        from cosim.blocks.relinearized_observer import RelinearizedObserver  # rarely needed

        assert isinstance(self.model, FmuModel)
        model, _ = self.design(name, context)
        request = self.model.request
        linearization = context.linearization(name, self.model.fmu, request)
        moving = context.moving_linearization(name, self.model.fmu, request)
        known, unknown = split(linearization, self.model.disturbances)
        local = MovingModel(moving, known, unknown)
        first = local.local(0.0, moving.x, moving.u[known], local.delta)
        linear = observer_model(first, self._design_on(first), constant=True)
        x_a0 = None if self.x_a0 is None else np.array(self.x_a0, np.float64)
        if x_a0 is not None and x_a0.shape != local.x.shape:
            raise UsageError(
                f"x_a0: expected {len(local.x)} numbers, one per state of the FMU, got {len(x_a0)}"
            )
        context.warn(
            name,
            "eigenvalues, noise gains, bias and T_id are those of the operating point; where it is "
            "linearized anew they are others",
        )
        interface = model.declare(linear).interface
        return RelinearizedObserver(local, self._design_on, interface, x_a0)

    def linear_system(self, name: str, context: BuildContext) -> LinearSystem | None:
        if self.filter != "first-order" or self.relinearize:
            return None
        model = self.linear_model(name, context)
        return LinearSystem(model.A, model.B, model.C, model.D, error=0.0)

    def linear_model(self, name: str, context: BuildContext) -> LinearModel:
        """Return the observer with a first-order filter as a linear model."""
        component = self._fixed(name, context)
        assert isinstance(component, Linear)
        return component.model

    def exportable(self, name: str, context: BuildContext, wiring: Wiring) -> Exportable:
        from cosim.fmi.exporting.kernels import DiscreteModel  # a run does not need it

        if self.relinearize:
            raise UsageError(
                f"{name!r}: an exported observer cannot relinearize the FMU of its model; expected "
                "relinearize = false"
            )
        component = self._fixed(name, context)
        if isinstance(component, Linear):
            return component.model
        kernel = averaging_kernel(component.design(context.h, wiring.held))
        reason = (
            "delta is an average over communication steps, so the observer is a discrete-time "
            "component"
        )
        return DiscreteModel(component.interface, kernel, context.step_ns, reason)

    def given_states(self, name: str, context: BuildContext) -> GivenStates | None:
        coordinates = self.design_model_of(name, context).reduced.coordinates
        if coordinates is None or self.x0 is None:
            return None
        return GivenStates(np.array(self.x0, np.float64), coordinates)

    def _initial(self, reduced: ReducedSystem) -> Vector | None:
        """Return the initial estimate of x_a.

        Raises
        ------
        UsageError
            If it is given in the coordinates of another form of model.
        AssumptionError
            If it has the wrong size.
        """
        model = self.model if isinstance(self.model, str) else self.model.fmu
        coordinates = reduced.coordinates
        is_general = coordinates is not None
        given = initial_in_form(model, is_general=is_general, x0=self.x0, x_a0=self.x_a0)
        if given is None or coordinates is None:
            return None if given is None else np.array(given, np.float64)
        n = len(coordinates.X)
        return np.asarray(coordinates.R @ initial_vector("x0", given, n, "one number per state"))

    # --- reconstruction of delta ---

    def reconstruction(self, name: str, context: BuildContext) -> AnyReconstruction:
        """Return how delta is reconstructed.

        What a filter does not use of ``filter_rate`` and ``q0`` may stand there all the same, so
        that it can be tried in place of another.

        Raises
        ------
        UsageError
            If a key is missing, or is given that the filter does not have.
        AssumptionError
            If a number does not fit, or nothing can be chosen.
        """
        self._check_keys()
        if self._is_unfiltered(self.design(name, context).design):
            return DirectReconstruction()
        for key in FILTERS[self.filter].needed:
            if getattr(self, key) is None:
                raise UsageError(f"{key} is missing; filter = {self.filter!r} requires it")
        if self.filter == "auto":
            return self._chosen(name, context)
        if self.filter == "savitzky-golay":
            assert self.half_width is not None
            half_width = whole_steps(self.half_width, context.step_ns, "half_width")
            order = DEFAULT_ORDER if self.order is None else self.order
            return SavitzkyGolay(half_width, order, context.h)
        assert self.filter_rate is not None
        if self.filter == "consistent":
            return ConsistentFilter(self.filter_rate, context.h)
        return FirstOrderFilter(self.filter_rate, context.h)

    def lag(self, name: str, output: str, context: BuildContext) -> float:
        if output not in ("delta", "x_b", "x"):
            return 0.0
        lag = self.reconstruction(name, context).lag
        lagging = _lagging_outputs(self.design(name, context).model) if lag else ()
        return lag if output in lagging else 0.0

    def _is_unfiltered(self, design: observer.ObserverDesign) -> bool:
        """Return whether there is no derivative that a first-order filter would be of."""
        return self.filter == "first-order" and design.is_direct and not self.relinearize

    def _check_keys(self) -> None:
        for key in sorted(foreign_keys(FILTERS, self.filter)):
            if getattr(self, key) is not None:
                filters = " or ".join(map(repr, variants_with(FILTERS, key)))
                raise UsageError(
                    f"{key}: expected with filter = {filters} only, got filter = {self.filter!r}"
                )
        if not self.relinearize:
            return
        if isinstance(self.model, str):
            raise UsageError(
                'relinearize: expected model = { fmu = "x.fmu", disturbance = "d" }, got the '
                f"linear model {self.model!r}"
            )
        if self.filter != "first-order":
            raise UsageError(f'relinearize: expected filter = "first-order", got {self.filter!r}')
        if self.q0 is not None:
            raise UsageError(
                "q0: not available with relinearize = true, where q depends on the current model"
            )

    def _chosen(self, name: str, context: BuildContext) -> SavitzkyGolay:
        """Choose a window by the noise, or take the recorded choice."""
        if (self.noise is None) == (self.noise_from is None):
            raise UsageError(
                "filter = 'auto' depends on the noise of y: expected either noise, its standard "
                "deviation, or noise_from, a log of this observer"
            )
        model = self.design_model_of(name, context)
        n_y = len(model.reduced.C3)
        given = None if self.noise is None else per_element("noise", self.noise, n_y)
        spectrum = self._spectrum(name, context)
        request = {
            "noise": self.noise,
            "noise_from": self.noise_from,
            "amplitude": self.amplitude,
            "bandwidth": self.bandwidth,
            "step": context.h,
            "delta": dict(spectrum.source) or None,
            "model": numbers_hash(self._numbers(model, context)),
        }

        def choose() -> dict[str, Any]:
            noise = given
            if noise is None:
                noise = recorded_noise(context.recording(str(self.noise_from)), name, n_y)
            return choice(self.design(name, context).design.G, noise, spectrum, context.h)

        plain_request = json.loads(json.dumps(request))
        result = context.chosen(name, plain_request, choose)
        try:
            return SavitzkyGolay(result["half_width_steps"], result["order"], context.h)
        except AssumptionError as error:
            raise LogError(f"the recorded choice of {name!r} cannot be used: {error}") from error

    def _numbers(self, model: DesignModel, context: BuildContext) -> tuple[Matrix, ...]:
        """Return the numbers of the design model, as they are written or recorded."""
        if isinstance(self.model, str):
            system = context.model(self.model)
            letters = ("A", "Bu", "Bd", "C") if system.n_a is not None else MATRICES
            return tuple(getattr(system, letter) for letter in letters)
        reduced = model.reduced
        return reduced.A_a, reduced.B_1a, reduced.B_2a, reduced.C3, reduced.C4

    def _spectrum(self, name: str, context: BuildContext) -> Spectrum:
        """Return amplitude and bandwidth of delta, as given, or by the tables of what it drives."""
        amplitude = self.amplitude
        bandwidth = self.bandwidth
        if amplitude is not None and bandwidth is not None:
            return Spectrum(amplitude, bandwidth, {}, "amplitude and bandwidth of delta as given")
        known = context.spectra(name)
        if not known:
            raise UsageError(
                "filter = 'auto' requires amplitude and bandwidth of delta; give both, or connect "
                "a regressor with exponential terms only and time-varying alphas"
            )
        fastest = max(known, key=lambda spectrum: spectrum.bandwidth)
        return replace(
            fastest,
            amplitude=fastest.amplitude if amplitude is None else amplitude,
            bandwidth=fastest.bandwidth if bandwidth is None else bandwidth,
        )

    def advice(self, name: str, context: BuildContext, held: Mapping[str, bool]) -> list[str]:
        if self.filter != "first-order" or self.filter_rate is None:
            return []
        product = self.filter_rate * context.h
        if product <= HOLD_LIMIT:
            return []
        model = self.linear_model(name, context)
        filtered = model.B[[state.startswith("q") for state in model.states]]
        columns = model.interface.input_columns()
        read = [n for n, is_held in held.items() if is_held and filtered[:, columns[n]].any()]
        if not read:
            return []
        gain = product / -math.expm1(-product) - 1.0
        return [
            f"zero-order hold of {' and '.join(read)} over the step (discrete, extrapolated in a "
            f"loop, or by input_interpolation), filter_rate x step = {product:g}: the derivative "
            f"filter reads a ramp {gain:.0%} too high and a jump filter_rate times; "
            "do not trust delta"
        ]

    def design(self, name: str, context: BuildContext) -> DesignedObserver:
        """Return the design of the observer (14)-(18)."""

        def designed() -> DesignedObserver:
            model = self.design_model_of(name, context)
            if not model.reduced.B_2a.shape[1]:
                raise UsageError(
                    f"expected a design model with a disturbance (Bd, or B and disturbances), got "
                    f"{self.model!r} without"
                )
            design = self._design_on(model.reduced)
            if self._is_unfiltered(design):
                design = replace(design, filter_rate=None)
            return DesignedObserver(model, design)

        return context.designed(name, designed)

    def _design_on(self, reduced: ReducedSystem) -> observer.ObserverDesign:
        """Design the observer on a model of this form.

        Raises
        ------
        UsageError, AssumptionError
            If that cannot be.
        """
        L = None
        if self.L is not None:
            L = as_columns(array_of(self.L, "L"))
            if reduced.coordinates is not None:
                needed = (len(reduced.coordinates.X), len(reduced.C3))
                if L.shape != needed:
                    raise UsageError(
                        f"L: expected shape {needed}, one row per state and one column per "
                        f"output, got {L.shape}"
                    )
                L = np.asarray(reduced.coordinates.R @ L)
        return observer.design(reduced, L=L, poles=self.poles, filter_rate=self.filter_rate)

    def design_model_of(self, name: str, context: BuildContext) -> DesignModel:
        """Return the model that the observer is designed on.

        Raises
        ------
        UsageError, AssumptionError
            If there is none, or it cannot be reduced (Assumptions 1 and 2).
        """
        model = self.model
        if isinstance(model, str):
            return DesignModel(reduce(context.model(model)))
        linearization = context.linearization(name, model.fmu, model.request)
        return design_model(linearization, model.disturbances)


def _lagging_outputs(model: DesignModel) -> tuple[str, ...]:
    """Return the outputs that lag by as much as the reconstruction of delta does."""
    return ("delta", *(state.name for state in observer.lagging_states(model.reduced)))
