"""Units by name and by definition, held against the numbers of scipy.constants; conversions."""

import math
from fractions import Fraction

import numpy as np
import pytest
import scipy.constants as si
from hypothesis import assume, given
from hypothesis import strategies as st

from cosim.units import BASE, BaseUnit, Conversion, Unit, base_unit, comparable, conversion

TABLE = {  # factor to the base unit, and the base unit itself
    "mm": (si.milli, "m"), "km": (si.kilo, "m"), "um": (si.micro, "m"), "cm": (si.centi, "m"),
    "nm": (si.nano, "m"), "ms": (si.milli, "s"), "us": (si.micro, "s"), "min": (si.minute, "s"),
    "h": (si.hour, "s"), "km/h": (si.kmh, "m/s"), "g": (si.gram, "kg"), "mg": (1e-6, "kg"),
    "kN": (si.kilo, "kg.m/s2"), "kN.m": (si.kilo, "J"), "bar": (si.bar, "Pa"),
    "mbar": (100.0, "Pa"), "hPa": (100.0, "Pa"), "MPa": (si.mega, "N/m2"),
    "kW.h": (si.kilo * si.hour, "J"), "GHz": (si.giga, "1/s"), "deg": (si.degree, "rad"),
    "rpm": (2.0 * si.pi / si.minute, "rad/s"), "deg/s": (si.degree, "rad/s"),
    "mV": (si.milli, "W/A"), "uF": (si.micro, "C/V"), "MOhm": (si.mega, "V/A"),
    "mmol": (si.milli, "mol"), "mH": (si.milli, "V.s/A"), "mT": (1e-3, "Wb/m2"),
    "S": (1.0, "A/V"), "mm2": (1e-6, "m2"), "mm3": (1e-9, "m^3"), "1/ms": (1e3, "Hz"),
    "W/degC": (1.0, "W/K"), "mK": (1e-3, "K"), "%": (0.01, "1"), "%/s": (0.01, "1/s"),
    "t": (1e3, "kg"), "L": (si.liter, "m3"), "mL": (1e-6, "m3"), "ul": (1e-9, "m3"),
    "l/min": (1e-3 / 60.0, "m3/s"), "kg/L": (1e3, "kg/m3"), "rev": (2.0 * si.pi, "rad"),
    "\u00b5m": (si.micro, "m"), "\u03bcs": (si.micro, "s"), "W/degF": (1.8, "W/K"),
    "rev/min": (2.0 * si.pi / si.minute, "rad/s"), "Nm": (1.0, "N.m"), "kNm": (1e3, "J"),
    "kWh": (3.6e6, "J"), "W/(m2.K)": (1.0, "W/m2/K"), "kJ/(kg*K)": (1e3, "m2/s2/K"),
    "m3/(h.bar)": (1.0 / 3.6e8, "m3/s/Pa"),
}  # fmt: skip
IN_USE = {  # as FMUs, measuring systems and spreadsheets write them
    "psi": (si.psi, "Pa"), "atm": (si.atm, "Pa"), "Torr": (si.torr, "Pa"),
    "mmHg": (133.322387415, "Pa"), "inHg": (3386.388640341, "Pa"), "in": (si.inch, "m"),
    "inch": (si.inch, "m"), "ft": (si.foot, "m"), "yd": (si.yard, "m"), "mi": (si.mile, "m"),
    "nmi": (si.nautical_mile, "m"), "mph": (si.mph, "m/s"), "kph": (si.kmh, "m/s"),
    "kmh": (si.kmh, "m/s"), "kn": (si.knot, "m/s"), "knot": (si.knot, "m/s"),
    "ft/s": (si.foot, "m/s"), "lb": (si.pound, "kg"), "lbm": (si.pound, "kg"),
    "lbf": (si.lbf, "N"), "klbf": (1e3 * si.lbf, "N"), "kgf": (si.kgf, "N"), "kp": (si.kgf, "N"),
    "lbf.ft": (si.lbf * si.foot, "J"), "cal": (si.calorie, "J"), "kcal": (1e3 * si.calorie, "J"),
    "BTU": (si.Btu, "J"), "Btu/h": (si.Btu / 3600.0, "W"), "hp": (si.hp, "W"),
    "PS": (75.0 * si.kgf, "W"), "day": (si.day, "s"), "d": (si.day, "s"), "hr": (si.hour, "s"),
    "sec": (1.0, "s"), "msec": (1e-3, "s"), "r/min": (2.0 * si.pi / 60.0, "rad/s"),
    "U/min": (2.0 * si.pi / 60.0, "rad/s"), "rps": (2.0 * si.pi, "rad/s"), "Ah": (3600.0, "C"),
    "mAh": (3.6, "C"), "VA": (1.0, "W"), "kVA": (1e3, "W"), "var": (1.0, "W"), "kvar": (1e3, "W"),
    "MVAr": (1e6, "W"), "cP": (1e-3, "Pa.s"), "mPa.s": (1e-3, "Pa.s"),
    "cSt": (1e-6, "m2/s"), "ohm": (1.0, "V/A"),
    "kohm": (1e3, "V/A"), "\N{OHM SIGN}": (1.0, "V/A"), "m\u03a9": (1e-3, "V/A"),
    "ppm": (1e-6, "1"), "ppb": (1e-9, "1"), "N\u00b7m": (1.0, "J"), "N m": (1.0, "J"),
    "kg m2 / s2": (1.0, "J"), "m\u00b2": (1.0, "m2"), "kg\u22c5m\u00b2": (1.0, "kg.m2"),
    "s\u207b\u00b9": (1.0, "Hz"), "m**2": (1.0, "m2"), "s^(-1)": (1.0, "Hz"), "Vs": (1.0, "Wb"),
    "As": (1.0, "C"), "mAs": (1e-3, "C"), "Ws": (1.0, "J"), "Nms": (1.0, "J.s"),
    "kgm": (1.0, "kg.m"), "kgm2": (1.0, "kg.m2"), "dm": (0.1, "m"), "cl": (1e-5, "m3"),
    "\N{DEGREE SIGN}": (si.degree, "rad"), "\N{DEGREE SIGN}/s": (si.degree, "rad/s"),
    "W/\N{DEGREE SIGN}C": (1.0, "W/K"), "in2": (si.inch**2, "m2"), "psi/s": (si.psi, "Pa/s"),
    "RPM": (2.0 * si.pi / 60.0, "rad/s"), "torr": (si.torr, "Pa"), "mTorr": (si.torr / 1e3, "Pa"),
    "psia": (si.psi, "Pa"), "ksi": (1e3 * si.psi, "Pa"), "kpsi": (1e3 * si.psi, "Pa"),
    "cmH2O": (98.0665, "Pa"), "mmH2O": (9.80665, "Pa"), "inH2O": (249.08891, "Pa"),
    "cmHg": (1333.22387415, "Pa"), "lpm": (1e-3 / 60.0, "m3/s"), "gpm": (si.gallon / 60.0, "m3/s"),
    "cfm": (si.foot**3 / 60.0, "m3/s"), "cc": (1e-6, "m3"), "oz": (si.oz, "kg"),
    "slug": (si.slug, "kg"), "kip": (1e3 * si.lbf, "N"), "foot": (si.foot, "m"),
    "feet": (si.foot, "m"), "knots": (si.knot, "m/s"), "lm": (1.0, "cd"), "klx": (1e3, "cd/m2"),
    "percent": (0.01, "1"), "-": (1.0, "1"), "P": (0.1, "Pa.s"), "St": (1e-4, "m2/s"),
    "eV": (si.eV, "J"), "erg": (si.erg, "J"), "dyn": (si.dyn, "N"), "week": (si.week, "s"),
    "turn": (2.0 * si.pi, "rad"), "gon": (si.pi / 200.0, "rad"), "degR": (5.0 / 9.0, "K"),
    "Kelvin": (1.0, "K"),
}  # fmt: skip


def test_names_are_exact():
    """The factor is the double nearest to the definition; the powers are those of the base unit."""
    wrong = {}
    for name, (factor, base) in TABLE.items():
        computed = base_unit(name)
        plain = base_unit(base)
        expected = BaseUnit(plain.exponents, factor, 0.0)
        if computed != expected or plain.factor != 1.0:
            wrong[name] = (computed, expected)
    assert wrong == {}


def test_names_in_use_are_known():
    """To the digits of scipy's constants."""
    wrong = {}
    for name, (factor, base) in IN_USE.items():
        computed = base_unit(name)
        plain = base_unit(base)
        same = computed is not None and computed.exponents == plain.exponents
        if not same or computed.factor != pytest.approx(factor, rel=1e-12):
            wrong[name] = (computed, factor, base)
    assert wrong == {}


def test_powers_of_prefixes_are_rounded_once():
    """A product of doubles would be off by a bit: 0.01 cubed is not 1e-6."""
    assert 0.01**3 != 1e-6
    assert base_unit("cm3").factor == 1e-6
    assert base_unit("mm-3").factor == float(Fraction(10**9))


def test_an_ambiguous_unit_is_not_read():
    """Prefixes stand only before symbols with which they are in use; ``min`` is no milli-inch."""
    for name in (
        "Gs",
        "furlong",
        "NM",
        "W/(m2/K)",
        "W/(m2.K",
        "(m)",
        "W/()",
        "kkg",
        "mmin",
        "kt",
        "dB",  # no multiple of a number
        "gal",  # of two sizes
        "psig",  # above the pressure of the day
        "mH2O",
        "m-",
        "Nm2",
        "m%",
        "m99",
        "",
        "m/",
        "mdegC",
        "GW9.GW9",
        "C°",
    ):
        assert base_unit(name) is None, name
    assert base_unit("cd").exponents == tuple(int(base == "cd") for base in BASE)
    assert base_unit("min").factor == 60.0
    assert base_unit("mol").exponents == tuple(int(base == "mol") for base in BASE)


def test_products_quotients_and_powers():
    """A quotient divides by the one factor after it."""
    assert base_unit("kg.m2/s^2") == base_unit("J") == base_unit("N*m")
    assert base_unit("1") == base_unit("rad/rad")
    assert base_unit("m/s/s") == base_unit("m/s2") == base_unit("m.s-2")


def between(first, second):
    return conversion(Unit(first), Unit(second))


def test_values_are_converted_by_definition():
    """Closed forms: the boiling point, a right angle, a heat flow by a temperature difference."""
    assert between("degC", "K")(100.0) == 373.15
    assert between("K", "degC")(273.15) == 0.0
    assert between("bar", "Pa")(1.5) == 150_000.0
    assert between("deg", "rad")(90.0) == 90.0 * (math.pi / 180.0)
    assert between("km/h", "m/s")(36.0) == pytest.approx(10.0, rel=2e-16)
    assert between("W/degC", "W/K").copies
    assert between("degF", "degC")(212.0) == pytest.approx(100.0, abs=1e-13)
    assert between("degC", "degF")(0.0) == pytest.approx(32.0, abs=1e-13)
    assert between("%", "1")(50.0) == 0.5
    for celsius in ("\N{DEGREE SIGN}C", "\N{DEGREE CELSIUS}", "Celsius", "deg C"):
        assert between(celsius, "K")(100.0) == 373.15
    assert between("\N{DEGREE SIGN}F", "\N{DEGREE SIGN}C")(212.0) == pytest.approx(100.0, abs=1e-13)


def test_an_angle_is_no_number():
    """Connected variables need the same power of the radian, too (FMI 3.0 section 2.4.4)."""
    assert between("rad", "1") is None
    assert between("rad/s", "Hz") is None
    assert between("rpm", "1/min") is None


def test_names_that_mean_nothing_equal_only_themselves():
    """With all others, and where one is not declared, there is nothing to compare."""
    assert between("furlong", "furlong").copies
    assert between("furlong", None).copies
    assert between(None, "m").copies
    assert between("furlong", "m").copies
    assert comparable(Unit("furlong"), Unit("furlong"))
    assert not comparable(Unit("furlong"), Unit("m"))
    assert not comparable(Unit(None), Unit(None))
    assert comparable(Unit("m"), Unit("s"))


LENGTH = tuple(int(base == "m") for base in BASE)


def test_a_definition_counts_more_than_a_name():
    """Two definitions of one name are one unit to within their digits; one of them is enough."""
    furlong = Unit("furlong", BaseUnit(LENGTH, 201.168))
    assert conversion(furlong, Unit("m"))(2.0) == 402.336
    assert conversion(furlong, Unit("furlong")).copies
    assert conversion(furlong, Unit("furlong", BaseUnit(LENGTH, 201.16800000001))).copies
    assert conversion(furlong, Unit("furlong", BaseUnit(LENGTH, 201.0))) == Conversion(
        201.168, 0.0, 0.0, 201.0
    )
    assert conversion(Unit("h", BaseUnit(LENGTH)), Unit("h", base_unit("h"))) is None
    turns = BaseUnit(base_unit("rad/s").exponents, 2.0 * math.pi)
    assert conversion(Unit("Hz", turns), Unit("Hz")).copies
    assert conversion(Unit("Hz", turns), Unit("rad/s"))(1.0) == 2.0 * math.pi


@pytest.mark.parametrize(
    ("factor", "offset"), [(0.0, 0.0), (math.nan, 0.0), (math.inf, 0.0), (1.0, math.inf)]
)
def test_a_unit_that_cannot_be_converted_back_is_refused(factor, offset):
    """Its factor is finite and not 0."""
    with pytest.raises(
        ValueError,
        match=f"unit: .* factor {factor}, offset {offset}",
    ):
        BaseUnit(LENGTH, factor, offset)


def test_a_unit_has_one_whole_exponent_for_each_base_unit():
    """No more, no fewer, and no fractions."""
    for exponents in ((), (1,), (0.5,) * 8, (True,) * 8):
        _assert_refused(exponents)


def _assert_refused(exponents):
    with pytest.raises(ValueError, match=r"unit: .* each of kg, m, s, A, K, mol"):
        BaseUnit(exponents)


sizes = st.floats(1e-9, 1e9)
units = st.builds(
    lambda name, factor, offset: Unit(name, BaseUnit(LENGTH, factor, offset)),
    st.text(max_size=2),
    sizes,
    st.floats(-1e3, 1e3),
)


@given(units, units, st.floats(-1e9, 1e9))
def test_there_and_back_is_the_same_but_for_rounding(first, second, value):
    """Each of the four operations rounds by half a unit in the last place of its result.

    The offsets are the largest of these.
    """
    forward = conversion(first, second)
    backward = conversion(second, first)
    base_value = abs(value * first.si.factor)
    largest = max(base_value, abs(first.si.offset), abs(second.si.offset))
    tolerance = 8 * np.finfo(float).eps * (abs(value) + largest / first.si.factor)
    assert abs(backward(forward(value)) - value) <= tolerance


@given(units, st.floats(allow_nan=True), units)
def test_a_unit_to_itself_copies_every_bit(unit, value, other):
    """Also under another name, and also what is no number."""
    assume(other.name != unit.name)
    values = np.array([value, -0.0, np.nan])
    for same in (conversion(unit, unit), conversion(unit, Unit(other.name, unit.base))):
        assert same(values).tobytes() == values.tobytes()


@given(units, units, st.floats(-1e9, 1e9))
def test_arrays_and_numbers_are_converted_alike(first, second, value):
    """The same four operations in the same order."""
    convert = conversion(first, second)
    assert convert(np.array([value]))[0] == convert(value)
