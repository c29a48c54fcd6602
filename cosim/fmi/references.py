"""Value references of variables, grouped by type as the FMI calls take them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

VariableType: TypeAlias = Literal[
    "Float64", "Float32", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64", "Boolean",
    "String", "Binary", "Clock",
]  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Variables of one type, and where their elements stand in the vector."""

    type: VariableType
    references: NDArray[np.uint32]  # (number of variables,)
    columns: NDArray[np.intp]  # (number of elements,)
    address: int  # of the references, for C
    count: int  # of the references


@dataclass(frozen=True, slots=True, eq=False)
class References:
    """Variables that are set or got together, in the order of the elements of one float64 vector.

    ``plain``: all are Float64, so that the vector is handed over as it is.
    """

    groups: tuple[Group, ...]
    size: int
    plain: bool

    @staticmethod
    def of(variables: Sequence[tuple[VariableType, int, int]]) -> References:
        """Put (type, value reference, size) together by type."""
        starts = np.concatenate([[0], np.cumsum([size for _, _, size in variables])]).astype(
            np.intp
        )
        groups = []
        for kind in dict.fromkeys(kind for kind, _, _ in variables):
            mine = [i for i, variable in enumerate(variables) if variable[0] == kind]
            columns = np.concatenate(
                [np.arange(starts[i], starts[i + 1], dtype=np.intp) for i in mine]
            )
            references = np.array([variables[i][1] for i in mine], np.uint32)
            groups.append(Group(kind, references, columns, references.ctypes.data, len(mine)))
        return References(
            tuple(groups), int(starts[-1]), len(groups) == 1 and groups[0].type == "Float64"
        )
