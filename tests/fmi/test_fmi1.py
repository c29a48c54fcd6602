"""FMI 1.0 behind the same calls: initialization without a mode for it, and what the version does not have."""

import zipfile

import numpy as np
import pytest

from cosim.errors import FmuError, RunError
from cosim.fmi.component import load
from cosim.fmi.instance import DiscreteStates, StepEnd
from tests.fmi.probes import got, opened, put


def test_outputs_read_at_the_start_belong_to_the_inputs_that_were_set(probe1):
    """x = x0 + u and y = 2 x + u at the initialization, which each other input repeats from the beginning."""
    with opened(probe1) as (_, unit):
        variable = unit.description["text"]
        unit.set_text(variable, ("kept",))
        put(unit, x0=1.0, flag=1.0)
        unit.enter_initialization_mode(0.0)
        for u, y in ((2.0, 8.0), (2.0, 8.0), (5.0, 17.0)):
            put(unit, u=u)
            assert got(unit, "y", "x0", "flag") == [y, 1.0, 1.0]
        put(unit, u=1.0)
        unit.exit_initialization_mode()
        assert got(unit, "y", "flag") == [5.0, 1.0]
        assert unit.get_text(variable) == ("kept",)


def test_equal_inputs_do_not_begin_anew(probe1):
    """The probe counts its instances, and a slave is reset: neither happens twice for the same values."""
    with opened(probe1) as (fmu, unit):
        unit.enter_initialization_mode(0.0)
        for _ in range(3):
            put(unit, u=2.0)
            got(unit, "y")
        unit.exit_initialization_mode()
        assert [text for *_, text in fmu.drain()] == ["hello world", "x = 2"]
        assert got(unit, "count") == [0.0]


def test_initialization_without_a_reading(probe1):
    with opened(probe1) as (_, unit):
        put(unit, x0=1.0)
        unit.enter_initialization_mode(0.0)
        unit.exit_initialization_mode()
        assert got(unit, "x") == [1.0]


def test_reset_forgets_what_was_set(probe1):
    with opened(probe1) as (_, unit):
        put(unit, x0=1.0)
        unit.enter_initialization_mode(0.0)
        unit.exit_initialization_mode()
        unit.reset()
        unit.enter_initialization_mode(0.0)
        assert got(unit, "x") == [0.0]


def test_model_exchange(model1):
    """The first event iteration is the initialization's; the modes call nothing."""
    with opened(model1) as (_, unit):
        unit.enter_initialization_mode(2.0)
        put(unit, u=3.0, behavior=2)
        unit.exit_initialization_mode()
        assert unit.update_discrete_states() == DiscreteStates(
            False, False, 3.0, values_changed=False, nominals_changed=False
        )
        unit.enter_continuous_time_mode()
        unit.set_time(2.5)
        unit.set_continuous_states(np.array([4.0]))
        assert (unit.get_derivatives().tolist(), unit.get_continuous_states().tolist()) == (
            [3.0],
            [4.0],
        )
        assert (unit.get_event_indicators().tolist(), unit.get_nominals().tolist()) == (
            [3.0],
            [7.0],
        )
        assert unit.completed_integrator_step() == (False, False)
        unit.enter_event_mode()
        assert unit.update_discrete_states() == DiscreteStates(
            False, False, None, values_changed=True, nominals_changed=False
        )


def test_co_simulation(slave1):
    """x = 1 + 3 h + 8 h^2 / 2 with the slope 8, h = 1/2; a discarded step ends after a quarter."""
    with opened(slave1) as (_, unit):
        unit.enter_initialization_mode(0.0)
        put(unit, x0=-2.0, u=3.0)
        unit.exit_initialization_mode()
        unit.set_input_derivatives(unit.description.references_of(["u"]), np.array([8.0]))
        assert unit.do_step(1.0, 0.5) == StepEnd(
            completed=True, terminate=False, last_successful_time=1.5
        )
        assert got(unit, "x", "slope") == [3.5, 8.0]
        put(unit, behavior=1)
        assert unit.do_step(1.5, 0.5) == StepEnd(
            False, terminate=False, discarded=True, last_successful_time=1.625
        )


def test_what_fmi_1_does_not_have(slave1):
    with opened(slave1) as (_, unit):
        y, u = unit.description.references_of(["y"]), unit.description.references_of(["u"])
        with pytest.raises(
            RunError, match=r"slave1.fmu: FMI 1.0 has no FMU state, so there is no way back"
        ):
            unit.get_fmu_state()
        with pytest.raises(RunError, match=r"FMI 1.0 has no directional derivatives"):
            unit.get_directional_derivative(y, u, np.ones(1))
        with pytest.raises(RunError, match=r"FMI 1.0 has no event mode in co-simulation"):
            unit.enter_event_mode()
        with pytest.raises(RunError, match=r"FMI 1.0 has no structural parameters"):
            unit.enter_configuration_mode()


def test_messages_know_their_instance_by_its_address(slave1):
    """The logger of FMI 1.0 is given no environment; before it is instantiated an FMU has no address either."""
    with opened(slave1) as (one, first), opened(slave1) as (two, _):
        assert ([text for *_, text in one.drain()], [text for *_, text in two.drain()]) == (
            ["hello world"],
            ["hello world"],
        )
        first.enter_initialization_mode(0.0)
        first.exit_initialization_mode()
        assert ([text for *_, text in one.drain()], two.drain()) == (["x = 0"], [])


def test_components_of_fmi_1(probe1):
    """The driver runs them: x' = u = 1 from x(0) = x0 + u(0) = 1, so x(0.4) = 1.4 within a few spacings of floats."""
    with load(probe1) as fmu:
        unit = fmu.component
        unit.prepare(0.1, np.zeros(1, np.bool_), {})
        assert unit.initialize(0.0, np.ones(1)).tolist() == [1.0, 3.0]
        y = unit.advance(np.arange(5) * 0.1, 0.1, np.ones((5, 1)))
        np.testing.assert_allclose(y[-1], [1.4, 3.8], rtol=1e-15)


def test_a_missing_function_of_fmi_1(tmp_path, slave1):
    """The functions have the model identifier before their names."""
    renamed = slave1.with_suffix(".renamed.fmu")
    with zipfile.ZipFile(slave1) as source, zipfile.ZipFile(renamed, "w") as target:
        for name in source.namelist():
            content = source.read(name).replace(
                b'modelIdentifier="model"', b'modelIdentifier="other"'
            )
            target.writestr(name.replace("model.", "other."), content)
    with pytest.raises(
        FmuError, match=r"the binary other\S+ cannot be used: it has no function other_fmiGetReal"
    ):
        load(renamed)
