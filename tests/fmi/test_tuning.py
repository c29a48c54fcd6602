"""Tunable parameters of FMUs: set while they run, where the standard allows it."""

import numpy as np
import pytest

from cosim.blocks.source import constant
from cosim.core.clock import Clock
from cosim.core.graph import Graph
from cosim.core.simulation import Simulation
from cosim.errors import FmuError
from cosim.fmi.component import load
from cosim.fmi.driving.tuning import check_tuning, tunable_parameters
from cosim.fmi.options import FmuOptions
from tests.fmi import lag
from tests.fmi.compiled import compile_fmu
from tests.fmi.eventful import friction

STEP = 0.1


class Traced:
    """An instance whose calls of modes, and the numbers that are set, are noted in their order."""

    def __init__(self, instance):
        self.instance = instance
        self.calls = []

    def __getattr__(self, name):
        method = getattr(self.instance, name)
        if name == "set_float64" or name.endswith("_mode"):

            def noted(*arguments):
                self.calls.append(tuple(arguments[1].tolist()) if arguments else name)
                return method(*arguments)

            return noted
        return method


def traced(fmu, driver):
    """Note the calls of what drives an FMU; ``driver`` is its attribute."""
    owner = getattr(fmu.component.component, driver)
    owner._instance = Traced(owner._instance)
    return owner._instance.calls


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("native", [True, False])
@pytest.mark.parametrize("size", [1, 10])
def test_a_parameter_is_set_in_event_mode(version, native, size, tmp_path):
    """v' = u - p: 1.5 for a second, then 0.5 with p = 1.5."""
    with load(friction(tmp_path, version), FmuOptions(start={"p": 0.5})) as fmu:
        components = {"u": constant([2.0]), "d": constant([0.0]), "fmu": fmu.component}
        graph = Graph(components, {"fmu.u": "u.y", "fmu.d": "d.y"}, native=native)
        simulation = Simulation(graph, Clock(2.0, STEP))
        rows = [simulation.step(size)["fmu.v"] for _ in range(10 // size)]
        calls = traced(fmu, "_integrator")
        fmu.tune(simulation.t, {"p": (1.5,)})
        assert calls == ["enter_event_mode", (1.5,), (2.0, 0.0), "enter_continuous_time_mode"]
        simulation.change("fmu", {"p": (1.5,)})
        rows += [simulation.step(size)["fmu.v"] for _ in range(10 // size)]
    v = np.concatenate(rows)[:, 0]
    t = STEP * np.arange(1, 21)
    expected = np.where(t <= 1.0, 1.5 * t, 1.5 + 0.5 * (t - 1.0))
    # right-hand sides that are constant: the solver is exact but for rounding
    assert abs(v - expected).max() < 1e-12


@pytest.mark.parametrize("native", [True, False])
def test_a_co_simulation_fmu_gets_it_between_two_steps(native, tmp_path):
    """An inner step of 0.5 s from t = 1 s on: x = 1 - exp(-t) at its ends, held between."""
    xml = lag.xml("2").replace('name="inner"', 'name="inner" description="tuned"')
    before, inner, after = xml.partition('name="inner"')
    xml = before + inner + after.replace('variability="fixed"', 'variability="tunable"', 1)
    path = compile_fmu(tmp_path / "lag2.fmu", xml, "lag2.c")
    with load(path) as fmu:
        assert tunable_parameters(fmu.description) == ["inner"]
        components = {"u": constant([1.0]), "d": constant([0.0]), "fmu": fmu.component}
        graph = Graph(components, {"fmu.u": "u.y", "fmu.d": "d.y"}, native=native)
        simulation = Simulation(graph, Clock(2.0, STEP))
        first = simulation.step(10)["fmu.x"][:, 0]
        fmu.tune(simulation.t, {"inner": (0.5,)})
        simulation.change("fmu", {"inner": (0.5,)})
        assert simulation["fmu.x"] == first[-1]
        x = simulation.step(10)["fmu.x"][:, 0]
    t = STEP * np.arange(1, 11)
    assert abs(first - (1.0 - np.exp(-t))).max() < 1e-14
    held = 1.0 - np.exp(-np.array([1.0] * 4 + [1.5] * 5 + [2.0]))
    assert abs(x - held).max() < 1e-14


def test_an_fmu_with_event_mode_gets_it_there(tmp_path):
    """FMI 3 in co-simulation: x grows by 1 at the multiples of a period that is set at 0.5 s."""
    xml = lag.xml("3", "events", "any step")
    before, period, after = xml.partition('name="event"')
    xml = before + period + after.replace('variability="fixed"', 'variability="tunable"', 1)
    path = compile_fmu(tmp_path / "lag3.fmu", xml, "lag3.c")
    with load(path, FmuOptions(start={"announces": 1.0})) as fmu:
        components = {"u": constant([0.0]), "d": constant([0.0]), "fmu": fmu.component}
        simulation = Simulation(
            Graph(components, {"fmu.u": "u.y", "fmu.d": "d.y"}), Clock(2.0, STEP)
        )
        assert (simulation.step(5)["fmu.x"] == 0.0).all()
        calls = traced(fmu, "_stepper")
        fmu.tune(simulation.t, {"event": (0.4,)})
        assert calls == ["enter_event_mode", (0.4,), "enter_step_mode"]
        x = simulation.step(3)["fmu.x"][:, 0]
    assert x[:2].tolist() == [0.0, 0.0]
    assert x[2] > 0.9


def test_a_parameter_that_is_not_tunable_is_refused(tmp_path):
    """With those that are, and what they take."""
    path = friction(tmp_path, 2)
    with load(path) as fmu:
        description = fmu.description
    assert tunable_parameters(description) == ["p"]
    with pytest.raises(FmuError, match="FRICTION has no tunable parameter 'q'; available: p"):
        check_tuning(description, {"q": 1.0})
    with pytest.raises(FmuError, match="'p': expected a finite number, got nan"):
        check_tuning(description, {"p": float("nan")})
    with pytest.raises(FmuError, match="'p': expected one value of type Float64, got a list"):
        check_tuning(description, {"p": [1.0, 2.0]})
