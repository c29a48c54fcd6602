"""Descriptions of FMI 1, 2 and 3 are read as the file says.

What contradicts itself is refused, all problems in one report.
"""

import math
import re
from random import Random

import pytest

from cosim.errors import FmuError
from cosim.fmi.checking.check import check
from cosim.fmi.description import Capabilities
from cosim.fmi.driving.initialization import check_start
from cosim.fmi.reading.model_description import read
from cosim.units import BaseUnit
from tests.fmi.archives import write
from tests.fmi.descriptions import CO_SIMULATION, FMI2, FMI3, fmi1

METER = (0, 1, 0, 0, 0, 0, 0, 0)
KELVIN = (0, 0, 0, 0, 1, 0, 0, 0)
NEWTON = (1, 1, -2, 0, 0, 0, 0, 0)


@pytest.fixture
def described(tmp_path):
    """Read an XML from an archive."""
    return lambda xml: read(write(tmp_path / "x.fmu", [], xml=xml.encode())).description


def attributes(variable, *names):
    """Return some attributes of a variable, to compare them at once."""
    return tuple(getattr(variable, name) for name in names)


def test_fmi_1(described):
    """FMI 1 in words of FMI 2: states have a number and no names."""
    description = described(fmi1())
    assert description.version == "1.0"
    assert (description.name, description.token) == ("one", "{1}")
    assert (description.tool, description.default_tolerance) == ("tool 1", 1e-5)
    assert (description.states, description.n_states) == ((), 2)
    assert description.event_indicators == 3
    assert description.capabilities == {"me": Capabilities("one")}


def test_variables_of_fmi_1(described):
    """Units, ranges, enumerations, texts."""
    description = described(fmi1())
    u = description["u"]
    assert u.base == BaseUnit(NEWTON)
    assert (u.minimum, u.maximum, u.nominal, u.doc) == (-1.0, 2.0, 10.0, "force")
    assert description["mode"].items == {"off": 1, "on": 2}
    assert attributes(description["text"], "text", "start") == (("a b",), None)


def test_roles_of_fmi_1(described):
    """Causality, variability and initial in words of FMI 2."""
    roles = {}
    for variable in described(fmi1()).variables:
        roles[variable.name] = attributes(variable, "causality", "variability", "initial")
    assert roles == {
        "u": ("input", "continuous", "exact"),
        "y": ("output", "continuous", "calculated"),
        "z": ("output", "continuous", "calculated"),
        "w": ("local", "continuous", "calculated"),
        "v": ("output", "continuous", "calculated"),
        "k": ("parameter", "fixed", "exact"),
        "guess": ("local", "continuous", "approx"),
        "mode": ("local", "constant", "exact"),
        "text": ("local", "discrete", "exact"),
        "n": ("output", "discrete", "calculated"),
    }


def test_aliases_of_fmi_1(described):
    """An alias shares a reference; a negated one is the opposite of what that has."""
    description = described(fmi1())
    assert description["z"].reference == description["y"].reference
    assert attributes(description["w"], "reference", "negated") == (1, True)
    assert [signal.name for signal in description.interface.outputs] == ["y", "z", "v", "n"]


def test_inputs_of_fmi_1_with_one_reference_are_one_input(described):
    """Two would be set to values of their own; the one that is not negated is it."""
    reference = 'valueReference="0" causality="input"'
    names = {"first": 'alias="negatedAlias"', "second": 'alias="alias"'}
    scalars = {
        name: f'<ScalarVariable name="{name}" {reference} {alias}><Real/></ScalarVariable>'
        for name, alias in names.items()
    }
    xml = fmi1().replace("<ModelVariables>", f"<ModelVariables>{scalars['first']}")
    xml = xml.replace("</ModelVariables>", f"{scalars['second']}</ModelVariables>")
    description = described(xml)
    assert [signal.name for signal in description.interface.inputs] == ["u"]
    assert [description[name].alias_of for name in ("first", "u", "second")] == ["u", None, "u"]
    with pytest.raises(FmuError, match="'first' is 'u' negated"):
        check_start(description, {"first": 1.0})
    assert check_start(description, {"second": 1.0}).numbers == {"second": (1.0,)}


def test_feedthrough_of_fmi_1(described):
    """Without DirectDependency an output may depend on every input."""
    feedthrough = described(fmi1()).interface.feedthrough
    assert feedthrough == {"y": ("u",), "z": None, "v": (), "n": None}


@pytest.mark.parametrize(("what", "tool"), [("StandAlone", False), ("Tool", True)])
def test_co_simulation_of_fmi_1(described, what, tool):
    """An FMU of FMI 1 has one interface type."""
    capabilities = described(fmi1(CO_SIMULATION.replace("{what}", what))).capabilities
    expected = Capabilities(
        "one", interpolates_inputs=True, variable_step=True, once_per_process=True, needs_tool=tool
    )
    assert capabilities == {"cs": expected}


def test_capabilities_of_fmi_2(described):
    me = Capabilities("two", directional_derivatives=True, saves_state=True, needs_tool=True)
    cs = Capabilities(
        "two_cs", interpolates_inputs=True, serializes_state=True, completed_step=False
    )
    assert described(FMI2).capabilities == {"me": me, "cs": cs}


def test_fmi_2(described):
    """States, event indicators, default experiment, initial."""
    description = described(FMI2)
    assert (description.states, description.n_states) == (("x", "hidden"), 2)
    assert description.local_states == ("hidden",)
    assert description.event_indicators == 2
    assert (description.default_step, description.default_tolerance) == (0.01, 1e-6)
    assert description["der(x)"].derivative_of == "x"
    assert description["h"].derivative_of == "hidden"
    initial = [description[name].initial for name in ("x", "u", "mode", "late")]
    assert initial == ["approx", "exact", "exact", "calculated"]


def test_variables_of_fmi_2(described):
    """Units, types, ranges, start values."""
    description = described(FMI2)
    assert description["u"].base == BaseUnit(KELVIN, 1.0, 273.15)
    rise = description["rise"]
    assert rise.base == BaseUnit(KELVIN)  # a difference has no offset
    assert (rise.unit, rise.minimum, rise.maximum, rise.nominal) == ("degC", 0.0, 50.0, 5.0)
    assert description["hidden"].base == BaseUnit(NEWTON, 1000.0)
    assert attributes(description["mode"], "items", "start") == ({"off": -3, "on": 7}, (7.0,))
    assert description["path"].text == ("a b",)
    assert description["late"].variability == "discrete"


def test_the_interface_of_fmi_2(described):
    """Units and start values of the ports; dependencies during the run and in initialization."""
    description = described(FMI2)
    interface = description.interface
    u, i = interface.inputs
    assert (u.name, u.base, u.start) == ("u", BaseUnit(KELVIN, 1.0, 273.15), (20.0,))
    assert (i.name, i.start) == ("i", (3.0, 4.0))
    assert interface.feedthrough == {"rise": ("u",), "x": (), "late": (), "hidden": ()}
    assert description.initial_dependencies == {"x": ("u",), "rise": None, "der(x)": ()}
    assert interface.initial == {"x": ("u",), "rise": None}
    assert interface.feeds_initially("x") == ("u",)
    assert interface.feeds_initially("rise") == ("u", "i")
    assert interface.feeds_initially("late") == ()


def test_capabilities_of_fmi_3(described):
    """Also those that fmpy does not read."""
    capabilities = described(FMI3).capabilities
    assert capabilities["me"] == Capabilities(
        "three",
        directional_derivatives=True,
        adjoint_derivatives=True,
        saves_state=True,
        serializes_state=True,
    )
    assert capabilities["cs"] == Capabilities(
        "three",
        interpolates_inputs=True,
        variable_step=True,
        fixed_step=0.5,
        event_mode=True,
        early_return=True,
        completed_step=False,
        once_per_process=True,
    )


def test_fmi_3(described):
    """States, event indicators, clocks, arrays, aliases."""
    description = described(FMI3)
    assert (description.states, description.n_states) == (("x",), 3)
    assert (description.event_indicators, description.clocks) == (3, ("tick",))
    u = description["u"]
    assert (u.dimensions, u.size, u.start) == (("n", 2), 6, (0.5,) * 6)
    assert u.base == BaseUnit(METER, 0.001)
    alias = description["second"]
    assert (alias.reference, alias.alias_of, alias.doc) == (2, "u", "the same")


def test_types_of_fmi_3(described):
    """All widths, texts, Booleans, enumerations."""
    description = described(FMI3)
    assert attributes(description["y"], "type", "size") == ("Float32", 3)
    assert attributes(description["small"], "maximum", "start") == (9.0, (4.0,))
    assert description["words"].text == ("a b", "c")
    assert description["bytes"].text == ("00ff",)
    assert description["on"].start == (1.0, 0.0)
    items = {"off": 0, "on": 2**53 + 1}
    assert attributes(description["mode"], "type", "items") == ("Int64", items)
    assert description["large"].start is None  # no float64: the FMU keeps its own


def test_the_interface_of_fmi_3(described):
    """An alias is no second input."""
    interface = described(FMI3).interface
    assert [signal.name for signal in interface.inputs] == ["u"]
    assert interface.feedthrough == {"y": ("u",), "mode": (), "x": ()}
    assert interface.initial == {"y": ()}


def test_no_integer_is_long(described):
    """What it takes to read one grows with the square of its digits; FMI's have at most 20."""

    def renumbered(digits):
        number = "8".zfill(digits)
        old = 'name="large" valueReference="8"'
        return described(FMI3.replace(old, old.replace("8", number)))

    assert renumbered(100)["large"].reference == 8
    with pytest.raises(FmuError, match="'large': valueReference: expected an integer, got '00"):
        renumbered(101)


def test_other_sizes(described):
    """A structural parameter changes arrays, states and event indicators.

    Arrays then have the FMU's start values.
    """
    description = described(FMI3).resized({"n": 5})
    assert attributes(description["u"], "size", "start") == (10, None)
    assert description["x"].size == 5
    assert description["n"].start == (5.0,)
    assert (description.n_states, description.event_indicators) == (5, 5)
    assert description.interface.n_u == 10
    assert description["second"].size == 10
    assert description.resized({"n": 3}).n_states == 3
    assert described(FMI3).resized({"n": 3}) == described(FMI3)
    assert described(FMI2).resized({}) == described(FMI2)


def test_other_sizes_that_cannot_be(described, subtests):
    for sizes, text in [
        ({"m": 2}, "three: no variable 'm'; .*available: time, n, u"),
        ({"small": 2}, "three: 'small' is no structural parameter, but of causality parameter"),
        (
            {"n": 0},
            "three: structural parameter 'n': expected an integer from 1 to 5, got 0",
        ),
        (
            {"n": 6},
            "three: structural parameter 'n': expected an integer from 1 to 5, got 6",
        ),
        ({"n": 2.5}, r"'n': expected an integer from 1 to 5, got 2\.5"),
        ({"n": math.nan}, "'n': expected an integer from 1 to 5, got nan"),
    ]:
        with subtests.test(sizes=sizes), pytest.raises(FmuError, match=text):
            described(FMI3).resized(sizes)


BROKEN = [
    (fmi1(), 'guid="{1}"', "", "the attribute guid is missing"),
    (
        fmi1(),
        'modelIdentifier="one"',
        "",
        "fmiModelDescription: the attribute modelIdentifier is missing",
    ),
    (
        fmi1(),
        'modelIdentifier="one"',
        'modelIdentifier="../one"',
        r"modelIdentifier '\.\./one' is no name of a file",
    ),
    (
        fmi1(),
        'States="2"',
        'States="many"',
        "numberOfContinuousStates: expected an integer, got 'many'",
    ),
    (fmi1(), 'States="2"', 'States="-2"', "expected a count from 0 to 2147483647, got -2"),
    (FMI2, 'guid="{2}"', "", "the attribute guid is missing"),
    (FMI2, 'modelIdentifier="two" ', "", "ModelExchange: the attribute modelIdentifier is missing"),
    (FMI2, 'Unit name="item"', 'Unit name="kN"', "two units with the name 'kN'"),
    (
        FMI2,
        'factor="1000"',
        'factor="0"',
        "unit 'kN': factor: expected a finite number that is not 0, got 0.0",
    ),
    (FMI2, 'kg="1"', 'kg="1.5"', "unit 'kN': kg: expected an integer, got '1.5'"),
    (FMI2, 'valueReference="8" ', "", "variable 'late': the attribute valueReference is missing"),
    (
        FMI2,
        'valueReference="8"',
        'valueReference="-8"',
        "variable 'late': valueReference: expected 0 to 4294967295, got -8",
    ),
    (FMI2, 'start="1.5"', 'start="1_5"', "variable 'x': start: expected numbers, got '1_5'"),
    (FMI2, 'start="1.5"', 'start="nan"', "variable 'x': start: expected a number, got nan"),
    (
        FMI2,
        '<Derivatives><Unknown index="4"',
        '<Derivatives><Unknown index="44"',
        "ModelStructure/Derivatives/Unknown: index=44 is no variable",
    ),
    (FMI2, 'start="1.5"', 'start="1 2 3"', "variable 'x': has 3 start values for 1 element"),
    (FMI3, 'start="1 2 3"', 'start=""', "variable 'x': has 0 start values for 3 elements"),
    (FMI3, 'start="1 2 3"', 'start="1 2"', "variable 'x': has 2 start values for 3 elements"),
    (
        FMI2,
        '<Integer start="3"/>',
        '<Integer start="3.5"/>',
        r"variable 'i\[1\]': start: expected integers, got '3.5'",
    ),
    (FMI2, "<Boolean/>", "<Complex/>", "variable 'late': its type is none of FMI 2"),
    (FMI2, 'derivative="3"', 'derivative="0"', r"variable 'der\(x\)': derivative=0 is no variable"),
    (FMI2, 'value="-3"', 'value="off"', "item: value: expected an integer, got 'off'"),
    (FMI3, 'instantiationToken="{3}"', "", "the attribute instantiationToken is missing"),
    (FMI3, 'derivative="4"', 'derivative="44"', "variable 'dx': derivative=44 is no variable"),
    (
        FMI3,
        'Dimension valueReference="1"',
        'Dimension valueReference="77"',
        "variable 'u': Dimension: expected .* 16777216 elements, got none",
    ),
    (
        FMI3,
        'Dimension start="2"',
        'Dimension start="99999999"',
        "expected .* at most 16777216 elements, got 99999999",
    ),
    (
        FMI3,
        'Start value="00ff"',
        'Start value="00f"',
        "variable 'bytes': start: expected hexadecimal digits, two for each byte",
    ),
    (
        FMI3,
        'Size="0.5"',
        'Size="abc"',
        "CoSimulation: fixedInternalStepSize: expected a number, got 'abc'",
    ),
    (
        FMI3,
        'Size="0.5"',
        'Size="-1"',
        r"CoSimulation: fixedInternalStepSize: expected a positive number, got -1\.0",
    ),
    (
        FMI3,
        'Size="0.5"',
        'Size="nan"',
        "CoSimulation: fixedInternalStepSize: expected a positive number, got nan",
    ),
]


def test_contradictory_descriptions_are_refused(described, subtests):
    """One clear error each."""
    for xml, before, after, text in BROKEN:
        with subtests.test(text=text):
            assert before in xml
            with pytest.raises(FmuError, match=f"x.fmu: modelDescription.xml: .*{text}") as error:
                described(xml.replace(before, after))
            # A name or size may matter in several places.
            assert len(str(error.value).splitlines()) <= 5


HARMLESS = [
    (
        FMI2,
        'modelIdentifier="two"',
        'modelIdentifier="two-point.5"',
        "ModelExchange: modelIdentifier 'two-point.5' is no identifier of C",
    ),
    (
        FMI2,
        'name="late"',
        'name="u"',
        "variables have a name that another has before them, and are called: 'u#2'",
    ),
    (
        FMI3,
        'Alias name="second"',
        'Alias name="y"',
        "variables have a name that another has before them, and are called: 'y#2'",
    ),
    (FMI2, 'min="0"', 'min="low"', "variable 'rise': min: expected a number, got 'low'"),
    (
        FMI2,
        'derivative="3"',
        "",
        "der(x): listed as a derivative, without an attribute derivative that names its state",
    ),
    (FMI2, 'index="9"', 'index="19"', "ModelStructure/Outputs/Unknown: index=19 is no variable"),
    (
        FMI2,
        'dependencies="1 3"',
        'dependencies="1 33"',
        "Unknown 'rise': dependencies name no variable: 33",
    ),
    (
        FMI2,
        'dependencies="1 3"',
        'dependencies="u"',
        "Unknown 'rise': dependencies: expected integers, got 'u'",
    ),
    (
        FMI2,
        'stepSize="0.01"',
        'stepSize="fast"',
        "DefaultExperiment: stepSize: expected a number, got 'fast'",
    ),
]


def test_harmless_deviations_are_warnings(tmp_path, subtests):
    """An FMU against the standard that can run as it is meant is read, with one warning."""
    for xml, before, after, text in HARMLESS:
        with subtests.test(text=text):
            assert before in xml
            changed = xml.replace(before, after, 1).encode()
            (warning,) = read(write(tmp_path / "x.fmu", [], xml=changed)).warnings
            assert text in warning


def test_variables_of_one_name(described):
    """The first keeps the name; one with its type and reference is the same, and no second port."""
    other = described(FMI2.replace('name="late"', 'name="u"'))
    assert attributes(other["u"], "causality", "reference") == ("input", 0)
    assert attributes(other["u#2"], "causality", "reference", "alias_of") == ("output", 8, None)
    twice = FMI2.replace("</ModelVariables>", f"{DOUBLE}{DOUBLE}</ModelVariables>")
    same = described(twice)
    assert attributes(same["double#2"], "reference", "alias_of") == (77, "double")
    assert [signal.name for signal in same.interface.inputs] == ["u", "i", "double"]


DOUBLE = (
    '<ScalarVariable name="double" valueReference="77" causality="input"><Real start="1"/>'
    "</ScalarVariable>"
)


def test_derivatives_that_name_no_state(described):
    """The states are counted all the same; in which order they stand is not known by names."""
    description = described(FMI2.replace('derivative="3"', ""))
    assert (description.states, description.n_states) == ((), 2)
    assert description.interface.feedthrough["x"] is None
    assert description.local_states == ()


def test_dependencies_that_are_wrong_are_unknown(described):
    """An output then may depend on every input."""
    description = described(FMI2.replace('dependencies="1 3"', 'dependencies="1 33"'))
    assert description.interface.feedthrough["rise"] is None


def test_units_that_are_defined_twice(described):
    """Twice the same is one; two meanings are refused (see above)."""
    unit = '<Unit name="item"/>'
    assert unit in FMI2
    assert described(FMI2.replace(unit, unit + unit))["u"].unit == "degC"


def test_all_is_reported_at_once(described):
    xml = FMI2.replace('guid="{2}"', "")
    xml = xml.replace('start="1.5"', 'start="x"')
    xml = xml.replace('kg="1"', 'kg="1.5"')
    problems = r"(?s)variable 'x': start: found 'x'.*|unit 'kN': kg.*|guid is missing"
    with pytest.raises(FmuError, match=problems) as error:
        described(xml)
    assert len(str(error.value).splitlines()) == 3


def test_fmus_of_pythonfmu(foreign2):
    """No dependencies are listed, so they are unknown."""
    description = read(foreign2).description
    assert description.interface.feedthrough["y"] is None
    assert description["limit"].variability == "tunable"
    assert set(description.capabilities) == {"cs"}


def test_fmus_of_pythonfmu3(foreign3):
    """Model exchange has states."""
    description = read(foreign3).description
    assert set(description.capabilities) == {"me", "cs"}
    assert description.states == ("x1", "x2")
    assert description.interface.feedthrough == {"x1": (), "x2": (), "y": None}
    assert description.interface.initial == {"y": None}


VALUES = (
    "",
    "-1",
    "0",
    "1e999",
    "nan",
    "INF",
    "x",
    "1 2 3",
    "9" * 30,
    "4294967296",
    "true",
    "1_0",
    "²",
    " 5 ",
    "\n",
)


def mutant(random: Random) -> str:
    """Change a description in up to three places.

    Attributes are removed or get another value, elements are removed or doubled.
    """
    xml = random.choice((fmi1(), FMI2, FMI3))
    for _ in range(random.randint(1, 3)):
        attribute = random.choice(list(re.finditer(r' \w+="([^"]*)"', xml)))
        element = random.choice(list(re.finditer(r"<[A-Z]\w+[^<>]*/>", xml)))
        value = random.choice(VALUES)
        without_attribute = xml[: attribute.start()] + xml[attribute.end() :]
        other_value = xml[: attribute.start(1)] + value + xml[attribute.end(1) :]
        without_element = xml[: element.start()] + xml[element.end() :]
        doubled = xml[: element.end()] + element[0] + xml[element.end() :]
        xml = random.choice((without_attribute, other_value, without_element, doubled))
    return xml


@pytest.mark.parametrize("count", [100, pytest.param(20_000, marks=pytest.mark.campaign)])
def test_mutants_are_read_or_refused(described, tmp_path, monkeypatch, count):
    """Reading returns a description with an interface, or raises; the check has findings."""
    monkeypatch.setattr("cosim.fmi.checking.check._run_trials", lambda *_: [])
    random = Random(count)
    refused = 0
    for _ in range(count):
        xml = mutant(random)
        try:
            description = described(xml)
        except FmuError:
            refused += 1
        else:
            assert description.interface.n_u <= description.n_states + 2**25
        assert check(tmp_path / "x.fmu")
    assert 0.2 * count < refused < 0.8 * count


def test_an_input_has_the_name_that_it_is_connected_by(described):
    """An Alias of FMI 3 takes the place of the first name, and feeds through as that did."""
    xml = FMI3.replace('<Alias name="second"', '<Alias name="third"/><Alias name="second"')
    description = described(xml)
    own = description.interface
    called = description.calling({"second", "y", "nothing"}).interface
    names = ["second" if signal.name == "u" else signal.name for signal in own.inputs]
    assert [signal.name for signal in called.inputs] == names
    assert called.by_name["second"].size == own.by_name["u"].size
    for output, inputs in own.feedthrough.items():
        expected = inputs and tuple("second" if name == "u" else name for name in inputs)
        assert called.feedthrough[output] == expected
    assert description.calling({"u"}) is description
    for names in ({"u", "second"}, {"second", "third"}):
        with pytest.raises(FmuError, match="are one input by two names; connect one of them"):
            description.calling(names)
