"""Write ``tables.h``, the constants of ``elementary.c``, in 500-digit arithmetic.

``python tests/reference/elementary_tables.py > cosim/native/numerics/tables.h``; needs mpmath. A
test compares the file with what this writes.
"""

from collections.abc import Iterable

from mpmath import atan, exp, floor, ldexp, log, mp, mpf, nint, pi, sin

mp.prec = 1700  # 1/(2 pi) is needed to 1344 bits

EXP_STEPS = 128  # of a factor of two
LOG_STEPS = 128
SIN_STEPS = 128  # of a turn
ATAN_STEPS = 64  # from 0 to 1
TURN_WORDS = 42
TURN_ZEROS = 64  # bits before the binary point, so that every exponent has a window
LOG_FIRST = 0x3FE6900000000000  # bits of the first number; 1 is in the middle of an interval

HEAD = """\
/* The constants of elementary.c: written by tests/reference/elementary_tables.py. Pairs are
 * unevaluated sums, the first number with as many bits as the comment says. */
#ifndef COSIM_TABLES_H
#define COSIM_TABLES_H

#include <stdint.h>
"""


def grid(x: mpf, bit: int) -> mpf:
    """Round to a multiple of ``2**bit``."""
    return ldexp(nint(ldexp(x, -bit)), bit)


def leading(x: mpf, bits: int) -> mpf:
    """Round to so many significant bits."""
    if x == 0:
        return x
    top = int(floor(log(abs(x), 2))) + 1
    return grid(x, top - bits)


def hexadecimal(x: mpf) -> str:
    """Write a double of C, exactly."""
    nearest = float(x)
    return "0.0" if nearest == 0.0 else nearest.hex().replace("0x1.0000000000000p", "0x1p")


def pair(x: mpf, high: mpf) -> str:
    """Write x as ``high`` and the rest."""
    assert mpf(float(high)) == high
    return f"{{{hexadecimal(high)}, {hexadecimal(x - high)}}}"


def table(kind: str, name: str, comment: str, rows: Iterable[str]) -> list[str]:
    """Write an array, one row a line."""
    body = list(rows)
    inside = [f"    {row}," for row in body]
    return ["", f"/* {comment} */", f"static const {kind} {name}[{len(body)}] = {{", *inside, "};"]


def constants(names: dict[str, mpf]) -> list[str]:
    """Write constants."""
    return [f"#define {name} {hexadecimal(value)}" for name, value in names.items()]


def double_of(bits: int) -> mpf:
    """Return the positive normal double of these bits."""
    return ldexp(mpf((bits & (2**52 - 1)) + 2**52), (bits >> 52) - 1075)


def exponential() -> list[str]:
    """Write 2^(j/128) and the reduction by ln 2 / 128."""
    unit = log(2) / EXP_STEPS
    high = leading(unit, 34)  # times 18 bits: exact
    lines = ["", "/* e^x: ln 2/128 as a sum, the first of 34 bits */"]
    lines += constants({"EXP_PER_X": 1 / unit, "EXP_HIGH": high, "EXP_LOW": unit - high})
    powers = [exp(j * unit) for j in range(EXP_STEPS)]
    rows = [pair(power, leading(power, 53)) for power in powers]
    return lines + table("pair", "POWERS", "2^(j/128), j = 0 to 127; 53 bits", rows)


def logarithm() -> list[str]:
    """Write 1/c of ten bits at most and log c, for each interval of z."""
    high = grid(log(2), -42)
    lines = ["", "/* log x: ln 2 as a sum, the first a multiple of 2^-42 */"]
    lines += constants({"LN2_HIGH": high, "LN2_LOW": log(2) - high})
    rows = []
    for i in range(LOG_STEPS):
        begin = LOG_FIRST + (i << 45)
        first = double_of(begin)
        last = double_of(begin + 2**45)
        inverse = grid(2 / (first + last), -9)
        assert max(abs(first * inverse - 1), abs(last * inverse - 1)) < mpf("0.0059")
        value = -log(inverse)
        high = grid(value, -42)
        numbers = (inverse, high, value - high)
        rows.append(f"{{{', '.join(map(hexadecimal, numbers))}}}")
    comment = "1/c, and log c as a sum, the first a multiple of 2^-42"
    return lines + table("interval", "LOGARITHMS", comment, rows)


def sine() -> list[str]:
    """Write sines of a turn, the reduction by pi/64, and the bits of 1/(2 pi)."""
    unit = 2 * pi / SIN_STEPS
    names: dict[str, mpf] = {"SIN_PER_X": 1 / unit}
    rest = unit
    for part, bit in enumerate((-37, -70, -103), start=1):  # 33 bits each
        names[f"SIN_PART_{part}"] = ldexp(floor(ldexp(rest, -bit)), bit)
        rest -= names[f"SIN_PART_{part}"]
    names["SIN_PART_4"] = rest
    names["SIN_UNIT"] = leading(unit, 53)
    names["SIN_UNIT_LOW"] = unit - names["SIN_UNIT"]
    lines = ["", "/* sin x: pi/64 as a sum of three of 33 bits and a rest, and of two doubles */"]
    lines += constants(names)
    quarter = SIN_STEPS // 4
    sines = []
    for j in range(SIN_STEPS):
        exact = {0: 0, quarter: 1, 2 * quarter: 0, 3 * quarter: -1}
        sines.append(mpf(exact[j]) if j in exact else sin(j * unit))
    rows = [pair(value, leading(value, 26)) for value in sines]
    lines += table("pair", "SINES", "sin(2 pi j/128), j = 0 to 127; 26 bits", rows)
    bits = int(floor(ldexp(1 / (2 * pi), 32 * TURN_WORDS - TURN_ZEROS)))
    words = [bits >> 32 * (TURN_WORDS - 1 - i) & 0xFFFFFFFF for i in range(TURN_WORDS)]
    comment = "1/(2 pi) in binary, after 64 bits before the point"
    return lines + table("uint32_t", "TURN", comment, [f"0x{word:08X}" for word in words])


def arctangent() -> list[str]:
    """Write atan(i/64), and pi."""
    lines = ["", "/* atan x: pi and pi/2 as sums */"]
    for name, value in {"PI": +pi, "HALF_PI": pi / 2}.items():
        high = leading(value, 53)
        lines += constants({f"{name}_HIGH": high, f"{name}_LOW": value - high})
    angles = [atan(mpf(i) / ATAN_STEPS) for i in range(ATAN_STEPS + 1)]
    rows = [pair(angle, leading(angle, 53)) for angle in angles]
    return lines + table("pair", "ANGLES", "atan(i/64), i = 0 to 64; 53 bits", rows)


def text() -> str:
    """Return the whole header."""
    types = [
        "",
        "typedef struct {",
        "    double hi, lo;",
        "} pair;",
        "",
        "typedef struct {",
        "    double inverse, hi, lo;",
        "} interval;",
    ]
    parts = [exponential(), logarithm(), sine(), arctangent()]
    lines = [line for part in parts for line in part]
    return HEAD + "\n".join([*types, *lines, "", "#endif", ""])


if __name__ == "__main__":
    print(text(), end="")
