"""A generated instance by hand, call by call."""

import subprocess
import sys
from dataclasses import replace
from itertools import product
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


def instance_in(mode):
    instance = GeneratedInstance.of(model(), "plant")
    for call in PATHS[mode]:
        perform(instance, call)
    return instance


def perform(instance, call):
    inputs = instance.description.references("input")
    outputs = instance.description.references("output")
    arguments = {
        "setup_experiment": (0.0,),
        "set_time": (0.5,),
        "set_continuous_states": (np.ones(2),),
        "set_float64": (inputs, np.zeros(2)),
        "get_float64": (outputs,),
        "get_directional_derivative": (outputs, inputs, np.ones(2)),
        "set_fmu_state": (GeneratedInstance.of(model()).get_fmu_state(),),
        "free_fmu_state": (None,),
    }
    return getattr(instance, call)(*arguments.get(call, ()))


def test_every_call_is_allowed_in_its_modes_only(subtests):
    """The error names the call, the mode, and where it is allowed."""
    for mode, call in product(PATHS, ALLOWED):
        with subtests.test(mode=mode, call=call):
            instance = instance_in(mode)
            if mode in ALLOWED[call]:
                perform(instance, call)
            else:
                modes = ", ".join(ALLOWED[call])
                message = f"plant: {call} is not allowed in mode '{mode}'; allowed in: {modes}"
                with pytest.raises(FmuError, match=message):
                    perform(instance, call)


def test_directional_derivatives_are_the_matrices():
    """d(y, x')/d(u, x) is (D, C; B, A), exactly, also through an output that is a state."""
    instance = instance_in("continuous")
    names = instance.description
    unknowns = names.references_of(["y", "x_a[0]", "x_a[1]", "x_b", "der(x_a[0])", "der(x_a[1])"])
    for knowns, expected in (
        (("u", "delta"), np.vstack([D, B])),
        (("x_a[0]", "x_a[1]"), np.vstack([C, A])),
    ):
        for column, name in enumerate(knowns):
            derivatives = instance.get_directional_derivative(
                unknowns, names.references_of([name]), np.ones(1)
            )
            assert np.array_equal(derivatives, expected[:, column])
    with pytest.raises(FmuError, match="knowns of a directional derivative are inputs and states"):
        instance.get_directional_derivative(unknowns, names.references_of(["y"]), np.ones(1))
    with pytest.raises(FmuError, match="are outputs, derivatives and states, not inputs"):
        instance.get_directional_derivative(
            names.references_of(["u"]), names.references_of(["u"]), np.ones(1)
        )


def test_an_initial_state_that_depends_on_inputs_follows_them_in_initialization_mode():
    """x(0) = X0 + Xu u: calculated, not settable, and d y/d u is C Xu + D there."""
    Xu = np.array([[2.0, 0.0], [0.0, 0.0]])
    instance = GeneratedInstance.of(
        LinearModel(INTERFACE, ("x_a[0]", "x_a[1]"), A, B, C, D, np.array([1.0, -1.0]), Xu), "plant"
    )
    inputs = instance.description.references("input")
    outputs = instance.description.references("output")
    assert [instance.description[name].initial for name in ("x_a[0]", "x_a[1]")] == [
        "calculated",
        "exact",
    ]
    instance.setup_experiment(0.0)
    instance.enter_initialization_mode()
    instance.set_float64(inputs, np.array([3.0, 0.0]))
    assert np.array_equal(instance.get_float64(outputs), [4.0, 7.0, -1.0, -10.0])
    assert np.array_equal(
        instance.get_directional_derivative(outputs, inputs, np.array([1.0, 0.0])),
        C @ Xu[:, 0] + D[:, 0],
    )
    with pytest.raises(FmuError, match=r"'x_a\[0\]' cannot be set in mode 'initialization'"):
        instance.set_float64(instance.description.references_of(["x_a[0]"]), np.ones(1))
    instance.exit_initialization_mode()
    instance.enter_continuous_time_mode()
    instance.set_float64(inputs, np.zeros(2))
    assert np.array_equal(instance.get_continuous_states(), [7.0, -1.0])


def test_a_state_needs_a_name_of_its_own():
    """A state named like an output that is something else is refused."""
    other = LinearModel(INTERFACE, ("y", "x_a[1]"), A, B, C, D, np.zeros(2), np.zeros((2, 2)))
    with pytest.raises(FmuError, match="'y' is a state and another variable"):
        GeneratedInstance.of(other)


def test_a_run_without_an_fmu_does_not_import_fmpy():
    """Importing fmpy costs a tenth of a second."""
    code = (
        "import sys\n"
        "from cosim.fmi.component import ModelExchange\n"
        "from cosim.fmi.generated import GeneratedInstance\n"
        "from tests.fmi.plant import model, run\n"
        "run(ModelExchange(GeneratedInstance.of(model())), step=0.1)\n"
        "print('fmpy' in sys.modules)"
    )
    root = Path(__file__).parents[2]
    completed = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root
    )
    assert completed.stdout == "False\n"


class Eventful:
    """A generated instance that asks for something at events."""

    def __init__(self, *states, step=(False, False)):
        self._instance = GeneratedInstance.of(model(), "eventful")
        self._states = list(states)
        self._step = step
        self.updates = 0
        able = replace(self._instance.description.capabilities["me"], completed_step=True)
        self.description = replace(self._instance.description, capabilities={"me": able})

    def __getattr__(self, name):
        return getattr(self._instance, name)

    def update_discrete_states(self):
        self.updates += 1
        state = self._states.pop(0) if len(self._states) > 1 else self._states[0]
        return DiscreteStates(
            **{"need_update": False, "terminate": False, "next_event_time": None} | state
        )

    def completed_integrator_step(self):
        return self._step


def test_events_that_instances_ask_for():
    """Step events are iterated until no update is needed.

    Events without end and the wish to end stop the run with the reason.
    """
    instance = Eventful({"need_update": True}, {}, step=(True, False))
    assert np.array_equal(
        run(ModelExchange(instance, "rk4"), step=0.1),
        run(ModelExchange(GeneratedInstance.of(model()), "rk4"), step=0.1),
    )
    assert instance.updates == 2 + 20
    for time in (-0.5, float("nan")):
        with pytest.raises(
            Stopped,
            match="eventful: time event: expected a time >= 0.0 s .the current time., "
            f"got {time} s",
        ):
            run(ModelExchange(Eventful({"next_event_time": time}), "rk4"), step=0.1)
    with pytest.raises(
        Stopped,
        match=r"1000 events at t = 0.5 s do not advance time: time event$",
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
