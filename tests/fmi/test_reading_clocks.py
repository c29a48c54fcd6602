"""Clocks of FMI 3 as their files describe them, and Scheduled Execution, which is refused."""

from dataclasses import replace
from fractions import Fraction

import pytest

from cosim.errors import FmuError
from cosim.fmi.checking.check import check
from cosim.fmi.component import load
from cosim.fmi.reading.model_description import read
from cosim.fmi.variable import ClockTiming
from tests.fmi.archives import write

XML = """<?xml version="1.0"?>
<fmiModelDescription fmiVersion="3.0" modelName="clocked" instantiationToken="x">
<INTERFACE modelIdentifier="model"/>
<TypeDefinitions><ClockType name="Tenth" intervalVariability="constant" intervalDecimal="0.1"/>
</TypeDefinitions>
<ModelVariables>
  <Float64 name="time" valueReference="0" causality="independent" variability="continuous"/>
  <Clock name="decimal" valueReference="1" causality="input" intervalVariability="constant"
   intervalDecimal="1e-1" shiftDecimal="0.05"/>
  <Clock name="fraction" valueReference="2" causality="input" intervalVariability="fixed"
   intervalDecimal="0.3333" supportsFraction="true" resolution="3" intervalCounter="1"
   shiftCounter="2"/>
  <Clock name="declared" valueReference="3" causality="input" declaredType="Tenth"/>
  <Clock name="open" valueReference="4" causality="input" intervalVariability="tunable"/>
  <Clock name="next" valueReference="5" causality="input" intervalVariability="changing"/>
  <Clock name="out" valueReference="6" causality="output" intervalVariability="triggered"/>
  <Int32 name="count" valueReference="7" causality="output" clocks="1 6"/>
  <Float64 name="x" valueReference="8" causality="output" variability="discrete" clocks="4">
    <Alias name="second"/></Float64>
</ModelVariables>
<ModelStructure/></fmiModelDescription>"""


def described(tmp_path, *changes, interface="CoSimulation"):
    xml = XML.replace("INTERFACE", interface)
    for old, new in changes:
        assert old in xml
        xml = xml.replace(old, new)
    return write(tmp_path / "x.fmu", [], xml=xml.encode())


def test_timings_are_exact(tmp_path):
    """As the file writes them: a third of a second and a tenth are no float64."""
    description = read(described(tmp_path)).description
    assert description["decimal"].timing == ClockTiming(
        "constant", interval=Fraction(1, 10), shift=Fraction(1, 20)
    )
    assert description["fraction"].timing == ClockTiming(
        "fixed", interval=Fraction(1, 3), shift=Fraction(2, 3), supports_fraction=True
    )
    assert description["declared"].timing == ClockTiming("constant", interval=Fraction(1, 10))
    for name, variability in [("open", "tunable"), ("next", "changing"), ("out", "triggered")]:
        assert description[name].timing == ClockTiming(variability)
    assert description["count"].timing is None


def test_variables_name_their_clocks(tmp_path):
    """Aliases too."""
    description = read(described(tmp_path)).description
    assert description["count"].clocks == ("decimal", "out")
    assert description["x"].clocks == description["second"].clocks == ("open",)
    assert description["decimal"].clocks == ()


def test_wrong_clocks_are_refused(tmp_path, subtests):
    for old, new, problem in [
        (
            'intervalVariability="tunable"',
            'intervalVariability="rarely"',
            "variable 'open': intervalVariability: expected one of: constant, fixed, "
            "tunable, changing, countdown, triggered",
        ),
        (
            'intervalDecimal="1e-1" shiftDecimal="0.05"',
            "",
            "variable 'decimal': a constant clock needs the attribute intervalDecimal",
        ),
        (
            'intervalDecimal="1e-1"',
            'intervalDecimal="soon"',
            "variable 'decimal': intervalDecimal: expected a finite number, got 'soon'",
        ),
        *(
            (
                'intervalDecimal="1e-1"',
                f'intervalDecimal="{text}"',
                f"variable 'decimal': intervalDecimal: expected a finite number, got '{text}'",
            )
            for text in ("0_1", "INF", "1e99999")  # read by Python, but no interval
        ),
        (
            'intervalDecimal="1e-1"',
            'intervalDecimal="-0.1"',
            "variable 'decimal': interval: expected more than 0 s, got -0.1 s",
        ),
        (
            'shiftDecimal="0.05"',
            'shiftDecimal="-1"',
            "variable 'decimal': shift: expected 0 s or more, got -1.0 s",
        ),
        (
            'resolution="3"',
            'resolution="0"',
            "variable 'fraction': resolution: expected 1 or more, with intervalCounter, got 0",
        ),
        (
            'clocks="1 6"',
            'clocks="1 8"',
            "variable 'count': clocks: expected those of clocks, got value reference 8",
        ),
    ]:
        with subtests.test(new=new):
            with pytest.raises(FmuError) as error:
                read(described(tmp_path, (old, new)))
            assert problem in str(error.value)


def test_scheduled_execution_is_refused_by_name(tmp_path):
    """As by the Clocks of the Reference-FMUs: by check and by everything that opens the FMU."""
    path = described(tmp_path, interface="ScheduledExecution")
    text = (
        "scheduled execution only (FMI 3.0 section 5), which is not supported; expected model "
        "exchange or co-simulation"
    )
    assert ("error", "XML", text) in check(path)
    with pytest.raises(FmuError) as error:
        load(path)
    assert str(error.value) == f"{path}: {text}"


def test_scheduled_execution_beside_another_interface_type_is_noted(tmp_path):
    both = 'CoSimulation modelIdentifier="model"/><ScheduledExecution'
    findings = check(described(tmp_path, interface=both))
    assert (
        "note",
        "XML",
        "scheduled execution, which is not supported, beside what is",
    ) in findings


def test_an_fmu_whose_event_mode_is_refused_drives_no_clocks(tmp_path):
    """Its triggered clocks are no ports then."""
    archive = described(tmp_path, interface='CoSimulation hasEventMode="true"')
    declared = replace(read(archive).description, drives_clocks=True)
    refused = declared.without("event_mode", "cs")
    assert not refused.capabilities["cs"].event_mode
    names = [[signal.name for signal, _ in d.ports("output")] for d in (declared, refused)]
    assert names == [["out", "count", "x"], ["count", "x"]]
