"""Every call of the protocol reaches a loaded FMU, and what it answers comes back."""

import numpy as np
import pytest

from cosim.errors import RunError
from cosim.fmi.instance import DiscreteStates, StepEnd
from tests.fmi.compiled import compile_fmu
from tests.fmi.probes import NUMBERS, got, opened, put, xml2, xml3


def test_model_exchange_calls_of_fmi_2(probe2):
    with opened(probe2, interface_type="me") as (_, unit):
        unit.enter_initialization_mode(2.0)
        put(unit, u=3.0, x=5.0)
        unit.exit_initialization_mode()
        assert unit.update_discrete_states() == DiscreteStates(
            False, False, None, values_changed=False, nominals_changed=True
        )
        put(unit, flag=1.0)
        assert unit.update_discrete_states() == DiscreteStates(
            False, False, 2.5, values_changed=True, nominals_changed=False
        )
        unit.enter_continuous_time_mode()
        unit.set_continuous_states(np.array([4.0]))
        assert unit.get_event_indicators().tolist() == [3.0]
        assert unit.get_nominals().tolist() == [7.0]
        assert (unit.get_derivatives().tolist(), unit.get_continuous_states().tolist()) == (
            [3.0],
            [4.0],
        )
        assert unit.completed_integrator_step() == (True, False)
        assert got(unit, "no_way_back", "y") == [0.0, 4.0]


def test_co_simulation_calls_of_fmi_2(probe2):
    with opened(probe2, interface_type="cs") as (_, unit):
        unit.enter_initialization_mode(0.0)
        unit.exit_initialization_mode()
        put(unit, u=2.0)
        unit.set_input_derivatives(unit.description.references_of(["u"]), np.array([6.0]))
        assert unit.do_step(1.0, 0.5) == StepEnd(
            completed=True, terminate=False, last_successful_time=1.5
        )
        assert got(unit, "slope", "no_way_back", "y") == [6.0, 0.0, 1.0]
        with pytest.raises(
            RunError, match=r"probe2.fmu: FMI 2.0 has no event mode in co-simulation"
        ):
            unit.enter_event_mode()


@pytest.mark.parametrize("flag", [0.0, 1.0])
def test_discard_of_fmi_2_says_how_far_it_came_and_whether_it_ended(probe2, flag):
    """Section 4.2.3: fmi2Terminated and fmi2LastSuccessfulTime are asked for; the probe stops after a quarter of the step."""
    with opened(probe2, interface_type="cs") as (_, unit):
        unit.enter_initialization_mode(0.0)
        unit.exit_initialization_mode()
        put(unit, answer=2.0, flag=flag)
        assert unit.do_step(1.0, 0.5) == StepEnd(
            False, terminate=flag == 1.0, discarded=flag == 0.0, last_successful_time=1.125
        )


def test_a_state_is_copied_into_the_memory_of_an_earlier_one(probe2):
    """fmi2GetFMUstate allocates only for a handle that is NULL; the probe says when it does."""
    with opened(probe2, interface_type="cs") as (fmu, unit):
        put(unit, x=1.0)
        state = unit.get_fmu_state()
        for x in (2.0, 3.0):
            put(unit, x=x)
            assert unit.get_fmu_state(into=state) is state
        put(unit, x=4.0)
        unit.set_fmu_state(state)
        assert got(unit, "x") == [3.0]
        unit.free_fmu_state(state)
        assert [text for *_, text in fmu.drain()] == ["allocated a state"]


def test_without_a_state_there_is_no_way_back(tmp_path):
    """noSetFMUStatePriorToCurrentPoint is true only then; and the state calls say why they cannot be made."""
    path = compile_fmu(tmp_path / "x.fmu", xml2(state=False), "probe2.c")
    with opened(path, interface_type="me") as (_, unit):
        unit.enter_initialization_mode(0.0)
        unit.exit_initialization_mode()
        unit.completed_integrator_step()
        assert got(unit, "no_way_back") == [1.0]
        with pytest.raises(
            RunError, match=r"the FMU cannot save its state \(canGetAndSetFMUstate is false\)"
        ):
            unit.get_fmu_state()
        u, y = unit.description.references_of(["u"]), unit.description.references_of(["y"])
        with pytest.raises(RunError, match="the FMU has no directional derivatives"):
            unit.get_directional_derivative(y, u, np.ones(1))
        with pytest.raises(RunError, match=r"FMI 2.0 has no configuration mode"):
            unit.enter_configuration_mode()


@pytest.mark.parametrize("text", ["", "plain", "schön %s %n"])
def test_strings_of_fmi_2(probe2, text):
    with opened(probe2, interface_type="cs") as (_, unit):
        variable = unit.description["text"]
        unit.set_text(variable, (text,))
        assert unit.get_text(variable) == (text,)


def test_texts_that_cannot_be_set(probe2):
    with opened(probe2, interface_type="cs") as (_, unit):
        variable = unit.description["text"]
        with pytest.raises(RunError, match="text: found 2 texts, needed 1"):
            unit.set_text(variable, ("a", "b"))
        with pytest.raises(RunError, match="cannot be set: a String ends at its first character 0"):
            unit.set_text(variable, ("a\0b",))


def test_model_exchange_calls_of_fmi_3(probe3):
    with opened(probe3, interface_type="me") as (_, unit):
        unit.enter_initialization_mode(2.0)
        put(unit, u=3.0, behavior=5)
        unit.exit_initialization_mode()
        assert unit.update_discrete_states() == DiscreteStates(
            False, False, 2.5, values_changed=False, nominals_changed=True
        )
        unit.enter_continuous_time_mode()
        unit.set_continuous_states(np.array([4.0]))
        assert (unit.get_derivatives().tolist(), unit.get_continuous_states().tolist()) == (
            [3.0],
            [4.0],
        )
        assert unit.get_nominals().tolist() == [7.0]
        assert unit.completed_integrator_step() == (True, False)
        assert got(unit, "no_way_back", "x") == [0.0, 4.0]


@pytest.mark.parametrize(
    ("behavior", "end"),
    [
        (0, StepEnd(True, terminate=False, last_successful_time=1.5)),
        (1, StepEnd(False, terminate=False, discarded=True, last_successful_time=1.0)),
        (2, StepEnd(False, terminate=False, event_needed=True, last_successful_time=1.25)),
        (3, StepEnd(True, terminate=True, last_successful_time=1.5)),
    ],
)
def test_how_a_step_of_fmi_3_ends(probe3, behavior, end):
    with opened(probe3, interface_type="cs") as (_, unit):
        unit.enter_initialization_mode(0.0)
        unit.exit_initialization_mode()
        put(unit, behavior=behavior)
        assert unit.do_step(1.0, 0.5) == end
        assert got(unit, "no_way_back", "event_mode", "early_return") == [0.0, 0.0, 1.0]


def test_event_mode_in_co_simulation(tmp_path):
    """It is said at the instantiation that it will be used, where the FMU has it."""
    with opened(
        compile_fmu(tmp_path / "x.fmu", xml3(event_mode=True), "probe3.c"), interface_type="cs"
    ) as (_, unit):
        assert got(unit, "event_mode") == [float(unit.description.capabilities["cs"].event_mode)]
        unit.enter_initialization_mode(0.0)
        put(unit, behavior=5)
        unit.exit_initialization_mode()
        assert unit.update_discrete_states().next_event_time == 0.5
        unit.enter_step_mode()
        unit.enter_event_mode()


def interpolating(tmp_path):
    return compile_fmu(
        tmp_path / "x.fmu",
        xml3().replace("<CoSimulation ", '<CoSimulation canInterpolateInputs="true" '),
        "probe3.c",
    )


def test_intermediate_updates_put_the_inputs_on_their_lines(tmp_path):
    """Simpson's rule is exact for a straight line: x = 2 h + 6 h^2 / 2; without slopes the input holds its value."""
    with opened(interpolating(tmp_path), interface_type="cs") as (fmu, unit):
        unit.enter_initialization_mode(0.0)
        unit.exit_initialization_mode()
        u = unit.description.references_of(["u"])
        put(unit, u=2.0)
        unit.set_input_derivatives(u, np.array([6.0]))
        unit.do_step(1.0, 0.5)
        assert got(unit, "x", "u") == [1.75, 5.0]  # every number here is a multiple of 1/4: exact
        unit.do_step(1.5, 0.5)
        assert got(unit, "x") == [4.25]
        assert fmu.drain() == []


def test_a_failing_intermediate_update_fails_the_step(tmp_path):
    with opened(interpolating(tmp_path), interface_type="cs") as (_, unit):
        put(unit, behavior=4)
        unit.set_input_derivatives(unit.description.references_of(["u"]), np.array([6.0]))
        with pytest.raises(RunError, match=r"x.fmu: fmi3SetFloat64 returned 3 \(error\)"):
            unit.do_step(1.0, 0.5)


@pytest.mark.parametrize("kind", [*NUMBERS, "Float64"])
def test_every_type_and_width_of_fmi_3(probe3, kind):
    """The limits of the type come back as they were set, alone and in an array, two variables in one call."""
    low, high = (0.0, 1.0) if kind == "Boolean" else (-1.5, 2.5)
    if "Int" in kind:
        limits = np.iinfo(kind.lower())
        low, high = max(limits.min, -(2**53)), min(limits.max, 2**53)
    with opened(probe3, interface_type="cs") as (_, unit):
        names = ["u" if kind == "Float64" else kind, f"{kind}s"]
        values = np.array([high, low, 1.0, high])
        unit.set_float64(unit.description.references_of(names), values)
        assert got(unit, *names) == values.tolist()


def test_texts_of_fmi_3(probe3):
    """Arrays of String, and of Binary in hexadecimal, a 0 inside it too."""
    with opened(probe3, interface_type="cs") as (_, unit):
        texts, binaries = unit.description["texts"], unit.description["binaries"]
        unit.set_text(texts, ("schön", ""))
        unit.set_text(binaries, ("00ff10", ""))
        assert (unit.get_text(texts), unit.get_text(binaries)) == (("schön", ""), ("00ff10", ""))
        with pytest.raises(RunError, match=r"binaries: .* cannot be set: non-hexadecimal"):
            unit.set_text(binaries, ("0x", ""))


def test_configuration_mode(probe3):
    with opened(probe3, interface_type="cs") as (_, unit):
        unit.enter_configuration_mode()
        unit.exit_configuration_mode()
        assert got(unit, "configured") == [2.0]
