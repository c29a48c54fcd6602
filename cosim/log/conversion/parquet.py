"""Tables as Parquet, a group of rows at a time.

Every column holds doubles, null where a component has no row; unit, description and role of the
signal are metadata of its field. Dictionaries are not used: they would merge all NaN, and both
zeros.
"""

from __future__ import annotations

from typing import Any, BinaryIO, Final

import numpy as np

from cosim.core.recorded.frames import TIME
from cosim.core.recorded.joined_rows import JoinedRows
from cosim.errors import UsageError
from cosim.instants import NANOSECONDS
from cosim.log.conversion.choice import LogChoice, signal_metadata

_MOST_ROWS: Final = 2**16  # of a group


def write_parquet(stream: BinaryIO, choice: LogChoice) -> None:
    """Write the signals as a table."""
    arrow = _pyarrow()
    from pyarrow import parquet

    fields = [arrow.field(TIME, arrow.float64(), nullable=False, metadata={"unit": "s"})]
    for column in choice.columns:
        about = signal_metadata(column.signal, column.unit)
        fields.append(arrow.field(column.name, arrow.float64(), metadata=about))
    about = {"source": choice.run.label, "status": choice.run.status}
    schema = arrow.schema(fields, metadata=about)
    options = {"compression": "zstd", "use_dictionary": False, "use_byte_stream_split": True}
    with parquet.ParquetWriter(stream, schema, **options) as writer:
        for part in choice.joined():
            for begin in range(0, len(part), _MOST_ROWS):
                rows = part.part(begin, begin + _MOST_ROWS)
                writer.write_batch(arrow.record_batch(_arrays(arrow, rows), schema=schema))


def need_pyarrow() -> None:
    """Check that Parquet can be written.

    Raises
    ------
    UsageError
        If there is no pyarrow.
    """
    _pyarrow()


def _pyarrow() -> Any:
    try:
        import pyarrow
    except ImportError as error:
        raise UsageError(
            "Parquet files need pyarrow, which is not installed: pip install pyarrow, or, in a "
            "clone of cosim, pip install -e '.[parquet]'"
        ) from error
    return pyarrow


def _arrays(arrow: Any, rows: JoinedRows) -> list[Any]:
    arrays = [arrow.array(rows.time_ns / NANOSECONDS)]
    for number in range(rows.values.shape[1]):
        missing = None if rows.missing is None else rows.missing[:, number]
        values = np.ascontiguousarray(rows.values[:, number])
        arrays.append(arrow.array(values, mask=missing, from_pandas=False))
    return arrays
