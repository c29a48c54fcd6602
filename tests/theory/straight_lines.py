"""Plants under signals that are straight lines between samples: ``scipy.signal.lsim``, at once."""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm, schur
from scipy.signal import lfilter

from cosim.arrays import Vector


def simulate_lines(system, u, t: Vector, x0=0.0) -> np.ndarray:
    """Return the outputs of (A, B, C, D) as ``lsim`` does, shape (N, n_y), or (N,) of one.

    The states are recursions one after the other in coordinates where the matrix of a step is
    triangular, which every matrix has.
    """
    A, B, C, D = (np.asarray(matrix, float) for matrix in system)
    n, m = B.shape
    u = np.reshape(u, (len(t), m))
    block = np.zeros((n + 2 * m, n + 2 * m))
    block[:n, :n] = A * (t[1] - t[0])
    block[:n, n : n + m] = B * (t[1] - t[0])
    block[n : n + m, n + m :] = np.eye(m)
    power = expm(block)
    end = power[:n, n + m :]
    begin = power[:n, n : n + m] - end
    triangle, basis = schur(power[:n, :n], output="complex")
    x = np.empty((n, len(t)), complex)
    x[:, 0] = x0
    x[:, 1:] = begin @ u[:-1].T + end @ u[1:].T
    x = basis.conj().T @ x
    for i in reversed(range(n)):
        x[i, 1:] += triangle[i, i + 1 :] @ x[i + 1 :, :-1]
        x[i] = lfilter([1.0], [1.0, -triangle[i, i]], x[i])
    return np.squeeze((basis @ x).real.T @ C.T + u @ D.T)
