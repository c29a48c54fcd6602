"""FMI 1.0 behind the same calls: initialization without a mode, and what the version lacks."""

import zipfile

import numpy as np
import pytest

from cosim.errors import FmuError, RunError
from cosim.fmi.component import load
from cosim.fmi.driving.diagnostics import Diagnostics
from cosim.fmi.driving.initialization import Initialization
from cosim.fmi.instance import DiscreteStates, StepEnd
from cosim.fmi.options import FmuOptions
from tests.fmi import lag
from tests.fmi.compiled import with_description
from tests.fmi.probes import got, opened, put, xml1


def test_initial_outputs_belong_to_the_inputs_that_were_set(probe1):
    """x = x0 + u and y = 2 x + u at the initialization, which another input repeats."""
    with opened(probe1) as (_, instance):
        variable = instance.description["text"]
        instance.set_text(variable, ("kept",))
        put(instance, x0=1.0, flag=1.0)
        instance.setup_experiment(0.0)
        instance.enter_initialization_mode()
        for u, y in ((2.0, 8.0), (2.0, 8.0), (5.0, 17.0)):
            put(instance, u=u)
            assert got(instance, "y", "x0", "flag") == [y, 1.0, 1.0]
        put(instance, u=1.0)
        instance.exit_initialization_mode()
        assert got(instance, "y", "flag") == [5.0, 1.0]
        assert instance.get_text(variable) == ("kept",)


def test_equal_inputs_do_not_restart(probe1):
    """The probe says where it is initialized, and counts instances: once for equal values."""
    with opened(probe1) as (fmu, instance):
        instance.setup_experiment(0.0)
        instance.enter_initialization_mode()
        for _ in range(3):
            put(instance, u=2.0)
            got(instance, "y")
        instance.exit_initialization_mode()
        assert [text for *_, text in fmu.drain()] == ["hello world", "x = 2"]
        assert got(instance, "count") == [0.0]


def test_an_initialization_with_equal_inputs_shows_the_same_again(tmp_path):
    """The FMU shows no outputs once inputs were set behind its initialization."""
    with load(lag.build(tmp_path, "1")) as fmu:
        u = np.array([2.0, 0.0])
        expected = fmu.component.initialize(0.0, u)
        assert fmu.component.initialize(0.0, u).tolist() == expected.tolist()
        fmu.component.initialize(0.0, u + 1.0)
        assert fmu.component.initialize(0.0, u).tolist() == expected.tolist()


def test_initialization_without_a_reading(probe1):
    with opened(probe1) as (_, instance):
        put(instance, x0=1.0)
        instance.setup_experiment(0.0)
        instance.enter_initialization_mode()
        instance.exit_initialization_mode()
        assert got(instance, "x") == [1.0]


def test_reset_forgets_what_was_set(probe1):
    with opened(probe1) as (_, instance):
        put(instance, x0=1.0)
        instance.setup_experiment(0.0)
        instance.enter_initialization_mode()
        instance.exit_initialization_mode()
        instance.reset()
        instance.setup_experiment(0.0)
        instance.enter_initialization_mode()
        assert got(instance, "x") == [0.0]


def test_model_exchange(model1):
    """The first event iteration is the initialization's; the modes call nothing."""
    with opened(model1) as (_, instance):
        instance.setup_experiment(2.0)
        instance.enter_initialization_mode()
        put(instance, u=3.0, behavior=2)
        instance.exit_initialization_mode()
        assert instance.update_discrete_states() == DiscreteStates(
            False, False, 3.0, values_changed=False, nominals_changed=False
        )
        instance.enter_continuous_time_mode()
        instance.set_time(2.5)
        instance.set_continuous_states(np.array([4.0]))
        assert instance.get_derivatives().tolist() == [3.0]
        assert instance.get_continuous_states().tolist() == [4.0]
        assert instance.get_event_indicators().tolist() == [3.0]
        assert instance.get_nominals().tolist() == [7.0]
        assert instance.completed_integrator_step() == (False, False)
        instance.enter_event_mode()
        assert instance.update_discrete_states() == DiscreteStates(
            False, False, None, values_changed=True, nominals_changed=False
        )


def test_co_simulation(slave1):
    """x = 1 + 3 h + 8 h^2 / 2 with the slope 8, h = 1/2; a discarded step ends after a quarter."""
    with opened(slave1) as (_, instance):
        instance.setup_experiment(0.0)
        instance.enter_initialization_mode()
        put(instance, x0=-2.0, u=3.0)
        instance.exit_initialization_mode()
        instance.set_input_derivatives(instance.description.references_of(["u"]), np.array([8.0]))
        assert instance.do_step(1.0, 0.5) == StepEnd(
            completed=True, terminate=False, last_successful_time=1.5
        )
        assert got(instance, "x", "slope") == [3.5, 8.0]
        put(instance, behavior=1)
        assert instance.do_step(1.5, 0.5) == StepEnd(
            False, terminate=False, discarded=True, last_successful_time=1.625
        )


def test_fmi_1_has_neither_saved_states_nor_derivatives(slave1):
    with opened(slave1) as (_, instance):
        y = instance.description.references_of(["y"])
        u = instance.description.references_of(["u"])
        with pytest.raises(
            RunError, match=r"slave1.fmu: FMI 1.0 has no FMU state, so it cannot be rolled back"
        ):
            instance.get_fmu_state()
        with pytest.raises(RunError, match=r"FMI 1.0 has no directional derivatives"):
            instance.get_directional_derivative(y, u, np.ones(1))
        with pytest.raises(RunError, match=r"FMI 1.0 has no event mode in co-simulation"):
            instance.enter_event_mode()
        with pytest.raises(RunError, match=r"FMI 1.0 has no structural parameters"):
            instance.enter_configuration_mode()


def test_messages_know_their_instance_by_its_address(slave1):
    """Loggers of FMI 1.0 get no environment; before the instantiation there is no address."""
    with opened(slave1) as (first, instance), opened(slave1) as (second, _):
        assert [text for *_, text in first.drain()] == ["hello world"]
        assert [text for *_, text in second.drain()] == ["hello world"]
        instance.setup_experiment(0.0)
        instance.enter_initialization_mode()
        instance.exit_initialization_mode()
        assert [text for *_, text in first.drain()] == ["x = 0"]
        assert second.drain() == []


def test_components_of_fmi_1(probe1):
    """x' = u = 1 from x(0) = x0 + u(0) = 1, so x(0.4) = 1.4 within a few spacings of floats."""
    with load(probe1) as fmu:
        component = fmu.component
        component.prepare(0.1, np.zeros(1, np.bool_), {})
        assert component.initialize(0.0, np.ones(1)).tolist() == [1.0, 3.0]
        y = component.advance(np.arange(5) * 0.1, 0.1, np.ones((5, 1)))
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


def test_an_initialization_is_repeated_with_its_inputs_by_a_new_instance(slave1):
    """The initial state of the probe depends on them: x = x0 + u."""
    with load(slave1, FmuOptions(start={"x0": 1.0})) as fmu:
        u = np.full(fmu.component.interface.n_u, 2.0)
        initialization = Initialization(fmu._instance, {"x0": 1.0}, Diagnostics("probe"))
        y = initialization.enter(0.0, u)
        fmu._instance.renew()
        assert initialization.repeat().tolist() == y.tolist()
        assert got(fmu._instance, "x", "u") == [3.0, 2.0]


NEGATED = """
<ScalarVariable name="down" valueReference="0" causality="input" alias="negatedAlias">
<Real start="0"/></ScalarVariable>
<ScalarVariable name="minus_y" valueReference="4" causality="output" alias="negatedAlias"><Real/>
</ScalarVariable>
<ScalarVariable name="less" valueReference="10" variability="parameter" alias="negatedAlias">
<Integer start="0"/></ScalarVariable>
<ScalarVariable name="not_flag" valueReference="12" variability="parameter" alias="negatedAlias">
<Boolean start="true"/></ScalarVariable>
</ModelVariables>"""


@pytest.mark.parametrize("interface_type", ["me", "cs"])
def test_what_is_negated_changes_its_sign(interface_type, model1, slave1, tmp_path):
    """An input, its slope, outputs; of a Boolean it is the other value."""
    plain = {"me": model1, "cs": slave1}[interface_type]
    xml = xml1(interface_type=interface_type).replace("</ModelVariables>", NEGATED)
    xml = xml.replace(
        'name="u" valueReference="0" causality="input"', 'name="u" valueReference="0"'
    )
    negated = with_description(plain, tmp_path / "x.fmu", xml)
    t = np.array([0.0, 0.5, 1.0])
    u = np.array([[1.0], [2.0], [4.0]])
    rows = {}
    for path, sign in ((plain, 1.0), (negated, -1.0)):
        with load(path, FmuOptions(outputs=("y", "slope"))) as fmu:
            component = fmu.component
            component.prepare(0.5, np.zeros(1, np.bool_), {})
            first = component.initialize(0.0, sign * u[0])
            columns = component.interface.output_columns()
            found = np.vstack([first, component.advance(t, 0.5, sign * u)])
            rows[sign] = {name: found[:, columns[name]] for name in columns}
    for name, values in rows[1.0].items():
        assert rows[-1.0][name].tolist() == values.tolist()
    assert rows[-1.0]["minus_y"].tolist() == (-rows[1.0]["y"]).tolist()
    assert rows[1.0]["y"].any()
    with load(negated, FmuOptions(start={"less": -2, "not_flag": False})) as fmu:
        fmu.component.initialize(0.0, np.zeros(1))
        assert got(fmu._instance, "behavior", "less", "flag", "not_flag") == [2.0, -2.0, 1.0, 0.0]
