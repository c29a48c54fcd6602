"""The generated unit by hand, call by call."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cosim.core.contracts import Stopped
from cosim.core.linear import LinearModel
from cosim.errors import FmuError
from cosim.fmi.component import ModelExchange
from cosim.fmi.generated import ALLOWED, GeneratedInstance
from cosim.fmi.instance import DiscreteStates
from tests.fmi.plant import INTERFACE, A, B, C, D, model, run

PATHS = {
    "instantiated": (),
    "initialization": ("enter_initialization_mode",),
    "event": ("enter_initialization_mode", "exit_initialization_mode"),
    "continuous": (
        "enter_initialization_mode",
        "exit_initialization_mode",
        "enter_continuous_time_mode",
    ),
    "terminated": ("enter_initialization_mode", "exit_initialization_mode", "terminate"),
    "freed": ("free_instance",),
}


def unit_in(phase):
    unit = GeneratedInstance.of(model(), "plant")
    for call in PATHS[phase]:
        perform(unit, call)
    return unit


def perform(unit, call):
    inputs, outputs = unit.description.references("input"), unit.description.references("output")
    arguments = {
        "enter_initialization_mode": (0.0,),
        "set_time": (0.5,),
        "set_continuous_states": (np.ones(2),),
        "set_float64": (inputs, np.zeros(2)),
        "get_float64": (outputs,),
        "get_directional_derivative": (outputs, inputs, np.ones(2)),
        "set_fmu_state": (GeneratedInstance.of(model()).get_fmu_state(),),
        "free_fmu_state": (None,),
    }
    return getattr(unit, call)(*arguments.get(call, ()))


@pytest.mark.parametrize("phase", PATHS)
@pytest.mark.parametrize("call", ALLOWED)
def test_every_call_is_allowed_in_its_modes_only(phase, call):
    """The error names the call, the mode, and where it is allowed."""
    unit = unit_in(phase)
    if phase in ALLOWED[call]:
        perform(unit, call)
    else:
        with pytest.raises(
            FmuError,
            match=rf"plant: {call} is not allowed in mode '{phase}'; allowed in: {', '.join(ALLOWED[call])}",
        ):
            perform(unit, call)


def test_directional_derivatives_are_the_matrices():
    """d(y, x')/d(u, x) is (D, C; B, A), exactly, also through an output that is a state."""
    unit = unit_in("continuous")
    names = unit.description
    unknowns = names.references_of(["y", "x_a[0]", "x_a[1]", "x_b", "der(x_a[0])", "der(x_a[1])"])
    for knowns, expected in (
        (("u", "delta"), np.vstack([D, B])),
        (("x_a[0]", "x_a[1]"), np.vstack([C, A])),
    ):
        for column, name in enumerate(knowns):
            found = unit.get_directional_derivative(
                unknowns, names.references_of([name]), np.ones(1)
            )
            assert np.array_equal(found, expected[:, column])
    with pytest.raises(FmuError, match="knowns of a directional derivative are inputs and states"):
        unit.get_directional_derivative(unknowns, names.references_of(["y"]), np.ones(1))
    with pytest.raises(FmuError, match="are outputs, derivatives and states, not inputs"):
        unit.get_directional_derivative(
            names.references_of(["u"]), names.references_of(["u"]), np.ones(1)
        )


def test_a_start_that_depends_on_inputs_follows_them_until_the_start():
    """x(0) = X0 + Xu u: calculated, not settable, and its derivative in initialization mode is C Xu + D."""
    Xu = np.array([[2.0, 0.0], [0.0, 0.0]])
    unit = GeneratedInstance.of(
        LinearModel(INTERFACE, ("x_a[0]", "x_a[1]"), A, B, C, D, np.array([1.0, -1.0]), Xu), "plant"
    )
    inputs, outputs = unit.description.references("input"), unit.description.references("output")
    assert [unit.description[name].initial for name in ("x_a[0]", "x_a[1]")] == [
        "calculated",
        "exact",
    ]
    unit.enter_initialization_mode(0.0)
    unit.set_float64(inputs, np.array([3.0, 0.0]))
    assert np.array_equal(unit.get_float64(outputs), [4.0, 7.0, -1.0, -10.0])
    assert np.array_equal(
        unit.get_directional_derivative(outputs, inputs, np.array([1.0, 0.0])),
        C @ Xu[:, 0] + D[:, 0],
    )
    with pytest.raises(FmuError, match=r"'x_a\[0\]' cannot be set in mode 'initialization'"):
        unit.set_float64(unit.description.references_of(["x_a[0]"]), np.ones(1))
    unit.exit_initialization_mode()
    unit.enter_continuous_time_mode()
    unit.set_float64(inputs, np.zeros(2))
    assert np.array_equal(unit.get_continuous_states(), [7.0, -1.0])


def test_a_state_needs_a_name_of_its_own():
    """A state named like an output that is something else is refused."""
    other = LinearModel(INTERFACE, ("y", "x_a[1]"), A, B, C, D, np.zeros(2), np.zeros((2, 2)))
    with pytest.raises(FmuError, match="'y' is a state and another variable"):
        GeneratedInstance.of(other)


def test_a_run_without_an_fmu_does_not_import_fmpy():
    """Importing fmpy costs a tenth of a second."""
    code = (
        "import sys\nfrom cosim.fmi.component import ModelExchange\nfrom cosim.fmi.generated import GeneratedInstance\n"
        "from tests.fmi.plant import model, run\n"
        "run(ModelExchange(GeneratedInstance.of(model())), step=0.1)\n"
        "print('fmpy' in sys.modules)"
    )
    root = Path(__file__).parents[2]
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root
    )
    assert found.stdout == "False\n"


class Eventful:
    """A generated unit that asks for something."""

    def __init__(self, *answers, step=(False, False)):
        self._instance, self._answers, self._step = (
            GeneratedInstance.of(model(), "eventful"),
            list(answers),
            step,
        )
        self.updates = 0
        able = replace(self._instance.description.capabilities["me"], completed_step=True)
        self.description = replace(self._instance.description, capabilities={"me": able})

    def __getattr__(self, name):
        return getattr(self._instance, name)

    def update_discrete_states(self):
        self.updates += 1
        answer = self._answers.pop(0) if len(self._answers) > 1 else self._answers[0]
        return DiscreteStates(
            **{"need_update": False, "terminate": False, "next_event_time": None} | answer
        )

    def completed_integrator_step(self):
        return self._step


def test_events_that_units_ask_for():
    """Step events are iterated until settled; events without end and the wish to end stop the run with the reason."""
    unit = Eventful({"need_update": True}, {}, step=(True, False))
    assert np.array_equal(
        run(ModelExchange(unit, "rk4"), step=0.1),
        run(ModelExchange(GeneratedInstance.of(model()), "rk4"), step=0.1),
    )
    assert unit.updates == 2 + 20
    for time in (-0.5, float("nan")):
        with pytest.raises(
            Stopped,
            match=f"eventful: at t = 0.0 s it announces a time event at {time} s; needed a time that is not",
        ):
            run(ModelExchange(Eventful({"next_event_time": time}), "rk4"), step=0.1)
    with pytest.raises(
        Stopped,
        match=r"1000 events between t = 0.5 s and 0.6 s, the last at 0.5 s; they do not end",
    ) as stop:
        run(ModelExchange(Eventful({"next_event_time": 0.5}), "rk4"), step=0.1)
    assert (stop.value.failed, stop.value.steps) == (True, 5)
    with pytest.raises(
        Stopped, match=r"the event iteration at t = 0.0 s does not converge in 100 iterations"
    ):
        run(ModelExchange(Eventful({"need_update": True}), "rk4"), step=0.1)
    with pytest.raises(Stopped, match="the FMU requests the end of the run") as stop:
        run(ModelExchange(Eventful({}, step=(False, True)), "rk4"), step=0.1)
    assert (stop.value.failed, stop.value.steps) == (False, 1)
