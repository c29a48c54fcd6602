"""Transmission zeros from u to the regulated outputs that are modes of the disturbance.

Such a mode cannot be rejected: u has no effect on it. It depends on theta, and so the eigenvalue of
S next to a zero is searched over the interval of theta. S consists of blocks that have parameters
of their own, and these are searched one by one: a grid, of many parameters points spread as evenly
as those of a grid that were too many, then ever smaller boxes about the best one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector
from cosim.errors import AssumptionError
from cosim.theory.compensation.internal_model import InternalModel, ParameterBox
from cosim.theory.compensation.state_feedback import RegulatedPlant
from cosim.theory.observers.placement import modes

NEAR: Final = 1e-6  # relative distance from an eigenvalue of S at which a zero counts as on it
SIDE: Final = (21, 9, 9)  # points on a side of a grid with one parameter, two, three
SPREAD: Final = 729  # points of more parameters
SHRINKING: Final = 0.5  # of the box about the best of spread points, a round
RESOLUTION: Final = 1e-9  # of theta, relative


class NearestZero(NamedTuple):
    """The transmission zero that is closest to a mode of the disturbance [1/s], and for which."""

    zero: complex
    mode: complex
    theta: tuple[float, ...]


def check_zeros(
    plant: RegulatedPlant, model: InternalModel, box: ParameterBox
) -> NearestZero | None:
    """Check that no transmission zero is an eigenvalue of S for a theta of the box.

    Returns
    -------
    NearestZero or None
        None: there are no zeros.

    Raises
    ------
    AssumptionError
        If one is: no controller rejects the disturbance there.
    """
    blocks = blocks_of(model)
    nearest: NearestZero | None = None
    for value in plant.zeros:
        zero = complex(value)
        theta, mode = closest_mode(zero, blocks, box)
        S = model.S(theta)
        size_of_S = float(np.linalg.norm(S, 2))
        scale = max(abs(zero), size_of_S, 1e-300)
        if abs(mode - zero) <= NEAR * scale or plant.has_zero_at(mode):
            corners = [box.lower, box.upper]
            distances = [abs(_nearest_mode(model, corner, mode) - mode) for corner in corners]
            is_of_all = max(distances) <= NEAR * scale
            listed = ", ".join(f"{value:.6g}" for value in theta)
            where = "" if is_of_all else f" at theta = {listed}"
            raise AssumptionError(
                f"internal model: the transmission zero {modes([mode])} from u to the regulated "
                f"outputs is a mode of the disturbance{where}, where no controller rejects it "
                "(TRANSMISSION_ZERO)",
                "TRANSMISSION_ZERO",
                "choose an interval of theta without it, or other regulated outputs",
            )
        if nearest is None or abs(mode - zero) < abs(nearest.mode - nearest.zero):
            nearest = NearestZero(zero, mode, tuple(theta.tolist()))
    return nearest


def _nearest_mode(model: InternalModel, theta: Vector, s: complex) -> complex:
    """Return the eigenvalue of S closest to s."""
    S = model.S(theta)
    eigenvalues = np.linalg.eigvals(S)
    distances = np.abs(eigenvalues - s)
    nearest = distances.argmin()
    return complex(eigenvalues[nearest])


@dataclass(frozen=True, eq=False)
class SystemBlock:
    """A block of S: ``S0 (v, v)``, ``slopes (k, v, v)`` by the parameters with these indices."""

    S0: Matrix
    slopes: NDArray[np.float64]
    parameters: tuple[int, ...]

    @property
    def content(self) -> bytes:
        """What tells it from other blocks."""
        matrices = self.S0.tobytes() + self.slopes.tobytes()
        return matrices + bytes(self.parameters)

    def eigenvalues(self, theta: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Compute those at points ``(N, k)`` of its parameters, shape ``(N, v)``."""
        change = np.tensordot(theta, self.slopes, axes=1)
        S = self.S0 + change
        eigenvalues = np.linalg.eigvals(S)
        return eigenvalues.astype(np.complex128)


def blocks_of(model: InternalModel) -> list[SystemBlock]:
    """Return the distinct blocks of S: states of different ones never act on each other."""
    n = len(model.S0)
    coupled = model.S0 != 0.0
    for slope in model.S1:
        coupled |= slope != 0.0
    itself = np.eye(n, dtype=np.bool_)
    reached = coupled | coupled.T | itself
    for _ in range(n):
        ways = reached.astype(np.int64)
        reached = ways @ ways > 0
    distinct: dict[bytes, SystemBlock] = {}
    for row in np.unique(reached, axis=0):
        states = np.flatnonzero(row)
        block = _block_of(model, states)
        distinct.setdefault(block.content, block)
    return list(distinct.values())


def _block_of(model: InternalModel, states: NDArray[np.integer]) -> SystemBlock:
    own = np.ix_(states, states)
    S0 = model.S0[own]
    parameters = []
    slopes = []
    for j, of_all in enumerate(model.S1):
        slope = of_all[own]
        if slope.any():
            parameters.append(j)
            slopes.append(slope)
    of_parameters = np.array(slopes)
    shape = (len(slopes), *S0.shape)
    return SystemBlock(S0, of_parameters.reshape(shape), tuple(parameters))


def closest_mode(
    s: complex, blocks: Sequence[SystemBlock], box: ParameterBox
) -> tuple[Vector, complex]:
    """Return the theta of a box with the eigenvalue of a block closest to s, and that eigenvalue.

    Parameters that the block has not are in the middle of their intervals.
    """
    best = box.center
    mode = complex(math.inf)
    for block in blocks:
        own = list(block.parameters)
        part = ParameterBox(box.lower[own], box.upper[own])
        theta, closest = _closest_of_block(s, block, part)
        if abs(closest - s) < abs(mode - s):
            mode = closest
            best = box.center.copy()
            best[own] = theta
    return best, mode


def _closest_of_block(s: complex, block: SystemBlock, box: ParameterBox) -> tuple[Vector, complex]:
    cell = box
    theta = box.center
    mode = complex(math.inf)
    while True:
        points, reach = _search_points(cell)
        eigenvalues = block.eigenvalues(points)
        distances = np.abs(eigenvalues - s)
        row, column = np.unravel_index(int(distances.argmin()), distances.shape)
        if distances[row, column] < abs(mode - s):
            mode = complex(eigenvalues[row, column])
            theta = points[row]
        width = cell.upper - cell.lower
        size = np.maximum(np.abs(theta), RESOLUTION)
        is_found = width <= RESOLUTION * size
        if is_found.all():
            return theta, mode
        around = reach * width
        lower = np.maximum(theta - around, box.lower)
        upper = np.minimum(theta + around, box.upper)
        cell = ParameterBox(lower, upper)


def _search_points(cell: ParameterBox) -> tuple[NDArray[np.float64], float]:
    """Return points of a cell, and how far from the best one to go on, in widths of the cell."""
    width = cell.upper - cell.lower
    is_free = width > 0.0
    parameters = int(is_free.sum())
    if parameters <= len(SIDE):
        side = SIDE[max(parameters - 1, 0)]
        points = cell.grid(side)
        spacing = 1.0 / (side - 1)
        return np.array(points), spacing
    spread = _spread(len(width))
    return cell.lower + width * spread, 0.5 * SHRINKING


def _spread(parameters: int) -> NDArray[np.float64]:
    """Return points of the unit cube, the corners of its diagonal among them.

    Multiples of powers of the root of ``x^(d + 1) = x + 1``, modulo 1 (Roberts' lattice).
    """
    exponent = 1.0 / (parameters + 1.0)
    root = 2.0
    for _ in range(64):
        root = (1.0 + root) ** exponent
    powers = np.arange(1.0, parameters + 1.0)
    steps = root**-powers
    multiples = np.arange(SPREAD)[:, np.newaxis]
    lattice = multiples * steps % 1.0
    first = np.zeros((1, parameters))
    last = np.ones((1, parameters))
    return np.vstack([lattice, first, last])
