"""Every call of the protocol reaches a loaded FMU, and what it returns comes back."""

import os

import numpy as np
import pytest

from cosim.errors import RunError
from cosim.fmi.instance import DiscreteStates, StepEnd
from tests.fmi.compiled import compile_fmu
from tests.fmi.probes import NUMBERS, got, opened, put, xml2, xml3


def test_model_exchange_calls_of_fmi_2(probe2):
    with opened(probe2, interface_type="me") as (_, instance):
        instance.setup_experiment(2.0)
        instance.enter_initialization_mode()
        put(instance, u=3.0, x=5.0)
        instance.exit_initialization_mode()
        assert instance.update_discrete_states() == DiscreteStates(
            False, False, None, values_changed=False, nominals_changed=True
        )
        put(instance, flag=1.0)
        assert instance.update_discrete_states() == DiscreteStates(
            False, False, 2.5, values_changed=True, nominals_changed=False
        )
        instance.enter_continuous_time_mode()
        instance.set_continuous_states(np.array([4.0]))
        assert instance.get_event_indicators().tolist() == [3.0]
        assert instance.get_nominals().tolist() == [7.0]
        assert instance.get_derivatives().tolist() == [3.0]
        assert instance.get_continuous_states().tolist() == [4.0]
        assert instance.completed_integrator_step() == (True, False)
        assert got(instance, "no_way_back", "y") == [1.0, 4.0]
        instance.may_go_back = True
        instance.completed_integrator_step()
        assert got(instance, "no_way_back") == [0.0]


def test_co_simulation_calls_of_fmi_2(probe2):
    with opened(probe2, interface_type="cs") as (_, instance):
        instance.setup_experiment(0.0)
        instance.enter_initialization_mode()
        instance.exit_initialization_mode()
        put(instance, u=2.0)
        instance.set_input_derivatives(instance.description.references_of(["u"]), np.array([6.0]))
        assert instance.do_step(1.0, 0.5) == StepEnd(
            completed=True, terminate=False, last_successful_time=1.5
        )
        assert got(instance, "slope", "no_way_back", "y") == [6.0, 1.0, 1.0]
        instance.may_go_back = True
        instance.do_step(1.5, 0.5)
        assert got(instance, "no_way_back") == [0.0]
        with pytest.raises(
            RunError, match=r"probe2.fmu: FMI 2.0 has no event mode in co-simulation"
        ):
            instance.enter_event_mode()


@pytest.mark.parametrize("flag", [0.0, 1.0])
def test_discard_of_fmi_2_has_a_last_successful_time_and_may_terminate(probe2, flag):
    """Section 4.2.3: fmi2Terminated and fmi2LastSuccessfulTime are read.

    The probe stops after a quarter of the step.
    """
    with opened(probe2, interface_type="cs") as (_, instance):
        instance.setup_experiment(0.0)
        instance.enter_initialization_mode()
        instance.exit_initialization_mode()
        put(instance, answer=2.0, flag=flag)
        assert instance.do_step(1.0, 0.5) == StepEnd(
            False, terminate=flag == 1.0, discarded=flag == 0.0, last_successful_time=1.125
        )


def test_a_state_is_copied_into_the_memory_of_an_earlier_one(probe2):
    """fmi2GetFMUstate allocates only for a handle that is NULL; the probe says when it does."""
    with opened(probe2, interface_type="cs") as (fmu, instance):
        put(instance, x=1.0)
        state = instance.get_fmu_state()
        for x in (2.0, 3.0):
            put(instance, x=x)
            assert instance.get_fmu_state(into=state) is state
        put(instance, x=4.0)
        instance.set_fmu_state(state)
        assert got(instance, "x") == [3.0]
        instance.free_fmu_state(state)
        assert [text for *_, text in fmu.drain()] == ["allocated a state"]


def test_an_fmu_is_told_of_a_way_back_once_a_state_of_it_is_kept(probe2):
    """Not before: there are FMUs that take the announcement for the order to repeat the step."""
    with opened(probe2, interface_type="cs") as (fmu, instance):
        component = fmu.component
        component.prepare(0.1, np.zeros(1, np.bool_), {})
        component.initialize(0.0, np.zeros(1))
        for keeps_state, flag in [(False, 1.0), (True, 0.0)]:
            saved = component.save() if keeps_state else None
            component.advance(np.array([0.0, 0.1]), 0.1, np.zeros((2, 1)))
            assert got(instance, "no_way_back") == [flag]
        component.restore(saved)


def test_without_a_state_there_is_no_rollback(tmp_path):
    """The state calls raise with the reason."""
    path = compile_fmu(tmp_path / "x.fmu", xml2(state=False), "probe2.c")
    with opened(path, interface_type="me") as (_, instance):
        instance.setup_experiment(0.0)
        instance.enter_initialization_mode()
        instance.exit_initialization_mode()
        instance.completed_integrator_step()
        assert got(instance, "no_way_back") == [1.0]
        with pytest.raises(
            RunError, match=r"the FMU cannot save its state \(canGetAndSetFMUstate is false\)"
        ):
            instance.get_fmu_state()
        u = instance.description.references_of(["u"])
        y = instance.description.references_of(["y"])
        with pytest.raises(RunError, match="the FMU has no directional derivatives"):
            instance.get_directional_derivative(y, u, np.ones(1))
        with pytest.raises(RunError, match=r"FMI 2.0 has no configuration mode"):
            instance.enter_configuration_mode()


def test_strings_of_fmi_2(probe2, subtests):
    for text in ["", "plain", "schön %s %n"]:
        with subtests.test(text=text), opened(probe2, interface_type="cs") as (_, instance):
            variable = instance.description["text"]
            instance.set_text(variable, (text,))
            assert instance.get_text(variable) == (text,)


def test_texts_that_cannot_be_set(probe2):
    with opened(probe2, interface_type="cs") as (_, instance):
        variable = instance.description["text"]
        with pytest.raises(RunError, match=r"text: expected 1 string\(s\), got 2"):
            instance.set_text(variable, ("a", "b"))
        with pytest.raises(RunError, match="cannot be set: a String ends at its first character 0"):
            instance.set_text(variable, ("a\0b",))


def test_model_exchange_calls_of_fmi_3(probe3):
    with opened(probe3, interface_type="me") as (_, instance):
        instance.setup_experiment(2.0)
        instance.enter_initialization_mode()
        put(instance, u=3.0, behavior=5)
        instance.exit_initialization_mode()
        assert instance.update_discrete_states() == DiscreteStates(
            False, False, 2.5, values_changed=False, nominals_changed=True
        )
        instance.enter_continuous_time_mode()
        instance.set_continuous_states(np.array([4.0]))
        assert instance.get_derivatives().tolist() == [3.0]
        assert instance.get_continuous_states().tolist() == [4.0]
        assert instance.get_nominals().tolist() == [7.0]
        assert instance.completed_integrator_step() == (True, False)
        assert got(instance, "no_way_back", "x") == [1.0, 4.0]
        instance.may_go_back = True
        instance.completed_integrator_step()
        assert got(instance, "no_way_back") == [0.0]


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
    with opened(probe3, interface_type="cs") as (_, instance):
        instance.setup_experiment(0.0)
        instance.enter_initialization_mode()
        instance.exit_initialization_mode()
        put(instance, behavior=behavior)
        assert instance.do_step(1.0, 0.5) == end
        assert end.returned_early == (behavior == 2)
        assert got(instance, "no_way_back", "event_mode", "early_return") == [1.0, 0.0, 1.0]
        instance.may_go_back = True
        instance.do_step(1.5, 0.5)
        assert got(instance, "no_way_back") == [0.0]


def test_event_mode_in_co_simulation(tmp_path):
    """The instantiation announces that it will be used, where the FMU has it."""
    path = compile_fmu(tmp_path / "x.fmu", xml3(event_mode=True), "probe3.c")
    with opened(path, interface_type="cs") as (_, instance):
        expected = instance.description.capabilities["cs"].event_mode
        assert got(instance, "event_mode") == [float(expected)]
        instance.setup_experiment(0.0)
        instance.enter_initialization_mode()
        put(instance, behavior=5)
        instance.exit_initialization_mode()
        assert instance.update_discrete_states().next_event_time == 0.5
        instance.enter_step_mode()
        instance.enter_event_mode()


def interpolating(tmp_path):
    return compile_fmu(
        tmp_path / "x.fmu",
        xml3().replace("<CoSimulation ", '<CoSimulation canInterpolateInputs="true" '),
        "probe3.c",
    )


def test_intermediate_updates_interpolate_the_inputs_linearly(tmp_path):
    """Simpson's rule is exact for a linear input: x = 2 h + 6 h^2 / 2.

    Without slopes the input keeps its value.
    """
    with opened(interpolating(tmp_path), interface_type="cs") as (fmu, instance):
        instance.setup_experiment(0.0)
        instance.enter_initialization_mode()
        instance.exit_initialization_mode()
        u = instance.description.references_of(["u"])
        put(instance, u=2.0)
        instance.set_input_derivatives(u, np.array([6.0]))
        instance.do_step(1.0, 0.5)
        assert got(instance, "x", "u") == [1.75, 5.0]  # multiples of 1/4: exact
        instance.do_step(1.5, 0.5)
        assert got(instance, "x") == [4.25]
        assert fmu.drain() == []


def test_a_failing_intermediate_update_fails_the_step(tmp_path):
    with opened(interpolating(tmp_path), interface_type="cs") as (_, instance):
        put(instance, behavior=4)
        instance.set_input_derivatives(instance.description.references_of(["u"]), np.array([6.0]))
        with pytest.raises(RunError, match=r"x.fmu: fmi3SetFloat64 returned 3 \(error\)"):
            instance.do_step(1.0, 0.5)


def test_every_type_and_width_of_fmi_3(probe3, subtests):
    """The limits of the type come back as they were set, as a scalar and in an array.

    Both variables are set in one call.
    """
    for variable_type in [*NUMBERS, "Float64"]:
        with subtests.test(variable_type=variable_type):
            low, high = (0.0, 1.0) if variable_type == "Boolean" else (-1.5, 2.5)
            if "Int" in variable_type:
                limits = np.iinfo(variable_type.lower())
                low = limits.min
                high = min(limits.max, 2**53)
            with opened(probe3, interface_type="cs") as (_, instance):
                names = ["u" if variable_type == "Float64" else variable_type, f"{variable_type}s"]
                values = np.array([high, low, 1.0, high])
                instance.set_float64(instance.description.references_of(names), values)
                assert got(instance, *names) == values.tolist()


def test_texts_of_fmi_3(probe3):
    """Arrays of String, and of Binary in hexadecimal, a 0 inside it too."""
    with opened(probe3, interface_type="cs") as (_, instance):
        texts = instance.description["texts"]
        binaries = instance.description["binaries"]
        instance.set_text(texts, ("schön", ""))
        instance.set_text(binaries, ("00ff10", ""))
        assert instance.get_text(texts) == ("schön", "")
        assert instance.get_text(binaries) == ("00ff10", "")
        with pytest.raises(RunError, match=r"binaries: .* cannot be set: non-hexadecimal"):
            instance.set_text(binaries, ("0x", ""))


def test_configuration_mode(probe3):
    with opened(probe3, interface_type="cs") as (_, instance):
        instance.enter_configuration_mode()
        instance.exit_configuration_mode()
        assert got(instance, "configured") == [2.0]


def test_a_new_instance_gets_inputs_inside_its_steps_too(probe3):
    """Of a ramp u = t the integral over 1 s is 1/2, before and after it begins anew."""
    with opened(probe3, interface_type="cs") as (fmu, _):
        u = np.array([[0.0], [1.0]])
        for _ in range(3):
            fmu.component.initialize(0.0, u[0])
            assert fmu.component.advance(np.array([0.0, 1.0]), 1.0, u).tolist() == [[0.5]]


def test_resources_are_a_folder_or_none(tmp_path):
    """FMI 3.0 section 2.3.1: without a folder the path is NULL; else it ends with a separator."""
    for extra, ends in (({}, "nothing"), ({"resources/a": "x"}, f"resources{os.sep}")):
        path = compile_fmu(tmp_path / "x.fmu", xml3(), "probe3.c", defines=("FINDS",), extra=extra)
        for interface_type in ("me", "cs"):
            with opened(path, interface_type=interface_type) as (fmu, _):
                (found,) = (message.text for message in fmu.drain())
                assert found.endswith(ends)
