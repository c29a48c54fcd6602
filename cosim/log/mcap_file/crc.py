"""The CRC-32 of bytes that stand one behind the other, from those of each.

Appending n bytes multiplies a CRC, as a polynomial over GF(2), by x**(8 n) modulo the polynomial of
CRC-32 (P. Koopman; the same identity as in zlib's ``crc32_combine``). In the reflected form that
zlib uses the highest bit is the coefficient of x**0.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

_POLYNOMIAL: Final = 0xEDB88320  # reflected
_ONE: Final = 1 << 31
_BYTE: Final = 1 << 23  # x**8


def combined_crc(first: int, second: int, length: int) -> int:
    """Return the CRC-32 of some bytes and ``length`` bytes behind them.

    Parameters
    ----------
    first, second : int
        CRC-32 of the former and of the latter.
    length : int
        Of the latter.
    """
    return _product(_shift(length), first) ^ second


@lru_cache(1024)
def _shift(length: int) -> int:
    """Return x**(8 length) modulo the polynomial."""
    result = _ONE
    square = _BYTE
    while length:
        if length & 1:
            result = _product(result, square)
        square = _product(square, square)
        length >>= 1
    return result


def _product(a: int, b: int) -> int:
    """Return the product of two polynomials modulo the polynomial."""
    product = 0
    bit = _ONE
    while bit:
        if a & bit:
            product ^= b
        b = b >> 1 ^ _POLYNOMIAL if b & 1 else b >> 1
        bit >>= 1
    return product
