"""What an identifier needs: a start within the run, a short step, its method, excitation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError
from cosim.native.numerics.householder import triangle
from cosim.scenario.assumptions.attempts import Evidence, attempted
from cosim.scenario.building.build import Builder
from cosim.scenario.kinds.build_record import DependsOnInvalid
from cosim.scenario.kinds.identification import IdentifierKind
from cosim.scenario.kinds.identification_source import IdentifierSource, start_time
from cosim.scenario.kinds.regressor import RegressorDesign
from cosim.theory.disturbances import regression
from cosim.theory.disturbances.excitation import COMPARABLE, describe_excitation, information
from cosim.theory.disturbances.families import generators
from cosim.theory.experiment_design.effect_of_theta import effect_of_theta
from cosim.theory.experiment_design.minors import Minors
from cosim.theory.observers.assumptions import AssumptionVerdict, undecided

START: Final = "start time (36)"
STEP: Final = "communication step"
METHOD: Final = "method"
EXCITATION: Final = "persistent excitation"
LINEAR: Final = ("least-squares", "gradient", "drem")
OF_Y: Final = ("output-error", "augmented-kalman", "extended-kalman")  # the others: of mu
INSEPARABLE: Final = 1e-9  # of directions of chi or delta by theta, relative: as good as none


@dataclass(frozen=True, eq=False)
class IdentifierCheck:
    """An identifier whose assumptions are checked.

    Parameters
    ----------
    name : str
    kind : IdentifierKind
    builder : Builder
    theta : Vector or None
        Of the disturbance, in the order of the regressor, where the scenario has it.
    delta : Vector, shape (N,), or None
        The disturbance at the communication points, where it is known before the run.
    """

    name: str
    kind: IdentifierKind
    builder: Builder
    theta: Vector | None
    delta: Vector | None

    def verdicts(self) -> list[AssumptionVerdict]:
        """Return what is fulfilled."""
        return [
            attempted(START, self._start),
            attempted(STEP, self._step),
            attempted(METHOD, self._method),
            self._excitation(),
        ]

    @property
    def _source(self) -> IdentifierSource:
        return IdentifierSource(self.name, self.builder.context)

    def _start(self) -> Evidence:
        context = self.builder.context
        T_id = start_time(self.kind.start, self._source, context)
        times = context.metadata.get(self.name, {})
        clock = self.builder.clock
        values: dict[str, Any] = {"start_time": T_id, "stop": clock.stop}
        parts = ""
        if "T_id" in times:
            values |= {key: times[key] for key in ("T_obs", "T_f", "D_max", "T_id")}
            listed = " + ".join(f"{key} {times[key]:.4g}" for key in ("T_obs", "T_f", "D_max"))
            parts = f" = {listed} s"
        if T_id >= clock.stop:
            raise AssumptionError(
                f"T_id = {T_id:.6g} s{parts}, but the run ends at {clock.stop:g} s",
                cure="use a longer run, faster poles, a faster filter or shorter delays",
            )
        return f"T_id = {T_id:.6g} s{parts}, of a run that ends at {clock.stop:g} s", values

    def _step(self) -> Evidence:
        source = self._source
        source.check_step()
        step = self.builder.context.h
        if not source.regression.known.names:
            return "the alphas are signals of the run, interpolated linearly between its points", {
                "step": step
            }
        return f"over a step of {step:g} s linear interpolation of every alpha is within 1 %", {
            "step": step
        }

    def _method(self) -> Evidence:
        design = self._source.regression
        method = self.kind.method
        for key, text in self.builder.problems:
            if key[:2] == ("components", self.name):
                raise AssumptionError(text)
        if self.name not in self.builder.components:
            raise DependsOnInvalid
        parameters = generators(design.families).parameters
        values = {"theta": parameters}
        if method in LINEAR:
            n_eta = len(design.terms) - 1
            evidence = f"{method}: {n_eta} coefficients, theta by formula"
            return evidence, {**values, "eta": n_eta}
        origin = "the model of y" if method in OF_Y else "the regression"
        return f"{method}: {parameters} parameters, from {origin}", values

    def _excitation(self) -> AssumptionVerdict:
        if self.theta is None or self.delta is None:
            return undecided(EXCITATION, "theta and amplitudes are not known before the run")
        if not len(self.theta):
            return undecided(EXCITATION, "the terms have no parameter")
        return attempted(EXCITATION, self._excited)

    def _excited(self) -> Evidence:
        assert self.theta is not None
        design = self._source.regression
        if self.kind.method in OF_Y:
            return self._of_disturbance(design)
        if not design.is_expanded:
            raise DependsOnInvalid(f"method {self.kind.method!r} does not support these terms")
        mu = self._regression(design)
        clock = self.builder.clock
        step = clock.h
        if self.kind.method in LINEAR:
            return self._linear(information(mu[:, 1:], step))
        return _nonlinear(design, triangle(mu), self.theta)

    def _of_disturbance(self, design: RegressorDesign) -> Evidence:
        """Return whether the disturbance determines theta, for what is fitted to y."""
        assert self.delta is not None
        assert self.theta is not None
        if design.known.unknown:
            raise AssumptionError("the alphas are known only during the run")
        t = self.builder.clock.points
        of_groups = design.known(t)
        alpha = np.empty((len(t), len(design.families)))
        for b, group in enumerate(design.groups):
            alpha[:, list(group.components)] = of_groups[:, [b]]
        smallest = effect_of_theta(design.families, self.theta, t, alpha, self.delta)
        change = 1.0 / (t[-1] - t[0])
        numbers = {"smallest": smallest, "least": INSEPARABLE, "change": change}
        effect = (
            f"a change of theta by {change:.3g} along {{}} changes it by {{}} {smallest:.2g} of "
            "itself, whatever its constants"
        )
        if smallest <= INSEPARABLE:
            found = effect.format("one direction", "no more than")
            raise AssumptionError(
                f"the disturbance does not determine theta: {found}; a component is absent, or "
                "two are alike",
                cure="use amplitudes that are not 0, and components that differ",
            )
        found = effect.format("any direction", "at least")
        return f"without noise the disturbance determines theta: {found}", numbers

    def _linear(self, of_eta: Matrix) -> Evidence:
        eigenvalues = np.asarray(np.linalg.eigvalsh(of_eta), np.float64)
        prior = None if self.kind.P0 is None else 1.0 / self.kind.P0
        text = describe_excitation(eigenvalues, prior)
        smallest = float(eigenvalues.min())
        largest = float(eigenvalues.max())
        values = {"smallest": smallest, "largest": largest}
        rounding = len(eigenvalues) * float(np.finfo(np.float64).eps) * largest
        if smallest <= rounding:
            raise AssumptionError(text, cure="choose other delays, or fewer components")
        if prior is not None and prior >= COMPARABLE * smallest:
            evidence, _, cure = text.rpartition("; ")
            raise AssumptionError(evidence, cure=cure)
        return f"without noise {text}", values

    def _regression(self, design: RegressorDesign) -> Matrix:
        """Return mu of the disturbance itself, from the start time on."""
        assert self.delta is not None
        if design.known.unknown:
            raise AssumptionError("the alphas are known only during the run")
        clock = self.builder.clock
        delta = self.delta
        T_id = start_time(self.kind.start, self._source, self.builder.context)
        begin = round((T_id - clock.start_time) / clock.h)
        steps = np.array(design.steps)
        if len(delta) - begin < 2:
            raise AssumptionError(f"the run ends before T_id = {T_id:g} s")
        places = np.arange(begin, len(delta))[:, np.newaxis] - steps
        t = clock.points
        alpha = design.known(t)
        return regression.mu(design.terms, delta[places], alpha[places])


def _nonlinear(design: RegressorDesign, R: Matrix, theta: Vector) -> Evidence:
    """Return whether the regression determines theta near its true value; R'R = sum mu mu'."""
    minors = Minors(generators(design.families), design.groups, design.terms)
    chi, slopes = minors.chi(theta, np.array(design.delays))
    across = slopes - np.outer(slopes @ chi / (chi @ chi), chi)
    lengths = np.linalg.norm(across, axis=1)
    scaled = across / np.where(lengths > 0.0, lengths, 1.0)[:, np.newaxis]
    changes = np.linalg.svd(R @ scaled.T, compute_uv=False) / np.linalg.norm(R)
    smallest = float(changes.min())
    numbers = {"smallest": smallest, "least": INSEPARABLE}
    if smallest <= INSEPARABLE:
        raise AssumptionError(
            f"the regression does not determine theta: along one direction of it the regression "
            f"changes by {smallest:.2g} of itself; a component is absent, or two are alike, or "
            "the alphas or delays differ too little",
            cure="use amplitudes that are not 0, components that differ, other delays, or method = "
            '"output-error"',
        )
    return (
        f"without noise the regression determines theta: along every direction it changes by at "
        f"least {smallest:.2g} of itself",
        numbers,
    )
