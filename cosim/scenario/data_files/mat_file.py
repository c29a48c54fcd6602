"""The variables of MAT-files, by scipy."""

from __future__ import annotations

from io import BytesIO
from typing import Any, Final

import numpy as np

from cosim.errors import UsageError

LARGEST: Final = 2**28  # bytes of a matrix
_HDF5: Final = b"\x89HDF\r\n\x1a\n"
_HEADER: Final = 512  # bytes that MATLAB writes before HDF5
_CURE: Final = "save it with: save -v7"


def read_variables(label: str, content: bytes) -> dict[str, Any]:
    """Return the variables of a MAT-file of version 4 to 7 by name, texts as single characters.

    Raises
    ------
    UsageError
        If it is none, or has a matrix that is too large; ``label`` names the file.
    """
    from scipy.io import loadmat, whosmat  # rarely needed

    if _HDF5 in (content[: len(_HDF5)], content[_HEADER : _HEADER + len(_HDF5)]):
        raise UsageError(f"{label}: expected a MAT-file of version 4 to 7, got 7.3 (HDF5); {_CURE}")
    try:
        sizes = [int(np.prod(shape, dtype=object)) for _, shape, _ in whosmat(BytesIO(content))]
        if max(sizes, default=0) * 8 > LARGEST:
            raise ValueError("a variable is too large")
        found = loadmat(BytesIO(content), chars_as_strings=False)
    except Exception as error:  # scipy raises whatever a damaged byte leads to
        raise UsageError(f"{label}: not a valid MAT-file: {error}; {_CURE}") from error
    return {name: value for name, value in found.items() if not name.startswith("__")}
