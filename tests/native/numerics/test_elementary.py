"""The elementary functions of the kernels against mpmath, and against C11 annex F."""

import ctypes
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cosim.native import build
from cosim.native.library import library

mpmath = pytest.importorskip("mpmath")

FUNCTIONS = ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "exp", "ln")
BOUND = 0.6  # ulp: stated in elementary.h
SUBNORMAL_BOUND = 0.75
TABLES = Path(__file__).parents[2] / "reference" / "elementary_tables.py"
TINY = 5e-324
LARGEST = sys.float_info.max
INF = math.inf
NAN = math.nan
PRECISION = 100  # bits of the result; mpmath adds what arguments and cancellation take
SHORT = 1_000
LONG = 1_000_000


def function(name):
    """Return a function of the library."""
    found = getattr(library, f"cosim_{name}")
    found.restype = ctypes.c_double
    found.argtypes = [ctypes.c_double] * (2 if name == "pow" else 1)
    return found


def ulp(value):
    """Return the distance of doubles around a number of mpmath."""
    if value == 0:
        return mpmath.ldexp(1, -1074)
    top = mpmath.frexp(value)[1]
    return mpmath.ldexp(1, max(top - 53, -1074))


def error(computed, exact):
    """Return the error in ulp; beyond the largest double the right value is infinite."""
    if abs(exact) >= mpmath.ldexp(1, 1024) - mpmath.ldexp(1, 970):
        return 0.0 if math.isinf(computed) and (computed > 0) == (exact > 0) else INF
    return float(abs(mpmath.mpf(computed) - exact) / ulp(exact))


def worst(name, arguments):
    """Return the largest error where the result is normal, and where it is subnormal."""
    computed = function(name)
    exact = getattr(mpmath, name)
    largest = [0.0, 0.0]
    with mpmath.workprec(PRECISION):
        for x in arguments.tolist():
            value = exact(mpmath.mpf(x))
            subnormal = abs(value) < sys.float_info.min
            largest[subnormal] = max(largest[subnormal], error(computed(x), value))
    return largest


def spread(low, high, count, seed=0):
    """Return numbers of both signs whose logarithms are spread evenly."""
    generator = np.random.default_rng(seed)
    exponents = generator.uniform(math.log(low), math.log(high), count)
    return np.exp(exponents) * generator.choice([-1.0, 1.0], count)


def evenly(low, high, count, seed=0):
    """Return numbers that are spread evenly."""
    return np.random.default_rng(seed).uniform(low, high, count)


def neighbors(values, steps=3):
    """Return the doubles nearest to some numbers, and those beside them."""
    found = []
    for value in values:
        below = above = float(value)
        found.append(below)
        for _ in range(steps):
            below = math.nextafter(below, -INF)
            above = math.nextafter(above, INF)
            found += [below, above]
    return np.array(found)


def nearest_to_multiples():
    """Return the doubles m 2^e nearest to multiples of pi/2 and of pi/64, e in steps.

    The last convergent of 2^e/(pi/2) with a denominator below 2^53 is the nearest of all m.
    """
    one = 1 << 1400
    found = []
    for e in [*range(-60, 972, 24), -52, -47, 792, 797]:  # 792 and 797: nearest of all
        for steps in (1, 32):
            with mpmath.workprec(2500):
                ratio = int(mpmath.floor(mpmath.ldexp(2 * steps / mpmath.pi, e + 1400))) % one
            rest = (one, ratio)
            denominators = (0, 1)
            while True:
                whole = rest[0] // rest[1]
                following = whole * denominators[1] + denominators[0]
                if following >= 2**53:
                    break
                rest = (rest[1], rest[0] - whole * rest[1])
                denominators = (denominators[1], following)
            distance = denominators[1] * ratio % one
            distance = min(distance, one - distance)
            assert distance > one >> 62  # of pi/64 or of pi/2, as elementary.c states
            found.append(math.ldexp(denominators[1], e))
    return found


def quarter_turns():
    """Return doubles beside multiples of pi/2 and of pi/64, up to the largest."""
    with mpmath.workprec(1300):
        small = [k * mpmath.pi / 2 for k in range(1, 40)]
        table = [k * mpmath.pi / 128 for k in range(1, 260)]
        switch = [mpmath.mpf(2) ** 15]
        large = [
            mpmath.floor(mpmath.ldexp(1, e) / mpmath.pi) * mpmath.pi for e in range(3, 1023, 9)
        ]
        values = neighbors([*small, *table, *switch, *large, *nearest_to_multiples()], 1)
    return np.concatenate([values, -values[:50]])


def arguments(name, count):
    """Return arguments over the whole domain and beside every place where a formula changes."""
    logarithmic = spread(TINY, 1e308, count)
    if name in ("sin", "cos", "tan"):
        return [logarithmic, evenly(-10, 10, count), spread(1e-3, 1e6, count), quarter_turns()]
    if name in ("asin", "acos"):
        edges = neighbors([-1.0, 0.0, 1.0, math.sqrt(0.5), 0.5, 2**-28])
        inside = edges[np.abs(edges) <= 1.0]
        close = 1.0 - np.abs(spread(1e-16, 1e-2, count))
        return [evenly(-1, 1, count), spread(TINY, 1, count), close, -close, inside]
    if name == "atan":
        edges = neighbors([k / 128 for k in range(1, 140)] + [2**-28, 2**56, LARGEST / 2])
        return [logarithmic, evenly(-3, 3, count), edges]
    if name == "ln":
        near_one = 1.0 + spread(1e-16, 1e-2, count)
        edges = neighbors([0.5, 1.0, 2.0, 1 - 2**-9, 1 + 2**-8, 2**-1022, TINY * 4, LARGEST / 2])
        return [np.abs(logarithmic), evenly(0.3, 3, count), near_one, edges[edges > 0.0]]
    thresholds = [709.782712893384, 710.4758600739439, 22.0, 0.3125, 0.125, 2**-28]
    if name == "exp":
        thresholds += [-708.3964185322641, -745.1332191019411, -744.4400719213812, -746.0]
    edges = neighbors([*thresholds, *(-x for x in thresholds)], 20)
    in_range = evenly(-746 if name == "exp" else -711, 711, count)
    return [in_range, evenly(-2, 2, count), spread(TINY, 40, count), edges]


def bases_and_exponents(count):
    """Return pairs for pow: all sizes of results, bases near 1, and exact cases."""
    generator = np.random.default_rng(1)
    exponents = generator.uniform(-746, 711, count)
    bases = [np.abs(spread(TINY, 1e308, count)), generator.uniform(0.5, 1.5, count)]
    bases.append(1.0 + spread(1e-16, 1e-2, count))
    pairs = []
    for base in bases:
        known = base != 1.0
        pairs.append((base[known], exponents[known] / np.log(base[known])))
    pairs.append((generator.uniform(0, 100, count), generator.integers(-30, 30, count) / 2.0))
    return pairs


def check(name, count):
    """Compare with mpmath."""
    normal = subnormal = 0.0
    for values in arguments(name, count):
        largest = worst(name, values)
        normal = max(normal, largest[0])
        subnormal = max(subnormal, largest[1])
    assert normal < BOUND
    assert subnormal <= SUBNORMAL_BOUND


def check_pow(count):
    """Compare with mpmath."""
    computed = function("pow")
    largest = [0.0, 0.0]
    with mpmath.workprec(PRECISION):
        for bases, exponents in bases_and_exponents(count):
            for x, y in zip(bases.tolist(), exponents.tolist(), strict=True):
                value = mpmath.power(x, y)
                subnormal = abs(value) < sys.float_info.min
                largest[subnormal] = max(largest[subnormal], error(computed(x, y), value))
    assert largest[0] < BOUND
    assert largest[1] <= SUBNORMAL_BOUND


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_are_right_to_the_stated_bound(name):
    """The error against mpmath is below 0.6 ulp, also beside the places where formulas change."""
    check(name, SHORT)


def test_pow_is_right_to_the_stated_bound():
    """The same for pow."""
    check_pow(SHORT)


@pytest.mark.campaign
@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_are_right_to_the_stated_bound_at_a_million_arguments(name):
    """The long form."""
    check(name, LONG // 3)


@pytest.mark.campaign
def test_pow_is_right_to_the_stated_bound_at_a_million_arguments():
    """The long form."""
    check_pow(LONG // 4)


def same(computed, expected):
    """Return whether two doubles are equal, with the sign of zero."""
    if math.isnan(expected):
        return math.isnan(computed)
    return computed == expected and math.copysign(1, computed) == math.copysign(1, expected)


# C11 F.10.1 to F.10.3: exact cases, signs of zero, infinities
SPECIAL = {
    "sin": [(0.0, 0.0), (-0.0, -0.0), (INF, NAN), (-INF, NAN), (TINY, TINY)],
    "cos": [(0.0, 1.0), (-0.0, 1.0), (INF, NAN), (-INF, NAN), (TINY, 1.0)],
    "tan": [(0.0, 0.0), (-0.0, -0.0), (INF, NAN), (-INF, NAN), (-TINY, -TINY)],
    "asin": [(0.0, 0.0), (-0.0, -0.0), (1.0, math.pi / 2), (-1.0, -math.pi / 2), (2.0, NAN)],
    "acos": [(1.0, 0.0), (-1.0, math.pi), (1.0000000000000002, NAN), (-INF, NAN)],
    "atan": [(0.0, 0.0), (-0.0, -0.0), (INF, math.pi / 2), (-INF, -math.pi / 2), (1, math.pi / 4)],
    "sinh": [(0.0, 0.0), (-0.0, -0.0), (INF, INF), (-INF, -INF), (-711.0, -INF)],
    "cosh": [(0.0, 1.0), (-0.0, 1.0), (INF, INF), (-INF, INF), (-711.0, INF)],
    "tanh": [(0.0, 0.0), (-0.0, -0.0), (INF, 1.0), (-INF, -1.0), (TINY, TINY)],
    "exp": [(0.0, 1.0), (-0.0, 1.0), (INF, INF), (-INF, 0.0), (710.0, INF), (-746.0, 0.0)],
    "ln": [(1.0, 0.0), (0.0, -INF), (-0.0, -INF), (-1.0, NAN), (INF, INF), (-INF, NAN)],
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_special_values_are_those_of_annex_f(name):
    """C11 F.10: zeros keep their sign, infinities and what is out of the domain."""
    computed = function(name)
    for x, expected in [*SPECIAL[name], (NAN, NAN)]:
        assert same(computed(x), expected), (x, computed(x))


def special_powers():
    """Return (x, y, x**y) of C11 F.10.4.4."""
    cases = []
    for y in (-0.0, 0.0):
        cases += [(x, y, 1.0) for x in (NAN, INF, -INF, 0.0, -0.0, -3.5, TINY)]
    cases += [(1.0, y, 1.0) for y in (NAN, INF, -INF, 1e300, -0.5)]
    cases += [(-1.0, INF, 1.0), (-1.0, -INF, 1.0), (-1.0, 1e300, 1.0), (-1.0, -(2.0**53), 1.0)]
    for y, is_odd in ((3.0, True), (9007199254740991.0, True), (2.0, False), (2.5, False)):
        for x in (0.0, -0.0):
            sign = math.copysign(1.0, x) if is_odd else 1.0
            cases += [(x, y, sign * 0.0), (x, -y, sign * INF)]
        sign = -1.0 if is_odd else 1.0
        cases += [(-INF, y, sign * INF), (-INF, -y, sign * 0.0), (INF, y, INF), (INF, -y, 0.0)]
    cases += [(x, INF, 0.0) for x in (0.0, -0.0, 0.5, -0.5)]
    cases += [(x, -INF, INF) for x in (0.0, -0.0, 0.5, -0.5)]
    cases += [(x, INF, INF) for x in (1.5, -1.5, INF, -INF)]
    cases += [(x, -INF, 0.0) for x in (1.5, -1.5, INF, -INF)]
    cases += [(-8.0, 1.0 / 3.0, NAN), (-TINY, 0.5, NAN), (NAN, 1.0, NAN), (2.0, NAN, NAN)]
    cases += [(2.0, 1024.0, INF), (-2.0, 1025.0, -INF), (-0.5, 1077.0, -0.0), (2.0, -1e19, 0.0)]
    return cases


def test_special_powers_are_those_of_annex_f():
    """C11 F.10.4.4, each line of it."""
    computed = function("pow")
    for x, y, expected in special_powers():
        assert same(computed(x, y), expected), (x, y, computed(x, y))


def test_powers_that_are_doubles_are_exact():
    """x**n for small integers, 2**n to the smallest subnormal, roots of squares, x**1."""
    computed = function("pow")
    for x in range(-30, 31):
        for n in range(1, 12):
            if abs(x**n) < 2**53:
                assert computed(x, n) == x**n
    for n in range(-1074, 1024):
        assert computed(2.0, n) == math.ldexp(1.0, n)
    for x in spread(1e-300, 1e300, 500).tolist():
        assert computed(x, 1.0) == x
    for x in evenly(0, 2**26, 500).round().tolist():
        assert computed(x * x, 0.5) == x


def test_a_square_is_rounded_once():
    """x**2 is x x, to the ends of the range."""
    for x in np.concatenate([spread(1e-170, 1e160, 2000), evenly(-5, 5, 300)]).tolist():
        assert same(function("pow")(x, 2.0), x * x)


def test_odd_functions_are_odd_to_the_bit_and_even_ones_even():
    """f(-x) is -f(x), or f(x), also where the argument is reduced."""
    for x in np.concatenate([spread(1e-300, 1e308, 300), evenly(-5, 5, 300)]).tolist():
        for name in ("sin", "tan", "atan", "sinh", "tanh"):
            assert same(function(name)(-x), -function(name)(x))
        for name in ("cos", "cosh"):
            assert same(function(name)(-x), function(name)(x))


def test_nan_is_always_the_same_nan():
    """Equal runs have equal bits, on every processor."""
    bits = {np.float64(function(name)(NAN)).view(np.uint64) for name in FUNCTIONS}
    bits.add(np.float64(function("pow")(-2.0, 0.5)).view(np.uint64))
    bits.add(np.float64(function("ln")(-2.0)).view(np.uint64))
    bits.add(np.float64(function("sin")(INF)).view(np.uint64))
    assert bits == {0x7FF8000000000000}


def test_the_tables_are_what_their_script_writes():
    """No constant is typed in."""
    result = subprocess.run(
        [sys.executable, TABLES], capture_output=True, text=True, encoding="utf-8", check=True
    )
    assert result.stdout == (build.HERE / "numerics" / "tables.h").read_text(encoding="utf-8")
