"""Systems whose verdict is known: from textbooks, and by construction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from tests.theory.scrambled import Matrices

GOOD = ""


@dataclass(frozen=True)
class KnownSystem:
    """A system from delta to y, the verdict on it, and its invariant zeros where they are finite.

    ``verdict`` is GOOD, or the name of what is wrong; ``zeros`` None: not said.
    """

    name: str
    matrices: Matrices
    verdict: str
    zeros: tuple[complex, ...] | None = None


def matrices(A, Bd, C, *, E=None, Dd=None) -> Matrices:
    """Return a system without known inputs."""
    A = np.array(A, np.float64)
    Bd = np.array(Bd, np.float64)
    C = np.array(C, np.float64)
    n_y, n_d = len(C), Bd.shape[1]
    return Matrices(
        E=np.eye(len(A)) if E is None else np.array(E, np.float64),
        A=A,
        Bu=np.zeros((len(A), 0)),
        Bd=Bd,
        C=C,
        Du=np.zeros((n_y, 0)),
        Dd=np.zeros((n_y, n_d)) if Dd is None else np.array(Dd, np.float64),
    )


def transfer(zeros: Sequence[complex], poles: Sequence[complex]) -> Matrices:
    """Return the controllable canonical form of a transfer function with given zeros and poles."""
    denominator = np.poly(poles).real
    numerator = np.poly(zeros).real
    n = len(poles)
    A = np.diag(np.ones(n - 1), 1)
    A[-1] = -denominator[:0:-1]
    C = np.zeros((1, n))
    C[0, : len(numerator)] = numerator[::-1]
    return matrices(A, np.eye(n)[:, -1:], C)


def chain(length: int) -> Matrices:
    """Return integrators in series, delta at the first, y at the last."""
    A = np.diag(np.ones(length - 1), -1)
    return matrices(A, np.eye(length)[:, :1], np.eye(length)[-1:])


def weierstrass(
    nilpotent: Sequence[int],
    rates: Sequence[float] = (-1.0, -2.0),
    *,
    driven: bool = False,
) -> Matrices:
    """Return E = diag(I, N), A = diag(J, I) with blocks N of given sizes; y is the first state.

    The disturbance drives it, and, where the chains are ``driven``, the last of the others.
    """
    E = np.eye(len(rates))
    for size in nilpotent:
        E = scipy.linalg.block_diag(E, np.diag(np.ones(size - 1), 1))
    n = len(E)
    A = np.eye(n)
    A[: len(rates), : len(rates)] = np.diag(rates)
    B = np.eye(n)[:, :1] + (np.eye(n)[:, -1:] if driven else 0.0)
    return matrices(A, B, np.eye(n)[:1], E=E)


def joined(*parts: Matrices) -> Matrices:
    """Return systems side by side, each with its own disturbance and output."""
    blocks = {}
    for name in ("E", "A", "Bu", "Bd", "C", "Du", "Dd"):
        blocks[name] = scipy.linalg.block_diag(*(getattr(part, name) for part in parts))
    return Matrices(**blocks)


def coupled(A22: float, C: Sequence[float] = (1.0, 0.0, 1.0)) -> Matrices:
    """Return the paper's structure with a given A22, which is small or zero."""
    return matrices(
        [[-1, 1, 1], [0, -2, 1], [1, 0, A22]],
        [[1], [0], [0]],
        [C],
        E=np.diag([1.0, 1.0, 0.0]),
    )


# a mass with spring and damper: position and velocity
MASS = [[0.0, 1.0], [-4.0, -0.5]]
FORCE = [[0.0], [1.0]]
# two tanks in series, the first into the second
TANKS = [[-0.5, 0.0], [0.5, -0.2]]


PATH = [[-1, 1, 0], [0, -3, 0], [1, 0, -5]]  # the second level into the first, into the third
INTO_PATH = [[1, 0], [0, 1], [0, 0]]
ALONG_PATH = [[1, 0, 0], [0, 0, 1]]
BELOW = [[-1, 0, 0], [4, -2, 1], [4, 2, -3]]  # the first tank into two others that exchange


def systems() -> list[KnownSystem]:
    """Return all of them; those that differ by which side of a border they are on are neighbors."""
    paper = matrices(
        [[0, 1, 1], [0, -2, 1], [1, 0, 1]], [[1], [0], [0]], [[2, 0, 1]], E=np.diag([1.0, 1.0, 0.0])
    )
    kronecker = matrices(
        [[0, 1, 0], [0, 0, 1], [0, 0, 0]], [[1], [0], [0]], [[1, 0, 0]], E=np.diag([1.0, 0.0, 0.0])
    )
    repeated = np.array([[-1.0, 1.0, 0.0], [1.0, 2.0, 1.0], [2.0, 4.0, 2.0]])
    nearly = repeated + np.diag([0.0, 0.0, 1e-6])
    first_only = np.diag([1.0, 0.0, 0.0])
    e1 = [[1], [0], [0]]
    two = np.eye(2)
    both = joined(transfer([-1], [-2, -3]), transfer([-4], [-5, -6]))
    return [
        KnownSystem("the paper's example", paper, GOOD, (-2,)),
        KnownSystem("integrator", chain(1), GOOD, ()),
        KnownSystem("chain of 2 integrators", chain(2), "RELATIVE_DEGREE", ()),
        KnownSystem("chain of 5 integrators", chain(5), "RELATIVE_DEGREE", ()),
        KnownSystem("mass, position", matrices(MASS, FORCE, [[1, 0]]), "RELATIVE_DEGREE", ()),
        KnownSystem("mass, velocity", matrices(MASS, FORCE, [[0, 1]]), "NOT_DETECTABLE", (0,)),
        KnownSystem("mass, both", matrices(MASS, FORCE, two), GOOD, ()),
        KnownSystem("tanks, first level", matrices(TANKS, [[1], [0]], [[1, 0]]), GOOD, (-0.2,)),
        KnownSystem(
            "tanks, second level", matrices(TANKS, [[1], [0]], [[0, 1]]), "RELATIVE_DEGREE"
        ),
        KnownSystem("zeros at -1, -2", transfer([-1, -2], [-3, -4, -5]), GOOD, (-2, -1)),
        KnownSystem("zero at -1e-4", transfer([-1e-4, -2], [-3, -4, -5]), GOOD, (-2, -1e-4)),
        KnownSystem("zero at 0", transfer([0, -2], [-3, -4, -5]), "NOT_DETECTABLE", (-2, 0)),
        KnownSystem("zero at 1e-4", transfer([1e-4, -2], [-3, -4, -5]), "NOT_DETECTABLE"),
        KnownSystem("zero at +1", transfer([1, -2], [-3, -4, -5]), "NOT_DETECTABLE", (-2, 1)),
        KnownSystem(
            "zeros at -0.1 +- 2j",
            transfer([-0.1 + 2j, -0.1 - 2j], [-1, -2, -3]),
            GOOD,
            (-0.1 - 2j, -0.1 + 2j),
        ),
        KnownSystem("zeros at +- 2j", transfer([2j, -2j], [-1, -2, -3]), "NOT_DETECTABLE"),
        KnownSystem(
            "zeros at 0.1 +- 2j", transfer([0.1 + 2j, 0.1 - 2j], [-1, -2, -3]), "NOT_DETECTABLE"
        ),
        KnownSystem("unstable plant", transfer([-1], [2, -3]), GOOD, (-1,)),
        KnownSystem("two of two", both, GOOD, (-4, -1)),
        KnownSystem(
            "two of two, one with a zero at +4",
            joined(transfer([-1], [-2, -3]), transfer([4], [-5, -6])),
            "NOT_DETECTABLE",
            (-1, 4),
        ),
        KnownSystem(
            "one output for two", matrices(-two, two, [[1, 1]]), "FEWER_OUTPUTS_THAN_DISTURBANCES"
        ),
        KnownSystem(
            "one direction for two",
            matrices(TANKS, [[1, 2], [1, 2]], two),
            "DEPENDENT_DISTURBANCES",
        ),
        KnownSystem("nearly one direction", matrices(TANKS, [[1, 2], [1, 2.001]], two), GOOD, ()),
        KnownSystem(
            "a tank that flows nowhere",
            matrices([[-1, 0], [0, -2]], [[0], [1]], [[1, 0]]),
            "NO_TRANSFER",
        ),
        KnownSystem(
            "a tank that leaks into the other",
            matrices([[-1, 1e-4], [0, -2]], [[0], [1]], [[1, 0]]),
            "RELATIVE_DEGREE",
        ),
        KnownSystem(
            "the second of two flows nowhere",
            matrices(np.diag([-1, -2, -3]), [[1, 0], [0, 0], [0, 1]], [[1, 0, 0], [0, 1, 0]]),
            "NO_TRANSFER",
        ),
        KnownSystem(
            "a tank below the one that is measured",
            matrices(BELOW, [[0], [1], [0]], [[1, 0, 0]]),
            "NO_TRANSFER",
        ),
        KnownSystem(
            "one of two tanks below those that are measured",
            matrices(BELOW, [[1, 0], [0, 0], [0, 1]], [[1, 0, 0], [2, 0, 0]]),
            "NO_TRANSFER",
        ),
        KnownSystem("two in one path", matrices(PATH, INTO_PATH, ALONG_PATH), "NO_TRANSFER"),
        KnownSystem(
            "two in one path, and each level",
            matrices(PATH, INTO_PATH, np.eye(3)),
            GOOD,
        ),
        KnownSystem(
            "algebraic states that nothing measures",
            matrices(
                [[-1, 0, 0], [0, -2, 1], [0, 0, 1]],
                [[0], [0], [1]],
                [[1, 0, 0]],
                E=np.diag([1.0, 1.0, 0.0]),
            ),
            "NO_TRANSFER",
        ),
        KnownSystem(
            "direct path, zero at -3", matrices([[-2]], [[1]], [[1]], Dd=[[1]]), GOOD, (-3,)
        ),
        KnownSystem(
            "direct path, zero at +3",
            matrices([[0]], [[-3]], [[1]], Dd=[[1]]),
            "NOT_DETECTABLE",
            (3,),
        ),
        KnownSystem("index 1, two blocks", weierstrass([1, 1]), GOOD, (-2,)),
        KnownSystem("index 2, no input on constraints", weierstrass([2]), GOOD, (-2,)),
        KnownSystem("index 4, no input on constraints", weierstrass([1, 4, 2]), GOOD, (-2,)),
        KnownSystem("index 2", weierstrass([2], driven=True), "INDEX_2"),
        KnownSystem("index 4", weierstrass([1, 2, 4], driven=True), "INDEX_4"),
        KnownSystem("A22 = 1e-5", coupled(1e-5, (1, 0, 0)), GOOD),
        KnownSystem("A22 = 0 keeps y at 0", coupled(0.0, (1, 0, 0)), "NO_TRANSFER"),
        KnownSystem(
            "rigid joint: x'' = force, x = 0",
            matrices(
                [[0, 1, 0], [0, 0, 1], [1, 0, 0]],
                [[0], [1], [0]],
                [[0, 1, 0]],
                E=np.diag([1.0, 1.0, 0.0]),
            ),
            "INDEX_3",
        ),
        KnownSystem(
            "repeated equation",
            matrices(repeated, e1, [[1, 0, 0]], E=first_only),
            "PENCIL_SINGULAR",
        ),
        KnownSystem(
            "nearly repeated equation", matrices(nearly, e1, [[1, 0, 0]], E=first_only), GOOD
        ),
        KnownSystem("zero row", kronecker, "PENCIL_SINGULAR"),
    ]
