"""Chunks compressed and, within limits, decompressed.

32 kB of zstd can hold 1 GiB, and a decompressor limited to 1000 bytes still returned 100 MiB: the
declared size is checked before anything is decompressed, and the decompressor is bounded by it.
"""

from __future__ import annotations

from typing import Literal, final

import zstandard
from isal import isal_zlib

Compression = Literal["zstd", "lz4", "none"]
MOST_BYTES = 64 * 2**20  # a chunk of ours has about 1 to 32 MiB
_LEVEL = 1


def compress(data: memoryview, compression: Compression) -> bytes | memoryview:
    """Compress a chunk's records; without a compression they are returned themselves."""
    if compression == "zstd":
        return zstandard.ZstdCompressor(level=_LEVEL).compress(data)
    if compression == "lz4":
        import lz4.frame  # rarely needed

        return bytes(lz4.frame.compress(data))
    return data


@final
class Scratch:
    """Memory for one chunk after another: pages that are new cost half as much as zstd itself."""

    def __init__(self) -> None:
        self._memory = memoryview(b"")

    def of_size(self, size: int) -> memoryview:
        """Return ``size`` bytes, the same ones again; what is in them is left as it was."""
        if size > len(self._memory):
            # A little more: chunks differ by some rows.
            self._memory = memoryview(bytearray(size + size // 8))
        return self._memory[:size]


def decompress_into(
    scratch: Scratch, data: bytes | memoryview, compression: str, *, size: int, crc: int
) -> memoryview:
    """Decompress a chunk's records and check them.

    Parameters
    ----------
    scratch : Scratch
        Where they are decompressed to, if they are not ``data`` themselves.
    data : bytes or memoryview
    compression : str
        As MCAP writes it: ``"zstd"``, ``"lz4"`` or empty.
    size : int
        Declared size of the records [bytes].
    crc : int
        Declared CRC-32 of the records; 0: the writer gave none.

    Raises
    ------
    ValueError
        If the chunk is too large, has another size or CRC than declared, or cannot be
        decompressed.
    """
    # First of all: nothing may be decompressed, or allocated, for a size that is refused.
    if size > MOST_BYTES:
        raise ValueError(f"a chunk of {size} bytes exceeds the limit of {MOST_BYTES}")
    if compression == "zstd":
        records = _decompress_zstd(scratch, data, size)
    elif compression == "lz4":
        records = _decompress_lz4(data, size)
    elif not compression:
        records = memoryview(data)
    else:
        raise ValueError(f"compression: expected zstd, lz4 or none, got {compression!r}")
    if len(records) != size:
        raise ValueError(f"a chunk does not have the {size} bytes that it declares")
    if crc and isal_zlib.crc32(records) != crc:
        raise ValueError("the CRC of a chunk does not match its content")
    return records


def _decompress_zstd(scratch: Scratch, data: bytes | memoryview, size: int) -> memoryview:
    try:
        frame_size = zstandard.get_frame_parameters(data).content_size
        if frame_size not in (zstandard.CONTENTSIZE_UNKNOWN, size):
            raise ValueError(f"a chunk declares {size} bytes, but expands to {frame_size}")
        memory = scratch.of_size(size + 1)  # one more, to notice a longer chunk
        with zstandard.ZstdDecompressor().stream_reader(data) as stream:
            return memory[: stream.readinto(memory)]
    except zstandard.ZstdError as error:
        raise ValueError(f"a chunk cannot be decompressed: {error}") from error


def _decompress_lz4(data: bytes | memoryview, size: int) -> memoryview:
    import lz4.frame  # rarely needed

    try:
        # One byte more than declared, to notice a longer chunk.
        decompressor = lz4.frame.LZ4FrameDecompressor()
        return memoryview(decompressor.decompress(data, max_length=size + 1))
    except (RuntimeError, EOFError) as error:
        raise ValueError(f"a chunk cannot be decompressed: {error}") from error
