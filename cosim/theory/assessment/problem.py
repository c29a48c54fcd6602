"""What output error is to explain: data sets, a plant, the terms of its disturbance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError, StartError, quoted
from cosim.native.estimation.output_error import Generators
from cosim.theory.covariance import is_covariance
from cosim.theory.disturbances.families import Family, even_parameters, generators
from cosim.theory.disturbed_plant import (
    DataSet,
    DisturbedPlant,
    NoiseModel,
    check_sizes,
    needs_predictor,
    white_noise,
)
from cosim.theory.estimators.other_optima import spread_starts, starts_beside
from cosim.theory.estimators.output_error import (
    OutputErrorFit,
    bound_vectors,
    fit_output_error,
    response_records,
)
from cosim.theory.estimators.start_grid import (
    interchangeable_terms,
    search_start,
)
from cosim.theory.interchangeable import in_order

MOST_SAMPLES: Final = 1000  # of a record, in which other optima are searched


@dataclass(frozen=True, eq=False)
class OutputErrorProblem:
    """Data sets of one plant under one theta, and the model that is fitted to them.

    Parameters
    ----------
    data : sequence of DataSet
        Amplitudes, initial states and offsets of each are its own.
    plant : DisturbedPlant
    families : sequence of Family
        Of the terms of the disturbance.
    stated : Matrix, shape (n_y, n_y), optional
        Covariance of the noise of the outputs, where it is known.
    offset : bool
        An unknown constant is on every output.
    bounds : mapping of index to (lower, upper)
        Of entries of theta; equal bounds fix one.

    Raises
    ------
    AssumptionError
        If there are no data, they do not fit the plant, ``stated`` is no covariance of its outputs,
        or there is no such theta to bound, or a lower bound is above its upper one.
    """

    data: Sequence[DataSet]
    plant: DisturbedPlant
    families: Sequence[Family]
    stated: Matrix | None = None
    offset: bool = False
    bounds: Mapping[int, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that all of it fits together."""
        if not self.data:
            raise AssumptionError("data: expected at least one record, got none")
        for data_set in self.data:
            check_sizes(self.plant, self.generators, data_set)
        bound_vectors(self.bounds, self.generators.parameters)
        if self.stated is None:
            return
        stated = np.asarray(self.stated)
        shape = (self.outputs, self.outputs)
        if stated.shape != shape or not is_covariance(stated):
            raise AssumptionError(
                "stated: expected the covariance of the noise of y, a symmetric positive definite "
                f"matrix of shape {shape}, got {quoted(stated.tolist())}"
            )

    @cached_property
    def generators(self) -> Generators:
        """Those of all terms."""
        return generators(self.families)

    @cached_property
    def interchangeable(self) -> tuple[int, ...]:
        """For every term the last one before it that is interchangeable with it, or -1."""
        return interchangeable_terms(self.data, self.plant, self.generators, self.bounds)

    @property
    def has_several(self) -> bool:
        """Whether there are several terms with parameters, which may exchange their parts."""
        return sum(1 for count in self.generators.count if count) > 1

    @property
    def may_have_rivals(self) -> bool:
        """Whether parts may be exchanged, of several terms or of the functions of one."""
        pairs = zip(self.generators.size, self.generators.count, strict=True)
        return self.has_several or any(V > 1 and count for V, count in pairs)

    def in_order(self, theta: Vector) -> Vector:
        """Return the one of all theta of the same model that is reported, shape (P,)."""
        even = even_parameters(self.families)
        return in_order(theta, self.generators, self.interchangeable, even)

    @property
    def outputs(self) -> int:
        """The number of outputs."""
        return len(self.plant.C)

    def fit(self, theta: Vector, noise: NoiseModel) -> OutputErrorFit:
        """Fit output error from a start.

        Raises
        ------
        AssumptionError, StartError
            As :func:`cosim.theory.estimators.output_error.fit_output_error`.
        """
        return fit_output_error(
            self.data,
            self.plant,
            self.families,
            theta,
            noise=noise,
            offset=self.offset,
            bounds=self.bounds,
        )

    def search_start(self, noise: NoiseModel) -> Vector:
        """Return a start that is searched, as if the noise were white, shape (P,).

        Raises
        ------
        AssumptionError
            As :func:`cosim.theory.estimators.output_error.fit_output_error`.
        """
        return search_start(
            self.data,
            self.plant,
            self.families,
            noise=noise.without_color(),
            offset=self.offset,
            bounds=self.bounds,
        )

    def search_optima(self, known: Vector, noise: NoiseModel) -> list[OutputErrorFit]:
        """Return optima beside a known one, as if the noise were white, the best first.

        Raises
        ------
        AssumptionError
            As :func:`cosim.theory.estimators.output_error.fit_output_error`.
        """
        white = noise.without_color()
        starts = starts_beside(
            self.data,
            self.plant,
            self.families,
            known,
            noise=white,
            offset=self.offset,
            bounds=self.bounds,
        )
        return self._optima(starts, white)

    def spread_optima(self, noise: NoiseModel) -> list[OutputErrorFit]:
        """Return the optima that spread starts lead to, as if the noise were white, the best first.

        Raises
        ------
        AssumptionError
            As :func:`cosim.theory.estimators.output_error.fit_output_error`.
        """
        starts = spread_starts(self.data, self.plant, self.families, bounds=self.bounds)
        return self._optima(starts, noise.without_color())

    def _optima(self, starts: Sequence[Vector], noise: NoiseModel) -> list[OutputErrorFit]:
        """Return the fits from starts that have converged, the best first."""
        fits = []
        for start in starts:
            with suppress(StartError):
                fits.append(self.fit(start, noise))
        converged = [fit for fit in fits if fit.converged]
        return sorted(converged, key=lambda fit: fit.deviation)

    @cached_property
    def thinned(self) -> OutputErrorProblem:
        """The problem of every so many samples, in which other optima are searched.

        The response to u is taken off before, as u may change between these samples.
        """
        data = []
        for one in self._without_inputs():
            every = max(1, len(one.t) // MOST_SAMPLES)
            data.append(one.thinned(every))
        return self.of_data(data)

    def _without_inputs(self) -> list[DataSet]:
        """Return the data less the response to u; as they are where that grows too much."""
        noise = white_noise(self.outputs)
        records = response_records(self.data, self.plant, self.generators, noise=noise)
        data = []
        for one, record in zip(self.data, records, strict=True):
            span = float(one.t[-1] - one.t[0])
            if needs_predictor(self.plant.A, span):
                data.append(one)
            else:
                data.append(replace(one, y=record.residual, u=np.zeros_like(one.u)))
        return data

    def of_data(self, data: Sequence[DataSet]) -> OutputErrorProblem:
        """Return the same for other data."""
        return replace(self, data=data)

    def of_terms(self, kept: Sequence[int]) -> OutputErrorProblem:
        """Return the problem of some of the terms."""
        data = [replace(one, alpha=one.alpha[:, kept]) for one in self.data]
        plant = replace(self.plant, Bd=self.plant.Bd[:, kept], Dd=self.plant.Dd[:, kept])
        bounds = {}
        for place, j in enumerate(self.parameters_of(kept)):
            if j in self.bounds:
                bounds[place] = self.bounds[j]
        families = [self.families[i] for i in kept]
        return replace(self, data=data, plant=plant, families=families, bounds=bounds)

    def without_effect_of(self, terms: Sequence[int]) -> OutputErrorProblem:
        """Return the problem with alpha 0 for some terms, whose theta keeps its place."""
        data = []
        for one in self.data:
            alpha = one.alpha.copy()
            alpha[:, terms] = 0.0
            data.append(replace(one, alpha=alpha))
        return self.of_data(data)

    def parameters_of(self, terms: Sequence[int]) -> list[int]:
        """Return the places in theta of the parameters of some terms."""
        places: list[int] = []
        first = 0
        for i, family in enumerate(self.families):
            count = len(family.parameters)
            if i in terms:
                places += range(first, first + count)
            first += count
        return places
