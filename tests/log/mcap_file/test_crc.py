"""The CRC of the whole follows from those of its parts."""

import zlib

from hypothesis import given
from hypothesis import strategies as st

from cosim.log.mcap_file.crc import combined_crc


@given(st.binary(max_size=200), st.binary(max_size=200))
def test_the_crc_of_both_is_that_of_their_bytes(first, second):
    """Empty ones too."""
    combined = combined_crc(zlib.crc32(first), zlib.crc32(second), len(second))
    assert combined == zlib.crc32(first + second)


@given(st.integers(0, 2**24), st.integers(0, 255))
def test_long_ones_too(length, byte):
    """Of any length."""
    first = bytes([byte]) * 7
    second = bytes(length)
    combined = combined_crc(zlib.crc32(first), zlib.crc32(second), length)
    assert combined == zlib.crc32(first + second)
