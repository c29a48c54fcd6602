"""FMUs driven as components: generated, exported, and written by others."""

import gc
import re
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

import cosim
from cosim.core.contracts import Stopped
from cosim.core.linear import Linear
from cosim.core.signals import Interface, Signal
from cosim.errors import FmuError, RunError
from cosim.fmi.component import ModelExchange, load
from cosim.fmi.generated import GeneratedInstance
from cosim.fmi.options import FmuOptions
from tests.core.parts import driven
from tests.fmi.compiled import compile_fmu
from tests.fmi.plant import INTERFACE, SLOPE, A, B, C, D, grid, inputs, model, run, solution
from tests.fmi.probes import xml3

# At 1 ms and 2 s: 2000 steps, each rounding a few numbers of size 1: well below
# 2000 * 8 * 2^-53 = 1.8e-12.
ROUNDING = 2e-12


class Nonlinear:
    """x' = -x^3 + u, y = x + u: no matrices to know."""

    interface = Interface((Signal("u"),), (Signal("y"),), {"y": ("u",)})
    states = ("x",)

    def initial(self, t, u):
        return np.array([1.0])

    def derivatives(self, t, x, u):
        return -(x**3) + u

    def outputs(self, t, x, u):
        return x + u


def generated(solver=None):
    return ModelExchange(GeneratedInstance.of(model()), solver)


def test_generated_model_with_the_exact_solver_is_the_closed_form():
    """Ramps hide nothing from linear interpolation of the inputs: only rounding is left."""
    assert abs(run(generated(), step=1e-3) - solution(grid(1e-3))).max() < ROUNDING


def test_generated_model_and_the_plain_linear_component_have_equal_bits():
    """The FMI calls add no arithmetic."""
    assert np.array_equal(run(generated(), step=1e-3), run(Linear(model()), step=1e-3))


@pytest.mark.parametrize("solver", ["DOP853", "RK45", "Radau", "BDF", "LSODA"])
def test_adaptive_solvers_agree_with_the_exact_one(solver):
    """A contraction (Re of the eigenvalues is -1.5) keeps the sum of local errors small.

    It is near rtol = 1e-9 of values near 1.
    """
    y = run(generated(solver), step=0.05)
    assert abs(y - run(generated(), step=0.05)).max() < 1e-7


@pytest.mark.parametrize("solver", ["DOP853", "RK45", "Radau", "BDF", "LSODA"])
def test_adaptive_solvers_drive_a_loaded_fmu(solver, exported):
    """Whatever memory scipy hands over: the same numbers as with the generated model.

    Inputs may be read-only.
    """

    def fixed(t):
        rows = inputs(t)
        rows.setflags(write=False)
        return rows

    with load(exported, FmuOptions(solver=solver)) as fmu:
        y = run(fmu.component, step=0.1, u=fixed)
    assert np.array_equal(y, run(generated(solver), step=0.1))


@pytest.mark.slow
def test_lsoda_says_that_a_smaller_step_makes_it_worse():
    """It starts anew at every communication point; BDF, which runs on, is as good as before."""

    def error(component, h):
        return abs(run(component, step=h) - run(generated(), step=h)).max()

    assert error(generated("LSODA"), 0.001) > 10.0 * error(generated("LSODA"), 0.1)
    assert error(generated("BDF"), 0.001) < 2.0 * error(generated("BDF"), 0.1)
    assert "the smaller the communication step, the larger" in generated("LSODA").notes[0]
    assert all(not generated(solver).notes for solver in ("BDF", "RK45", None))


def test_rk4_is_fourth_order():
    """Halving the step divides the error by 16."""

    def error(h):
        return abs(run(generated("rk4"), step=h) - solution(grid(h))).max()

    assert 14.0 < error(0.1) / error(0.05) < 18.5


def test_any_model_can_be_an_instance():
    """A model without matrices gets a solver that keeps a tolerance.

    At rest in x = 1 for u = 1 it stays there.
    """
    component = ModelExchange(GeneratedInstance(Nonlinear()))
    assert component.solver == "RK45"

    def ones(t):
        return np.ones((len(t), 1))

    y = run(component, step=0.1, held=np.array([False]), u=ones)
    assert np.array_equal(y, np.full((21, 1), 2.0))
    with pytest.raises(FmuError, match="solver 'exact' needs the matrices of a linear model"):
        ModelExchange(GeneratedInstance(Nonlinear()), "exact")


def test_loaded_model_exchange_equals_the_generated_model_bit_for_bit(exported):
    """Same solver, same kernel in the same order: there is nothing that could differ."""
    with load(exported, FmuOptions(solver="rk4")) as fmu:
        assert fmu.interface_type == "me"
        y = run(fmu.component, step=1e-3)
    assert np.array_equal(y, run(generated("rk4"), step=1e-3))


def test_co_simulation_with_input_derivatives_equals_the_exact_solver(exported):
    """The FMU does the same first-order hold; u0 + h slope differs from u1 by rounding."""
    with load(exported, FmuOptions(interface_type="cs")) as fmu:
        y = run(fmu.component, step=1e-3)
        assert driven(fmu.component).notes == ()
    assert abs(y - run(generated(), step=1e-3)).max() < ROUNDING


INTERPOLATION = (' canInterpolateInputs="true"', "")
DERIVATIVES = (' providesDirectionalDerivative="true"', "")


def errors_and_notes(path, step):
    with load(path, FmuOptions(interface_type="cs")) as fmu:
        y = run(fmu.component, step=step)
        notes = driven(fmu.component).notes
    errors = abs(y - solution(grid(step))).max(axis=0)
    return errors, notes


def test_co_simulation_with_mean_inputs_and_known_D_is_second_order(edited):
    """The error of a mean input is odd about the middle of the step: its integral vanishes.

    D (u1 - mean) puts the outputs at the end.
    """
    path = edited(INTERPOLATION)
    coarse, notes = errors_and_notes(path, 0.02)
    fine, _ = errors_and_notes(path, 0.01)
    assert notes == ()
    ratio = coarse / fine
    assert ((ratio > 3.8) & (ratio < 4.2)).all()


def test_co_simulation_with_mean_inputs_and_unknown_D_is_first_order_where_it_feeds_through(edited):
    """Without D a feedthrough output is wrong by slope h/2, and the component says so.

    The states stay second order.
    """
    path = edited(INTERPOLATION, DERIVATIVES)
    coarse, notes = errors_and_notes(path, 0.02)
    fine, _ = errors_and_notes(path, 0.01)
    ratio = coarse / fine
    assert 1.8 < ratio[0] < 2.2
    assert ((ratio[1:3] > 3.8) & (ratio[1:3] < 4.2)).all()
    assert coarse[0] == pytest.approx(SLOPE[0] * 0.01, rel=0.1)
    assert notes == (
        "academic: y, x_b lag inputs set to a mean by up to one step (the FMU has no directional "
        "derivatives)",
    )


def test_an_interpolating_fmu_without_D_warns_of_held_inputs_only(edited):
    """The others have their values at the end of a step there."""
    with load(edited(DERIVATIVES), FmuOptions(interface_type="cs")) as fmu:
        assert driven(fmu.component).notes == ()
        notes = driven(fmu.component, [True, False]).notes
    assert notes == (
        "academic: y, x_b lag inputs with a zero-order hold by up to one step "
        "(the FMU has no directional derivatives)",
    )


@pytest.mark.fast("mask0-cs", "mask1-cs", "mask0-me")
@pytest.mark.parametrize("interface_type", ["me", "cs"])
@pytest.mark.parametrize("mask", [(True, False), (True, True)])
def test_held_inputs_keep_their_value_and_reach_the_outputs_at_the_end(
    exported, interface_type, mask
):
    """Held inputs act in an FMU as in the exact discretization; rk4 at 1 ms errs by rounding."""
    held = np.array(mask)
    expected = run(generated(), step=1e-3, held=held)
    with load(exported, FmuOptions(interface_type=interface_type)) as fmu:
        assert abs(run(fmu.component, step=1e-3, held=held) - expected).max() < ROUNDING


def test_held_inputs_of_a_generated_model_with_rk4():
    """An input that jumps goes through event mode; the result is that of the exact solver."""
    held = np.array([True, False])
    y = run(generated("rk4"), step=1e-3, held=held)
    expected = run(generated(), step=1e-3, held=held)
    assert abs(y - expected).max() < ROUNDING


@contextmanager
def made(name, exported):
    """Yield the exported FMU by its interface type, or the generated model by its solver."""
    if name not in ("me", "cs"):
        yield generated(name)
        return
    with load(exported, FmuOptions(interface_type=name)) as fmu:
        yield fmu.component


@pytest.mark.parametrize("name", ["exact", "rk4", "DOP853", "me", "cs"])
def test_results_do_not_depend_on_blocks(name, exported):
    """K = 1 equals K = 1000 equals blocks of 7, bit for bit."""

    def once(blocks):
        with made(name, exported) as component:
            return run(component, step=1e-2, blocks=blocks)

    whole = once(None)
    assert np.array_equal(whole, once(1))
    assert np.array_equal(whole, once(7))


@pytest.mark.parametrize("name", ["exact", "rk4", "me", "cs"])
def test_save_and_restore_is_the_identity(name, exported):
    """Going back and on again gives the same bits.

    The FMU's copies are freed with the saved objects.
    """
    with made(name, exported) as component:
        run(component, step=0.01, stop=0.5)
        t = 0.5 + np.arange(6) * 0.01
        saved = component.save()
        first = component.advance(t, 0.01, inputs(t))
        component.restore(saved)
        assert np.array_equal(first, component.advance(t, 0.01, inputs(t)))
        del saved
        gc.collect()


def test_closing_twice_does_no_harm(exported):
    fmu = load(exported)
    fmu.close()
    fmu.close()


@pytest.mark.parametrize("name", ["exact", "rk4", "me", "cs"])
def test_initialize_may_be_repeated_and_forgets_the_past(name, exported):
    """Other inputs before the first advance, and a second run after it, leave no trace.

    ``outputs`` changes nothing.
    """
    with made(name, exported) as component:
        first = run(component, step=0.01, stop=0.2)
        component.initialize(0.0, np.array([9.0, 9.0]))
        assert np.array_equal(run(component, step=0.01, stop=0.2), first)
        component.prepare(0.01, np.zeros(2, np.bool_), {})
        component.initialize(0.0, inputs(0.0))
        y = component.outputs(0.0, np.array([5.0, 5.0]))
        assert y == pytest.approx(C @ [1.0, -1.0] + D @ [5.0, 5.0], abs=1e-15)
        t = np.array([0.0, 0.01])
        assert np.array_equal(component.advance(t, 0.01, inputs(t)), first[1:2])


def test_design_is_recorded_and_taken_from_the_record():
    """A replay uses the recorded numbers, also those of the model itself."""
    held = np.zeros(2, np.bool_)
    for solver in ("exact", "rk4"):
        design = generated(solver).prepare(0.01, held, {})
        doubled = {**design, "C": 2.0 * design["C"], "D": 2.0 * design["D"]}
        component = generated(solver)
        assert component.prepare(0.01, held, doubled).keys() == design.keys()
        y = component.initialize(0.0, inputs(0.0))
        assert y == pytest.approx(2.0 * solution([0.0])[0], abs=1e-14)


# --- FMUs that others wrote ---


def foreign_inputs(t):
    """u, delta, gain = 2, sign = true."""
    return np.column_stack([inputs(t), np.full(len(t), 2.0), np.ones(len(t))])


HELD = np.array([False, False, True, True])


def test_the_interface_of_a_pythonfmu_fmu(foreign2):
    """Vectors are put together, feedthrough is unknown."""
    with load(foreign2) as fmu:
        interface = fmu.component.interface
        assert "may lag inputs" in driven(fmu.component).notes[0]
    outputs = interface.outputs
    assert not any(interface.knows(output.name) for output in outputs)
    assert [(s.name, s.size, s.type, s.variability) for s in outputs] == [
        ("y", 1, "real", "continuous"),
        ("x_a", 2, "real", "continuous"),
        ("x_b", 1, "real", "continuous"),
        ("steps", 1, "integer", "discrete"),
        ("late", 1, "boolean", "discrete"),
    ]


def test_a_pythonfmu_fmu_is_run_at_its_order(foreign2, capfd):
    """States are second order, feedthrough outputs first."""

    def errors(step):
        with load(foreign2) as fmu:
            rows = run(fmu.component, step=step, held=HELD, u=foreign_inputs)
        assert np.array_equal(rows[:5, 4], [0.0, 2.0, 4.0, 6.0, 8.0])
        assert np.array_equal(rows[:5, 5], [0.0, 0.0, 1.0, 1.0, 1.0])
        return abs(rows[1:, :4] - solution(grid(step))[1:]).max(axis=0)

    ratio = errors(0.02) / errors(0.01)
    assert 1.9 < ratio[0] < 2.1
    assert ((ratio[1:3] > 3.8) & (ratio[1:3] < 4.2)).all()
    assert capfd.readouterr() == ("", "")


def test_a_pythonfmu3_fmu_is_run_through_both_interfaces(foreign3, capfd):
    """FMI 3: model exchange with rk4 is the closed form; co-simulation is second order."""
    with load(foreign3) as fmu:
        assert fmu.metadata["fmi_version"] == "3.0"
        assert fmu.metadata["interface_type"] == "me"
        rows = run(fmu.component, step=1e-2)
    expected = solution(grid(1e-2))
    assert abs(rows[:, [2, 0, 1]] - expected[:, :3]).max() < 1e-9

    def errors(step):
        with load(foreign3, FmuOptions(interface_type="cs")) as fmu:
            states = run(fmu.component, step=step)[:, :2]
        return abs(states - solution(grid(step))[:, 1:3]).max(axis=0)

    ratio = errors(0.02) / errors(0.01)
    assert ((ratio > 3.8) & (ratio < 4.2)).all()
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("limit", [0.05, 0.15])
def test_a_step_that_does_not_end_keeps_what_was_before(foreign2, limit, capfd):
    """The block stops with the completed rows.

    The reason is the FMU's own request, or names the FMU, the call, its status and what was raised.
    """
    with load(foreign2, FmuOptions(start={"limit": limit})) as fmu, pytest.raises(Stopped) as stop:
        run(fmu.component, step=0.01, held=HELD, u=foreign_inputs)
    assert isinstance(stop.value, RunError)
    assert stop.value.steps == round(limit / 0.01)
    assert stop.value.failed == (limit == 0.15)
    reason = "the FMU requests the end of the run"
    if stop.value.failed:
        reason = r"(?s)Foreign2\.fmu: fmi2DoStep returned \d \((error|fatal)\).*beyond the limit"
    assert re.search(reason, str(stop.value))
    assert capfd.readouterr() == ("", "")


def test_integers_and_booleans_are_never_rounded(foreign2):
    """A value that is no integer, or no Boolean, is refused."""
    with (
        load(foreign2) as fmu,
        pytest.raises(RunError, match=r"expected numbers of type Int32, got \[1.5\]"),
    ):
        fmu.component.initialize(0.0, np.array([0.0, 0.0, 1.5, 0.0]))
    with (
        load(foreign2) as fmu,
        pytest.raises(RunError, match=r"expected numbers of type Boolean, got \[2.0\]"),
    ):
        fmu.component.initialize(0.0, np.array([0.0, 0.0, 1.0, 2.0]))
    with load(foreign2) as fmu, pytest.raises(FmuError, match="the FMU cannot save its state"):
        fmu.component.save()


def test_start_values_are_set_and_survive_a_second_run(exported):
    """x_a[0] = 3: y = x1 - u follows, after a reset too."""
    for interface_type in ("me", "cs"):
        with load(
            exported, FmuOptions(interface_type=interface_type, start={"x_a[0]": 3.0})
        ) as fmu:
            first = run(fmu.component, step=0.1)
            assert first[0] == pytest.approx([2.5, 3.0, -1.0, -3.5])
            assert np.array_equal(first, run(fmu.component, step=0.1))
    component = ModelExchange(GeneratedInstance.of(model()), starts={"x_a[0]": 3.0})
    assert run(component, step=0.1) == pytest.approx(first, abs=1e-12)


def test_components_keep_the_contract_of_the_interface(exported):
    """What is exported is read back as it was: names, sizes, feedthrough; x_a is a state.

    Its inputs have start values.
    """
    with load(exported) as fmu:
        expected = replace(
            INTERFACE,
            inputs=tuple(replace(signal, connection="optional") for signal in INTERFACE.inputs),
            initial={"y": ("u",), "x_b": ("u",)},
            prepares=True,
            rollback=True,
            native=True,
            linearizable=True,
            substeps=True,
            continuous=True,
        )
        assert fmu.component.interface == expected
        assert fmu.interface_type == "me"
    with load(exported, FmuOptions(interface_type="cs")) as fmu:
        assert fmu.interface_type == "cs"
    assert A.shape == B.shape


ALIASED = """
[scenario]
name = "aliased"
stop = 1.0
step = 0.5
[components]
ramp = {{ kind = "ramp", slope = 1.0 }}
plant = {{ kind = "fmu", path = "probe.fmu", interface_type = "{interface_type}" }}
[connections]
"plant.{name}" = "ramp.y"
"""


@pytest.mark.parametrize("interface_type", ["me", "cs"])
def test_an_input_is_connected_by_any_of_its_names(interface_type, tmp_path):
    """The log has the name that was connected; the numbers are the same, and so is a replay."""
    alias = 'intermediateUpdate="true"><Alias name="push"/></Float64>'
    xml = xml3().replace('intermediateUpdate="true"/>', alias)
    compile_fmu(tmp_path / "probe.fmu", xml, "probe3.c")
    logs = {}
    for name in ("u", "push"):
        path = tmp_path / f"{name}.toml"
        path.write_text(ALIASED.format(interface_type=interface_type, name=name))
        logs[name] = cosim.run(path, out=tmp_path / f"{name}.mcap")
    assert logs["push"]["plant.push"].tolist() == logs["u"]["plant.u"].tolist() == [0.0, 0.5, 1.0]
    assert logs["push"]["plant.x"].tolist() == logs["u"]["plant.x"].tolist()
    assert logs["u"]["plant.x"][-1] == pytest.approx(0.5, rel=1e-9)
    again_too = {"rerun": True, "allow_code": True}
    for options in ({}, again_too, {**again_too, "components": ["plant"]}):
        again = cosim.replay(tmp_path / "push.mcap", **options)
        assert again["plant.push"].tolist() == [0.0, 0.5, 1.0]
        assert again["plant.x"].tolist() == logs["u"]["plant.x"].tolist()
