"""The matrices in a MAT-file of version 4, or 5 to 7, as MATLAB writes it with ``save -v7``.

::

    file     = header (128 bytes), elements
    element  = type, length (8 bytes, or both in the first 4 and up to 4 of data), data
    matrix   = elements: flags, dimensions, name, real part, imaginary part;
               of a sparse one: flags, dimensions, name, rows, column starts, real part, ...
               of structs: flags, dimensions, name, length of names, names, matrices

Everything is checked against the bytes that are there: a damaged file is an error, no crash, which
it is in one of 100 cases with ``scipy.io.loadmat``; that of version 4 is in Python, and is used.

MATLAB, MAT-File Format (R2019b), chapter 1.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, frozen
from cosim.errors import UsageError
from cosim.filters import collected_warnings

Numbers: TypeAlias = NDArray[Any]  # of the type that the file has

HEADER: Final = 128  # bytes
LARGEST: Final = 2**28  # bytes of a matrix
MATRIX: Final = 14  # types of elements
COMPRESSED: Final = 15
NUMBERS: Final = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
SPARSE: Final = 5  # classes of matrices
NUMERIC: Final = range(6, 16)
STRUCT: Final = 2
TEXT: Final = 4
CLASSES: Final = {1: "a cell array", STRUCT: "a struct", 3: "an object", TEXT: "text"}
ENCODINGS: Final = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16"}
DEEPEST: Final = 2  # structs within each other that are read
IS_COMPLEX: Final = 0x08
_HDF5: Final = b"\x89HDF\r\n\x1a\n"
_HDF5_AT: Final = 512  # bytes that MATLAB writes before it
_CURE: Final = "save it with: save -v7"


@dataclass(frozen=True)
class OtherVariable:
    """A variable that is no matrix of real numbers: what it is.

    ``rows`` are those of a text, ``structs`` the structs of an array, as far as they are read.
    """

    what: str
    rows: tuple[str, ...] = ()
    structs: tuple[Mapping[str, Any], ...] = ()


def variables_of(label: str, content: bytes) -> dict[str, Matrix | OtherVariable]:
    """Return the variables of a file that ``label`` names; see :func:`read_variables`."""
    if _HDF5 in (content[: len(_HDF5)], content[_HDF5_AT : _HDF5_AT + len(_HDF5)]):
        raise UsageError(f"{label}: expected a MAT-file of version 4 to 7, got 7.3 (HDF5); {_CURE}")
    try:
        return read_variables(content)
    except UsageError as error:
        raise UsageError(f"{label}: not a valid MAT-file: {error}; {_CURE}") from error


def read_variables(content: bytes) -> dict[str, Matrix | OtherVariable]:
    """Return the variables of a MAT-file by name.

    Raises
    ------
    UsageError
        If it is none of version 4 to 7, or damaged.
    """
    order = {b"IM": "<", b"MI": ">"}.get(content[126:HEADER])
    if order is None:
        return _read_version_4(content)
    variables: dict[str, Matrix | OtherVariable] = {}
    try:
        for kind, data in _elements(content[HEADER:], order):
            if kind == COMPRESSED:
                kind, data = next(_elements(_decompressed(data), order))
            if kind == MATRIX:
                name, value = _variable(data, order)
                variables[name] = value
    except (ValueError, IndexError, StopIteration, struct.error, zlib.error) as error:
        raise UsageError(f"damaged: {error or 'truncated'}") from error
    return variables


def _read_version_4(content: bytes) -> dict[str, Matrix | OtherVariable]:
    """Return the variables as scipy reads them."""
    from scipy.io import loadmat  # rarely needed

    try:
        with collected_warnings("") as warned:
            found = loadmat(BytesIO(content), chars_as_strings=False)
    except Exception as error:  # scipy raises whatever a damaged byte leads to
        raise UsageError(f"expected a MAT-file of version 4 to 7: {error}") from error
    if warned:  # of byte orders that are read wrongly
        raise UsageError(f"expected a MAT-file of version 4 to 7: {warned[0]}")
    variables: dict[str, Matrix | OtherVariable] = {}
    for name, value in found.items():
        if name.startswith("__"):
            continue
        value = value.toarray() if hasattr(value, "toarray") else value
        if value.dtype.kind == "U":
            variables[name] = OtherVariable("text", tuple("".join(row) for row in value.tolist()))
        elif value.dtype.kind == "c":
            variables[name] = OtherVariable("a matrix of complex numbers")
        else:
            variables[name] = frozen(value, 2)
    return variables


def _elements(content: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Yield type and data of the elements one behind the other."""
    position = 0
    while position < len(content):
        if position + 8 > len(content):
            raise ValueError("truncated within an element")
        kind, length = struct.unpack_from(f"{order}II", content, position)
        small = kind >> 16
        if small:
            kind &= 0xFFFF
            begin = position + 4
            length = small
            position += 8
        else:
            begin = position + 8
            position = begin + length
            if kind != COMPRESSED:
                position += -length % 8  # data end at a multiple of 8 bytes
        if begin + length > len(content):
            raise ValueError(f"an element of {length} bytes exceeds the file")
        yield kind, content[begin : begin + length]


def _decompressed(data: bytes) -> bytes:
    stream = zlib.decompressobj()
    content = stream.decompress(data, LARGEST)
    if not stream.eof:
        raise ValueError("a compressed variable is too large, or truncated")
    return content


def _variable(data: bytes, order: str, depth: int = 0) -> tuple[str, Matrix | OtherVariable]:
    """Return name and value of a matrix element."""
    elements = _elements(data, order)
    flags = _numbers(next(elements), order)
    dimensions = _numbers(next(elements), order).tolist()
    _, name = next(elements)
    array_class = int(flags[0]) & 0xFF
    is_complex = bool(int(flags[0]) >> 8 & IS_COMPLEX)
    label = name.decode("ascii")
    if array_class == TEXT:
        return label, OtherVariable(CLASSES[TEXT], _text_rows(elements, order, dimensions))
    if array_class == STRUCT and depth < DEEPEST:
        structs = _structs(elements, order, dimensions, depth)
        return label, OtherVariable(CLASSES[STRUCT], structs=structs)
    return label, _value(elements, order, array_class, dimensions, is_complex)


def _text_rows(
    elements: Iterator[tuple[int, bytes]], order: str, dimensions: list[int]
) -> tuple[str, ...]:
    """Return the rows of a matrix of characters, which stands column by column."""
    kind, data = next(elements, (1, b""))
    encoding = ENCODINGS.get(kind, "utf-8")
    if encoding == "utf-16":
        encoding += "-le" if order == "<" else "-be"
    text = data.decode(encoding)
    rows = dimensions[0] if len(dimensions) == 2 else 0
    if min(dimensions, default=0) <= 0 or rows * dimensions[1] != len(text):
        return ()
    return tuple(text[row::rows] for row in range(rows))


def _structs(
    elements: Iterator[tuple[int, bytes]], order: str, dimensions: list[int], depth: int
) -> tuple[Mapping[str, Any], ...]:
    """Return the structs of an array, one behind the other."""
    (length,) = _numbers(next(elements), order).tolist()
    _, names = next(elements)
    if length < 1:
        raise ValueError("a struct without names of fields")
    keys = []
    for begin in range(0, len(names), length):
        keys.append(names[begin : begin + length].split(b"\0")[0].decode("ascii"))
    structs: list[Mapping[str, Any]] = []
    while keys and len(structs) < math.prod(dimensions):
        values = [_variable(next(elements)[1], order, depth + 1)[1] for _ in keys]
        structs.append(dict(zip(keys, values, strict=True)))
    return tuple(structs)


def _value(
    elements: Iterator[tuple[int, bytes]],
    order: str,
    array_class: int,
    dimensions: list[int],
    is_complex: bool,
) -> Matrix | OtherVariable:
    if array_class not in (SPARSE, *NUMERIC):
        return OtherVariable(CLASSES.get(array_class, "an object"))
    if len(dimensions) != 2:
        return OtherVariable(f"an array of {len(dimensions)} dimensions")
    if is_complex:
        return OtherVariable("a matrix of complex numbers")
    rows, columns = dimensions
    if min(dimensions) < 0 or rows * columns * 8 > LARGEST:
        raise ValueError(f"a matrix of {rows} x {columns} is too large")
    if array_class in NUMERIC:
        values = _numbers(next(elements), order)
        return frozen(values.reshape((rows, columns), order="F"), 2)
    return frozen(_sparse(elements, order, rows, columns), 2)


def _sparse(elements: Iterator[tuple[int, bytes]], order: str, rows: int, columns: int) -> Matrix:
    """Return a sparse matrix as a full one."""
    of_rows = _numbers(next(elements), order).astype(np.int64)
    starts = _numbers(next(elements), order).astype(np.int64)
    values = _numbers(next(elements), order)
    counts = np.diff(starts)
    if len(starts) != columns + 1 or starts[0] != 0 or (counts < 0).any():
        raise ValueError("inconsistent columns of a sparse matrix")
    used = int(starts[-1])
    places = of_rows[:used]
    is_inside = (places >= 0) & (places < rows)
    if len(values) < used or len(places) < used or not is_inside.all():
        raise ValueError("inconsistent entries of a sparse matrix")
    matrix = np.zeros((rows, columns))
    matrix[places, np.repeat(np.arange(columns), counts)] = values[:used]
    return matrix


def _numbers(element: tuple[int, bytes], order: str) -> Numbers:
    kind, data = element
    if kind not in NUMBERS:
        raise ValueError(f"expected numbers, got an element of type {kind}")
    return np.frombuffer(data, order + NUMBERS[kind])
