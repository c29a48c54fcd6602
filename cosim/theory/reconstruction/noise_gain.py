"""What white noise of the inputs leaves in the outputs of a discretized observer.

Noise `n_k` of deviation 1 in one input, independent from sample to sample, acts on
``x_(k+1) = Ad x_k + B0 n_k + B1 n_(k+1)`` as the sequence of responses

    D + C B1,   then   C Ad^i b,  i = 0, 1, ...   with   b = Ad B1 + B0,

and the variance of an output is the sum of their squares. The sum over all i is `b' W b` with
`W = sum of Ad'^i C'C Ad^i`.
"""

from __future__ import annotations

import numpy as np

from cosim.arrays import Matrix, Vector
from cosim.native.numerics.linear import DiscretizedDynamics

_MOST_DOUBLINGS = 64  # 2^64 steps: no observer is slower than the spacing of numbers


@np.errstate(over="raise", invalid="raise")
def noise_gain(discrete: DiscretizedDynamics, C: Matrix, D: Matrix) -> Matrix:
    """Compute the deviations of ``C x + D u`` for white noise of deviation 1 in each input alone.

    Parameters
    ----------
    discrete : DiscretizedDynamics
        Stable: n states, m inputs.
    C, D : Matrix, shapes (p, n), (p, m)

    Returns
    -------
    Matrix
        Shape ``(p, m)``.

    Raises
    ------
    FloatingPointError
        If it is beyond the range of numbers.
    """
    first = D + C @ discrete.B1
    b = discrete.Ad @ discrete.B1 + discrete.B0
    variances = first**2
    for i, row in enumerate(C):
        variances[i] += _tail(discrete.Ad, row, b)
    return np.sqrt(variances)


@np.errstate(over="raise", invalid="raise")
def windowed_noise_gain(
    discrete: DiscretizedDynamics,
    increments: tuple[Matrix, Matrix, Matrix],
    weights: Vector,
) -> Matrix:
    """Compute the same of weighted sums of increments ``Jx x(t) + J0 u(t) + J1 u(t+h)``.

    ``weights``: the oldest first.
    """
    Jx, J0, J1 = increments
    b = discrete.Ad @ discrete.B1 + discrete.B0
    taps = len(weights)
    # responses of the increments to one sample, until it has passed through the window
    responses = np.zeros((taps + 1, *J1.shape))
    responses[0] = J1
    responses[1] = J0 + Jx @ discrete.B1
    state = b
    for k in range(2, taps + 1):
        responses[k] = Jx @ state
        state = discrete.Ad @ state
    newest_first = weights[::-1]
    of_sums = _convolved(responses, newest_first)
    variances = np.sum(of_sums**2, axis=0)
    # what is left of the state acts on all increments of the window
    effect = np.zeros(Jx.shape)
    for weight in newest_first:
        effect = effect @ discrete.Ad + weight * Jx
    for i, row in enumerate(effect):
        variances[i] += _tail(discrete.Ad, row, b)
    deviations: Matrix = np.sqrt(variances)
    return deviations


def _tail(Ad: Matrix, row: Vector, b: Matrix) -> Vector:
    """Compute the sum over i of ``(row Ad^i b)^2``, by doubling the number of terms."""
    gramian = np.outer(row, row)
    power = Ad
    for _ in range(_MOST_DOUBLINGS):
        added = power.T @ gramian @ power
        gramian = gramian + added
        if np.abs(added).max(initial=0.0) <= 1e-17 * np.abs(gramian).max(initial=0.0):
            break
        power = power @ power
    squares: Vector = np.sum(b * (gramian @ b), axis=0)
    positive: Vector = np.maximum(squares, 0.0)
    return positive


def _convolved(responses: Matrix, weights: Vector) -> Matrix:
    """Convolve along the first axis; as many rows as ``responses`` has."""
    count = len(responses)
    length = 2 * count
    spectrum = np.fft.rfft(weights, length)
    product = np.fft.rfft(responses, length, axis=0) * spectrum[:, np.newaxis, np.newaxis]
    convolved: Matrix = np.fft.irfft(product, length, axis=0)[:count]
    return convolved
