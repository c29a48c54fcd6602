"""Models of other packages: anything with A, B, C and D, such as python-control's StateSpace.

Nothing of these packages is imported. What is read are the attributes ``A, B, C, D``, of a
descriptor system ``E``, ``dt`` and, for the names of inputs, ``input_labels``.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from cosim.arrays import Matrix, frozen
from cosim.errors import AssumptionError, nearest, quoted
from cosim.theory.plants.descriptor import DescriptorSystem


def state_space_matrices(system: object) -> dict[str, Matrix]:
    """Return A, B, C, D, and E where there is one, of a model in continuous time.

    Raises
    ------
    AssumptionError
        If it lacks one of them, one is no matrix of real numbers, or it is in discrete time.
    """
    kind = type(system).__name__
    sample_time = getattr(system, "dt", None)
    if sample_time is not None and (sample_time is True or sample_time != 0):
        raise AssumptionError(
            f"{kind}: expected a model in continuous time, dt = 0, got dt = {quoted(sample_time)}"
        )
    matrices = {}
    for name in ("A", "B", "C", "D", "E"):
        values = getattr(system, name, None)
        if values is not None:
            matrices[name] = _real_matrix(f"{kind}.{name}", values)
        elif name != "E":
            raise AssumptionError(
                f"{kind}: expected a state-space model with A, B, C and D, got one without {name} "
                "(a transfer function becomes one by control.ss, or scipy's to_ss)"
            )
    return matrices


def disturbance_columns(system: object, disturbances: Iterable[int | str]) -> tuple[int, ...]:
    """Return the columns of B that are disturbances, given by number or by name.

    Raises
    ------
    AssumptionError
        If one of them is none of the inputs, or is given twice, or they are no list.
    """
    if isinstance(disturbances, str):
        raise AssumptionError(
            f"disturbances: expected a list, [{disturbances!r}], got {disturbances!r}"
        )
    labels = list(getattr(system, "input_labels", None) or [])
    count = np.shape(getattr(system, "B", np.zeros((0, 0))))[1]
    columns: list[int] = []
    for disturbance in disturbances:
        if isinstance(disturbance, str):
            if disturbance not in labels:
                raise AssumptionError(
                    f"disturbance {disturbance!r} is no input; {nearest(disturbance, labels)}"
                )
            column = labels.index(disturbance)
        else:
            column = int(disturbance)
        if not 0 <= column < count:
            raise AssumptionError(
                f"disturbances: expected 0 to {count - 1}, a column of B, got {column}"
            )
        if column in columns:
            raise AssumptionError(f"disturbances: {disturbance!r} is given twice")
        columns.append(column)
    return tuple(columns)


def descriptor_system(system: object, disturbances: Iterable[int | str] = ()) -> DescriptorSystem:
    """Return the descriptor system of a model of another package.

    Parameters
    ----------
    system : object
        With A, B, C and D, such as a StateSpace of python-control or scipy.signal.
    disturbances : iterable of int or str
        The inputs that are unknown, by column of B or by name.

    Raises
    ------
    AssumptionError
        If it is no such model, is in discrete time, or an input is not there.
    """
    matrices = state_space_matrices(system)
    unknown = list(disturbance_columns(system, disturbances))
    B = matrices["B"]
    D = matrices["D"]
    known = [column for column in range(B.shape[1]) if column not in unknown]
    return DescriptorSystem.general(
        A=matrices["A"],
        C=matrices["C"],
        E=matrices.get("E"),
        Bu=B[:, known],
        Bd=B[:, unknown],
        Du=D[:, known],
        Dd=D[:, unknown],
    )


def _real_matrix(name: str, values: object) -> Matrix:
    array = np.asarray(values)
    if array.dtype.kind not in "fiub" or array.ndim != 2:
        raise AssumptionError(
            f"{name}: expected a matrix of real numbers, got {array.dtype} of shape {array.shape}"
        )
    return frozen(array, 2)
