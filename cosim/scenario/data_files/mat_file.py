"""MAT-files of version 4, or 5 to 7 as MATLAB writes them with ``save -v7``: matrices, and tables.

::

    file     = header (128 bytes), elements
    element  = type, length (8 bytes, or both in the first 4 and up to 4 of data), data
    matrix   = elements: flags, dimensions, name, real part, imaginary part;
               of a sparse one: flags, dimensions, name, rows, column starts, real part, ...

Everything is checked against the bytes that are there: a damaged file is an error, no crash, which
it is in three of 100 cases with ``scipy.io.loadmat``. That of version 4 is in Python, and is used.

MATLAB, MAT-File Format (R2019b), chapter 1.
"""

from __future__ import annotations

import hashlib
import math
import re
import struct
import zlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Matrix, Vector, frozen
from cosim.errors import UsageError, listing
from cosim.filters import collected_warnings
from cosim.scenario.data_files.table import LARGEST, DataTable, Header, content_of

Numbers: TypeAlias = NDArray[Any]  # of the type that the file has

_HEADER: Final = 128  # bytes
_MATRIX: Final = 14  # types of elements
_COMPRESSED: Final = 15
_INTEGERS: Final = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 12: "i8", 13: "u8"}
_NUMBERS: Final = {**_INTEGERS, 7: "f4", 9: "f8"}
_SPARSE: Final = 5  # classes of matrices
_NUMERIC: Final = range(6, 16)
_STRUCT: Final = 2
_CHARACTERS: Final = 4
_OTHERS: Final = {1: "a cell array", _STRUCT: "a struct", _CHARACTERS: "text"}
_IS_COMPLEX: Final = 0x08
_HDF5: Final = b"\x89HDF\r\n\x1a\n"
_HDF5_AT: Final = 512  # bytes that MATLAB writes before it
_CURE: Final = "save it with: save -v7"
_UNIT: Final = re.compile(r".*\[(?P<unit>[^\[\]|]+)(?:\|[^\[\]]*)?\]\s*", re.DOTALL)


@dataclass(frozen=True)
class OtherVariable:
    """A variable that is no matrix of real numbers: what it is, and the rows of a text.

    The rows are those of version 4, in which simulations are written; ``entries`` are those of a
    struct array of texts.
    """

    what: str
    rows: tuple[str, ...] = ()
    entries: tuple[Mapping[str, str], ...] = ()


MatVariable: TypeAlias = Matrix | OtherVariable


def read_variables(label: str, content: bytes) -> dict[str, MatVariable]:
    """Return the variables of a MAT-file, which ``label`` names, by name.

    Raises
    ------
    UsageError
        If it is none of version 4 to 7, or damaged.
    """
    if _HDF5 in (content[: len(_HDF5)], content[_HDF5_AT : _HDF5_AT + len(_HDF5)]):
        raise UsageError(f"{label}: expected a MAT-file of version 4 to 7, got 7.3 (HDF5); {_CURE}")
    try:
        if content[126:_HEADER] != b"IM":  # which is MI where bytes are in the other order
            return _read_version_4(content)
        variables = {}
        elements = _ElementReader(content[_HEADER:])
        while elements:
            kind, data = elements.next()
            if kind == _COMPRESSED:
                kind, data = _ElementReader(_decompressed(data)).next()
            if kind == _MATRIX:
                name, value = _variable(_ElementReader(data))
                variables[name] = value
        return variables
    except (ValueError, IndexError, struct.error, zlib.error) as error:
        problem = error or "truncated"
        raise UsageError(f"{label}: not a valid MAT-file: {problem}; {_CURE}") from error


def _read_version_4(content: bytes) -> dict[str, MatVariable]:
    """Return the variables as scipy reads them."""
    # rarely needed
    from scipy.io import loadmat
    from scipy.io.matlab import matfile_version

    stream = BytesIO(content)
    try:
        version, _ = matfile_version(stream)
        if version != 0:  # which scipy calls version 4; the others it reads without checks
            raise ValueError("of another version, or with bytes in the other order")
        with collected_warnings("") as warned:
            found = loadmat(stream, chars_as_strings=False)
    except Exception as error:  # scipy raises whatever a damaged byte leads to
        raise ValueError(f"expected a MAT-file of version 4 to 7: {error}") from error
    if warned:  # of byte orders that are read wrongly
        raise ValueError(f"expected a MAT-file of version 4 to 7: {warned[0]}")
    variables: dict[str, MatVariable] = {}
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


def _decompressed(data: bytes) -> bytes:
    stream = zlib.decompressobj()
    content = stream.decompress(data, LARGEST)
    if not stream.eof:
        raise ValueError("a compressed variable is too large, or truncated")
    return content


class _ElementReader:
    """Elements one behind the other; true as long as there is a next one."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._position = 0

    def __bool__(self) -> bool:
        return self._position < len(self._content)

    def next(self) -> tuple[int, bytes]:
        """Return type and data."""
        if self._position + 8 > len(self._content):
            raise ValueError("truncated within an element")
        kind, length = struct.unpack_from("<II", self._content, self._position)
        begin = self._position + 8
        if kind >> 16:
            begin -= 4
            length = kind >> 16
            kind &= 0xFFFF
        end = begin + length
        if end > len(self._content):
            raise ValueError(f"an element of {length} bytes exceeds the file")
        # data end at a multiple of 8 bytes
        self._position = end if kind == _COMPRESSED else end + -(end - self._position) % 8
        return kind, self._content[begin:end]

    def numbers(self) -> Numbers:
        """Return an element of numbers."""
        kind, data = self.next()
        if kind not in _NUMBERS:
            raise ValueError(f"expected numbers, got an element of type {kind}")
        return np.frombuffer(data, f"<{_NUMBERS[kind]}")


def _variable(elements: _ElementReader) -> tuple[str, MatVariable]:
    """Return name and value of a matrix element."""
    flags = int(elements.numbers()[0])
    dimensions = elements.numbers().tolist()
    name = elements.next()[1].decode("ascii")
    array_class = flags & 0xFF
    if array_class == _STRUCT:
        return name, OtherVariable(_OTHERS[_STRUCT], entries=_texts(elements))
    if array_class not in (_SPARSE, *_NUMERIC):
        return name, OtherVariable(_OTHERS.get(array_class, "an object"))
    if len(dimensions) != 2:
        return name, OtherVariable(f"an array of {len(dimensions)} dimensions")
    if flags >> 8 & _IS_COMPLEX:
        return name, OtherVariable("a matrix of complex numbers")
    rows, columns = dimensions
    if min(dimensions) < 0 or rows * columns * 8 > LARGEST:
        raise ValueError(f"a matrix of {rows} x {columns} is too large")
    if array_class == _SPARSE:
        return name, frozen(_sparse(elements, rows, columns), 2)
    return name, frozen(elements.numbers().reshape((rows, columns), order="F"), 2)


def _texts(elements: _ElementReader) -> tuple[dict[str, str], ...]:
    """Return the fields of a struct array, if all are texts of one row."""
    width = int(elements.numbers()[0])
    written = elements.next()[1].decode("ascii")
    if width < 1:
        raise ValueError("a struct without names of fields")
    names = [written[at : at + width].rstrip("\0") for at in range(0, len(written), width)]
    texts = []
    while elements:
        field = _ElementReader(elements.next()[1])
        array_class = int(field.numbers()[0]) & 0xFF
        is_row = field.numbers().tolist()[0] in (0, 1)
        field.next()  # its name
        if array_class != _CHARACTERS or not is_row:
            return ()
        kind, content = field.next() if field else (1, b"")
        texts.append(content.decode({4: "utf-16-le", 17: "utf-16-le"}.get(kind, "utf-8")))
    parts = [texts[at : at + len(names)] for at in range(0, len(texts), len(names) or 1)]
    return tuple(dict(zip(names, part, strict=True)) for part in parts)


def _sparse(elements: _ElementReader, rows: int, columns: int) -> Matrix:
    """Return a sparse matrix as a full one."""
    places, starts = [elements.numbers().astype(np.int64) for _ in range(2)]
    values = elements.numbers()
    counts = np.diff(starts)
    if len(starts) != columns + 1 or starts[0] != 0 or (counts < 0).any():
        raise ValueError("inconsistent columns of a sparse matrix")
    used = int(starts[-1])
    places = places[:used]
    if min(len(values), len(places)) < used or ((places < 0) | (places >= rows)).any():
        raise ValueError("inconsistent entries of a sparse matrix")
    matrix = np.zeros((rows, columns))
    matrix[places, np.repeat(np.arange(columns), counts)] = values[:used]
    return matrix


# --- tables ---


class MatTable(DataTable):
    """A MAT-file: a trajectory of Dymola or OpenModelica, or columns of numbers.

    A trajectory has two rows at each event; the later one counts.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        variables = read_variables(self.label, content_of(path))
        others = {key: own for key, own in variables.items() if isinstance(own, OtherVariable)}
        matrices = {
            key: own for key, own in variables.items() if not isinstance(own, OtherVariable)
        }
        if "signals" in others and others["signals"].entries:
            raise UsageError(
                f"{self.label}: expected samples, got a log that 'cosim convert' wrote; use the "
                "log itself, or convert it to Parquet"
            )
        self._columns: list[tuple[Vector, float]] = []  # with its sign
        is_trajectory = {"Aclass", "name"} <= others.keys() and "dataInfo" in matrices
        try:
            if is_trajectory:
                self._rows = self._take_trajectory(matrices, others)
            else:
                self._rows = self._take_matrices(matrices)
                for name, other in others.items():
                    self.left_out[name] = f"expected numbers, got {other.what}"
        except (KeyError, IndexError, ValueError) as error:
            raise UsageError(f"{self.label}: a damaged trajectory: {error}") from error
        form = (
            "a trajectory of Dymola or OpenModelica"
            if is_trajectory
            else "matrices of equally many rows"
        )
        self.tell("variables", form, "by their names and sizes", "")

    def _add(self, name: str, unit: str, column: Vector, sign: float = 1.0) -> None:
        self.add_header(
            Header(name, name, None, len(self._columns), is_number=True), unit, "its description"
        )
        self._columns.append((column, sign))

    def _take_trajectory(
        self, matrices: Mapping[str, Matrix], others: Mapping[str, OtherVariable]
    ) -> int:
        """Take the variables of a simulation; parameters have one value. Return its rows."""
        self.same_time = "last"
        if not others["Aclass"].rows:
            raise ValueError("expected a MAT-file of version 4, got a later one")
        names, texts = [others[key].rows for key in ("name", "description")]
        blocks = dict(matrices)
        if others["Aclass"].rows[3].strip("\0 ") == "binTrans":
            names, texts = [tuple(map("".join, zip(*t, strict=True))) for t in (names, texts)]
            blocks = {name: matrix.T for name, matrix in matrices.items()}
        rows = len(blocks["data_2"])
        info = blocks["dataInfo"].astype(np.int64).tolist()
        for name, text, (block, column, *_) in zip(names, texts, info, strict=True):
            unit = _UNIT.fullmatch(text.strip("\0 "))
            data = blocks[f"data_{block or 2}"]  # 0: the time, which is that of all
            if not 0 < abs(column) <= data.shape[1] or len(data) not in (2, rows):
                raise ValueError(f"{name.strip()!r} is in a column that is not there")
            declared = unit["unit"].strip() if unit else ""
            shown = data[:, abs(column) - 1]
            self._add(name.strip("\0 "), declared, shown, math.copysign(1.0, column))
        return rows

    def _take_matrices(self, matrices: Mapping[str, Matrix]) -> int:
        """Take the columns of matrices with as many rows as most of them; return how many."""
        upright = {name: m.T if m.shape[0] == 1 else m for name, m in matrices.items()}
        counts = Counter(len(matrix) for matrix in upright.values() if len(matrix) > 1)
        rows = counts.most_common(1)[0][0] if counts else 0
        for name, matrix in upright.items():
            if len(matrix) != rows:
                self.left_out[name] = f"expected {rows} rows, as most have, got {len(matrix)}"
                continue
            for number, column in enumerate(matrix.T):
                self._add(name if matrix.shape[1] == 1 else f"{name}[{number}]", "", column)
        return rows

    def numbers_of(self, position: int) -> Vector:
        """Return the numbers of a column; a parameter has its value at all times."""
        column, sign = self._columns[position]
        if len(column) != self._rows:
            if column[0] != column[-1]:
                name = repr(self.headers[position].text)
                raise UsageError(
                    f"{self.label}: {name}: expected one value of a parameter, got two"
                )
            column = np.full(self._rows, column[0])
        values: Vector = sign * column
        return values


# --- models ---


def read_model_file(path: Path, letters: tuple[str, ...]) -> tuple[dict[str, Matrix], str]:
    """Return the matrices of a model, as far as a MAT-file has them, and its SHA-256.

    Raises
    ------
    UsageError
        If the file cannot be read or is none of that kind, has no A or C, or a variable of these
        names is no matrix of real numbers.
    """
    content = content_of(path)
    variables = read_variables(f"file {path}", content)
    matrices = {}
    for name in letters:
        value = variables.get(name)
        if isinstance(value, OtherVariable):
            raise UsageError(
                f"file {path}: {name}: expected a matrix of real numbers, got {value.what}"
            )
        if value is not None and value.shape != (0, 0):  # MATLAB's [], which stands for none
            matrices[name] = value
    missing = [name for name in ("A", "C") if name not in matrices]
    if missing:
        raise UsageError(
            f"file {path}: expected A and C, got no {' and '.join(missing)}; available: "
            f"{listing(sorted(variables)) or 'none'}"
        )
    return matrices, hashlib.sha256(content).hexdigest()
