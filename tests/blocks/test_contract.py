"""Every block keeps the contract; the check names the law that a component breaks."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from cosim.arrays import NAN
from cosim.blocks.arithmetic import gain, limit, sum_of, switch
from cosim.blocks.averages import Windowed
from cosim.blocks.derived import derived
from cosim.blocks.dynamics import Delay, integrator, lag
from cosim.blocks.limited_integrator import LimitedIntegrator
from cosim.blocks.linear_source import LinearSource
from cosim.blocks.look_up import LookUpTable
from cosim.blocks.measurement import SensorParameters
from cosim.blocks.modulated_source import ModulatedSource, Modulation
from cosim.blocks.observer import averaged_observer, consistent_observer, observer_model
from cosim.blocks.pid import Pid, PidParameters
from cosim.blocks.plant import descriptor_model
from cosim.blocks.product import Product
from cosim.blocks.regressor import Regressor
from cosim.blocks.replay import Replay
from cosim.blocks.sampled import Decimated, Sampled
from cosim.blocks.sensor import Sensor
from cosim.blocks.source import Expression, Noise, Table, chirp, constant, ramp, sine, step
from cosim.blocks.static import Static
from cosim.blocks.transfer import transfer_function
from cosim.core.clock import Clock
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.core.signals import Interface, Signal
from cosim.native.blocks.functions import LinearResponse
from cosim.native.numerics.expression import compile_expression
from cosim.native.numerics.linear import delay_step
from cosim.testing import check_component, check_rollback
from cosim.theory.disturbances.regression import expand
from cosim.theory.observers.observer import design
from cosim.theory.plants.descriptor import reduce
from cosim.theory.reconstruction.filters import SavitzkyGolay
from tests.blocks.parts import H, discrete, identifier, through
from tests.theory.academic import academic, ordinary

GAINS = {"L": (4.0, 0.0), "filter_rate": 1e3}


@cache
def academic_model():
    return descriptor_model(academic(), [1.0, -1.0])


def plant():
    return Linear(academic_model())


@cache
def model_without_algebraic_states():
    system = ordinary(A=[[0.0, 1.0], [-2.0, -3.0]], B=[[1.0], [0.0]], C=[[1.0, 0.0]])
    with_input = replace(system, Bu=np.array([[0.0], [1.0]]), Du=np.zeros((1, 1)))
    return descriptor_model(with_input, [1.0, -1.0])


@cache
def reduced_academic():
    return reduce(academic())


@cache
def designed(reduced, **options):
    return design(reduced, **options)


def observer(**options):
    reduced = reduced_academic()
    return Linear(observer_model(reduced, designed(reduced, **GAINS), **options))


@cache
def with_feedthrough_to_x_b():
    """Return a system whose algebraic state depends on the disturbance."""
    system = academic()
    return reduce(replace(system, Bd=np.array([[1.0], [0.0], [0.5]]), C=np.array([[2, 0, 0]])))


def consistent(reduced, **options):
    averaged = averaged_observer(reduced, designed(reduced, poles=(-4.0,)), **options)
    return consistent_observer(averaged, reduced, 1e3)


def windowed(reduced, half_width=3, **options):
    averaged = averaged_observer(reduced, designed(reduced, poles=(-4.0,)), **options)
    return Windowed(averaged, SavitzkyGolay(half_width, 2, H).weights)


@cache
def without_inputs_and_algebraic_states():
    return reduce(ordinary(A=[[0.0, 1.0], [-2.0, -3.0]], B=[[1.0], [0.0]], C=[[1.0, 0.0]]))


def observer_without_inputs_and_algebraic_states():
    reduced = without_inputs_and_algebraic_states()
    return Linear(observer_model(reduced, designed(reduced, **GAINS)))


def regressor(steps=(2, 4, 6), lag=0.0):
    alphas = [
        compile_expression("1.35 + 0.25*sin(1.7*t)"),
        compile_expression("1.1 + 0.2*cos(2.3*t)"),
    ]
    delays = [n * H for n in steps]
    return Regressor(expand((1, 1)), alphas=alphas, steps=steps, delays=delays, lag=lag)


def linear_source():
    """Return a source of three elements, the response of a damped oscillation in two of them."""
    program = compile_expression("1 + t")
    G = np.array([[0.0, 1.0], [-9e4, -20.0]])
    terms = [
        LinearResponse(factor=program, G=G, c=np.eye(2)[i], beta=np.ones(2), element=2 * i)
        for i in range(2)
    ]
    texts = ["sin(300*t)", "t", "0"]
    return LinearSource([compile_expression(text) for text in texts], terms)


def limited_pid(**more):
    """Return a PID controller whose output is at its limits much of the time."""
    times = {"integral_time": 0.01, "derivative_time": 0.005, "lower": -1.0, "upper": 0.5}
    return Pid(PidParameters(2.0, **times, **more))


def sampled_pid():
    parameters = PidParameters(
        -2.0, integral_time=0.05, derivative_time=0.01, lower=-1.0, upper=0.5, initial_integral=0.1
    )
    return Pid(parameters, period=4 * H)


def sensor(**parameters):
    every = {"bias": 0.5, "lower": -1.0, "upper": [1.5, 2.0], "resolution": 0.25, "seed": 3}
    return Sensor(SensorParameters(noise=0.1, dropout=0.3, **every, **parameters), size=2)


@cache
def recording():
    memory = Memory()
    run(
        Graph(
            {
                "u": sine(amplitude=1.0, rate=900.0, phase=0.1, offset=0.0),
                "lag": Linear(lag(time_constant=0.01)),
            },
            {"lag.u": "u.y"},
        ),
        Clock(0.03, H),
        memory,
    )
    return memory


COMPONENTS = {
    "constant": lambda: constant([1.5, -2.0]),
    "step": lambda: step(time=0.01, before=1.0, after=-2.0),
    "ramp": lambda: ramp(slope=2.0, start_time=0.01, offset=-1.0),
    "sine": lambda: sine(amplitude=2.0, rate=300.0, phase=0.4, offset=1.0),
    "chirp": lambda: chirp(amplitude=2.0, rate=300.0, sweep=1e4, offset=1.0),
    "derived": lambda: derived(["a.x*t - max(b.y, c.z)", "exp(-a.x**2) + step(b.y)"]),
    "derived, discrete": lambda: derived(["sign(a.x)", "2"], variability="discrete"),
    "expression": lambda: Expression(["t**2", "exp(-t)*cos(500*t)"], variability="discrete"),
    "table": lambda: Table(
        np.linspace(0.0, 0.03, 12), np.random.default_rng(1).standard_normal((12, 2))
    ),
    "extrapolated table": lambda: Table(
        np.array([-0.002, 0.011]), np.array([[1.0], [-0.3]]), extrapolate=True
    ),
    "held table": lambda: Table(
        np.linspace(0.0, 0.03, 12), np.random.default_rng(1).standard_normal((12, 2)), hold=True
    ),
    "noise": lambda: Noise(deviation=2.0, seed=3, size=2),
    "linear source": linear_source,
    "modulated source": lambda: ModulatedSource(
        linear_source(), [Modulation(0, 1), Modulation(0, 0)], (Signal("alpha", 2),)
    ),
    "sum": lambda: sum_of([1.0, -2.0, 0.5], size=2),
    "gain": lambda: gain(np.array([[1.0, 2.0], [0.0, -1.0], [3.0, 0.5]])),
    "limit": lambda: limit(lower=-0.5, upper=0.7, size=2),
    "product": lambda: Product("*/*", size=2),
    "reciprocal": lambda: Product("/"),
    "switch": lambda: switch(threshold=0.3, size=2),
    "held switch": lambda: switch(discrete=True),
    "look-up table": lambda: LookUpTable(
        [np.array([-1.0, 0.5, 2.0])], np.array([3.0, -1.0, 4.0]), extrapolation="linear"
    ),
    "look-up table of two inputs": lambda: LookUpTable(
        [np.array([-1.0, 0.5, 2.0]), np.array([0.0, 1.0])],
        np.array([[3.0, -1.0], [0.0, 4.0], [2.0, 2.5]]),
        extrapolation="hold",
    ),
    "lag": lambda: Linear(lag(time_constant=0.01, size=2)),
    "lag from an initial value": lambda: Linear(lag(time_constant=0.01, initial=2.0)),
    "delay": lambda: Delay(3, size=2),
    "delay of one step": lambda: Delay(1),
    "delay from a given start": lambda: Delay(4, initial=7.0),
    "sensor without effects": lambda: Sensor(SensorParameters(), size=2),
    "sensor with time stamps": lambda: Sensor(
        SensorParameters(jitter=0.4, delay=1.7, seed=1), samples=True, stamped=True
    ),
    "sensor with its samples": lambda: Sensor(
        SensorParameters(noise=0.1, dropout=0.3, period=3, seed=1), size=2, samples=True
    ),
    "sensor": lambda: sensor(jitter=0.4),
    "sensor with a delay": lambda: sensor(delay=3.0),
    "sensor with a delay of parts of steps": lambda: sensor(delay=0.6, jitter=0.3),
    "sensor that does not feed through": lambda: sensor(delay=1.1, jitter=0.1),
    "sensor with a period": lambda: sensor(delay=0.8, jitter=1.7, period=4),
    "integrator": lambda: Linear(integrator(initial=1.0, size=2)),
    "limited integrator": lambda: LimitedIntegrator(lower=-1e-3, upper=2e-3, size=2),
    "integrator with a lower limit": lambda: LimitedIntegrator(lower=0.0),
    "transfer function": lambda: Linear(transfer_function([3.0, 1.0, 2.0], [1.0, 70.0, 100.0])),
    "steady transfer function": lambda: Linear(transfer_function([1.0], [1e-4, 2.0], steady=True)),
    "controller": through,
    "discrete state space": discrete,
    "sampled discrete state space": lambda: Sampled(discrete(), 3, hold=True),
    "P controller": lambda: Pid(PidParameters(2.0, initial_integral=1.0)),
    "PI controller": lambda: Pid(PidParameters(2.0, integral_time=0.1)),
    "limited PID controller": limited_pid,
    "I-PD controller": lambda: limited_pid(setpoint_weight=0.0, tracking_time=1e-4),
    "PID controller with all weights": lambda: limited_pid(derivative_setpoint_weight=0.5),
    "PID step of a period": sampled_pid,
    "sampled PID controller": lambda: Sampled(sampled_pid(), 4, hold=True),
    "plant": plant,
    "plant without algebraic states": lambda: Linear(model_without_algebraic_states()),
    "observer": observer,
    "observer of a constant input": lambda: observer(constant=True),
    "observer without u and x_b": observer_without_inputs_and_algebraic_states,
    "consistent observer": lambda: consistent(reduced_academic()),
    "consistent observer of all of x_b": lambda: consistent(with_feedthrough_to_x_b()),
    "consistent observer of a constant input": lambda: consistent(
        reduced_academic(), constant=True
    ),
    "windowed observer": lambda: windowed(reduced_academic()),
    "windowed observer of all of x_b": lambda: windowed(with_feedthrough_to_x_b(), 2),
    "windowed observer of a constant input": lambda: windowed(reduced_academic(), constant=True),
    "regressor": regressor,
    "regressor without delay": lambda: regressor((0, 3, 5)),
    "regressor of a delta that lags": lambda: regressor(lag=0.2),
    "least squares": identifier,
    "least squares with a prior": lambda: identifier(P0=1e3),
    "replay": lambda: Replay(recording(), "lag"),
    "replay as a source": lambda: Replay(recording(), "lag", inputs=False),
    "sampled plant": lambda: Sampled(plant(), 4),
    "sampled with feedthrough": lambda: Sampled(through(), 3),
    "sampled at every step": lambda: Sampled(through(), 1),
    "sampled from an offset on": lambda: Sampled(through(), 3, hold=True, offset=2),
    "interpolated from an offset on": lambda: Sampled(through(), 4, offset=3),
    "sampled source": lambda: Sampled(sine(amplitude=2.0, rate=300.0, phase=0.4, offset=1.0), 4),
    "decimated least squares": lambda: Decimated(identifier(), 4),
    "decimated with feedthrough": lambda: Decimated(through(), 4),
}
ROLLBACK = [
    "lag",
    "lag from an initial value",
    "delay",
    "delay of one step",
    "sensor",
    "sensor with a delay of parts of steps",
    "sensor with a period",
    "controller",
    "integrator",
    "limited integrator",
    "transfer function",
    "discrete state space",
    "sampled with feedthrough",
    "sampled from an offset on",
    "interpolated from an offset on",
    "limited PID controller",
    "PID step of a period",
    "plant",
    "observer",
    "consistent observer",
    "windowed observer",
    "regressor",
    "regressor without delay",
    "least squares",
    "least squares with a prior",
]


@pytest.mark.parametrize("name", COMPONENTS)
def test_every_block_keeps_the_contract(name):
    """Every block keeps the contract, bit for bit.

    The checks are blocks of any size, outputs that change nothing, an initialization that forgets,
    declared feedthrough, and extrapolated inputs.
    """
    check_component(COMPONENTS[name], h=H)


@pytest.mark.parametrize("name", ROLLBACK)
def test_every_block_that_declares_rollback_goes_back(name):
    """Restoring what was saved is the identity."""
    check_rollback(COMPONENTS[name], h=H)


class Broken:
    """``y = [u0, n]``, n the number of steps; every law can be broken by name."""

    def __init__(self, fault="", *, optional=False, feedthrough=None):
        outputs = (Signal("y", optional=optional), Signal("n"))
        dependencies = {"y": ("u",)} if feedthrough is None else feedthrough
        self.interface = Interface((Signal("u"),), outputs, dependencies, prepares=True)
        self.fault = fault
        self.steps = 0
        self.made = Broken.count = getattr(Broken, "count", 0) + 1

    def prepare(self, h, held, recorded):
        design = {"gain": np.ones(1)} if self.fault == "computes again" else dict(recorded)
        design = design or {"gain": np.ones(1)}
        self.gain = design["gain"][0]
        if self.fault == "ignores its design" and recorded:
            self.gain *= 2.0
        return design

    def initialize(self, t, u):
        if self.fault != "remembers":
            self.steps = 0
        if self.fault == "writes initially":
            u[:] = 9.0
        self.row = self._row(u)
        first = self.outputs(t, u)
        if self.fault == "starts as nan":
            first[0] = np.nan
        return None if self.fault == "starts as nothing" else first

    def outputs(self, t, u):
        if self.fault == "outputs count":
            self.steps += 1
        if self.fault == "stale outputs":
            return self.row.copy()
        return self._row(u)

    def advance(self, t, h, u):
        rows = np.empty((len(t) - 1, 2))
        for k in range(len(rows)):
            self.steps += 1
            if self.fault == "sums the end":
                self.steps += u[k + 1, 0]
            rows[k] = self._row(u[k + 1])
        if self.fault == "block size":
            rows[:, 1] += len(rows)
            self.steps += len(rows)
        if self.fault == "writes":
            u[0] = 0.0
        if self.fault == "writes times":
            t[0] = 5.0
        if self.fault == "keeps its inputs" and hasattr(self, "kept"):
            rows[0, 1] += self.kept[0, 0] == 1e3
        self.kept = u
        self.row = rows[-1].copy()
        return (
            rows[:, 0]
            if self.fault == "shape"
            else rows.astype(np.float32)
            if self.fault == "type"
            else rows.tolist()
            if self.fault == "list"
            else rows
        )

    def _row(self, u):
        value = {
            "nan": np.nan,
            "negative nan": -np.array(NAN),
            "infinite": np.inf,
            "by chance": self.made,
        }.get(self.fault, u[0])
        return np.array([self.gain * value, self.steps])


FAULTS = {
    "ignores its design": "a component takes its recorded design: 'y' at t = 0.0 s",
    "computes again": r"prepare returns its recorded design: .gain. was computed again",
    "remembers": "initialize forgets the past, and an earlier initialize with other inputs: 'n'",
    "outputs count": "outputs",
    "stale outputs": r"outputs (ignores|gives)",
    "sums the end": r"the state ignores a held input|advance ignores a held input",
    "block size": "blocks of 1 give the bits of one block: 'n' at t = 0.001 s: .*31.0.* 2.0",
    "writes": "advance does not write to its arguments",
    "keeps its inputs": "arguments and results of earlier calls are no part of the state",
    "writes times": "advance does not write to its arguments",
    "writes initially": "initialize does not write to its arguments",
    "starts as nothing": r"initialize returned NoneType.*a float64 array",
    "list": r"advance returned list.*a float64 array of shape \(30, 2\)",
    "shape": r"advance returned an array of float64, shape \(30,\)",
    "type": r"advance returned an array of float32, shape \(30, 2\).*array of shape \(30, 2\)",
    "nan": "a value is finite, or cosim.arrays.NAN in an optional output: "
    "'y' at t = 0.0 s: expected a finite value, got nan",
    "infinite": "a value is finite, or cosim.arrays.NAN in an optional output: "
    "'y' at t = 0.0 s: expected a finite value, got inf",
    "starts as nan": "a value of initialize is finite, or .*: 'y' at t = 0.0 s: .*got nan",
    "by chance": "a second component repeats the run: 'y'",
}


def test_a_sound_component_passes():
    """The one below without a fault keeps every law."""
    check_component(Broken)


@pytest.mark.parametrize("fault", [fault for fault in FAULTS if fault != "stale outputs"])
def test_a_broken_law_is_named(fault):
    """One sentence with the law, the signal, the time and the values."""
    with pytest.raises(AssertionError, match=FAULTS[fault]):
        check_component(lambda: Broken(fault))


def test_stale_outputs_are_noticed_where_inputs_feed_through():
    """Outputs that do not follow a corrected input cannot repair a loop."""
    with pytest.raises(
        AssertionError, match="the state ignores a held input at the end of the step: 'y'"
    ):
        check_component(lambda: Broken("stale outputs"))


def test_another_nan_is_refused_where_none_may_be():
    """There is one NaN, so that equal runs have equal bits."""
    check_component(lambda: Broken("nan", optional=True))
    with pytest.raises(
        AssertionError, match=r"a value is finite, or cosim.arrays.NAN in an optional output: 'y'"
    ):
        check_component(lambda: Broken("negative nan", optional=True))


def test_an_undeclared_feedthrough_is_named():
    """The order of a loop rests on what is declared."""
    with pytest.raises(
        AssertionError,
        match=r"outputs ignores 'u', which is not declared to feed through: "
        r"'y' at t = 0.0 s: expected 0.12\d+, got 1.14",
    ):
        check_component(lambda: Broken(feedthrough={}))


def test_an_undeclared_initial_dependency_is_named():
    """Initialization is ordered by what is declared; a lag that follows its input declares it."""
    check_component(lambda: Linear(lag(time_constant=1.0)))
    silent = lag(time_constant=1.0)
    silent = replace(silent, interface=replace(silent.interface, initial={}))
    law = r"initialize ignores 'u', which is not declared to count there: 'y' at t = 0.0 s: .*1.14"
    with pytest.raises(AssertionError, match=law):
        check_component(lambda: Linear(silent))
    check_component(
        lambda: Linear(replace(silent, interface=replace(silent.interface, initial={"y": None})))
    )


def test_inputs_of_the_wrong_shape_are_refused():
    """The inputs given are those of the component."""
    with pytest.raises(AssertionError, match=r"inputs: .* \(steps \+ 1, 1\) .* got \(5, 3\)"):
        check_component(lambda: Delay(1), inputs=np.zeros((5, 3)))


def test_integers_and_booleans_get_values_of_their_type():
    """Random inputs respect the kind of the signal."""
    seen = []

    def look(u):
        seen.append(u.copy())
        return u[:, :1] + u[:, 1:]

    interface = Interface(
        (Signal("i", type="integer"), Signal("b", type="boolean")), (Signal("y"),), {"y": None}
    )
    check_component(lambda: Static(interface, look))
    given = np.vstack(seen)
    given = given[(given != 1e3).all(axis=1)]
    assert np.array_equal(given[:, 0], np.round(given[:, 0]))
    assert set(given[:, 1]) == {0.0, 1.0}


class Forgetful(Delay):
    """A delay whose saved line is the line itself."""

    def save(self):
        return self._step.memory


class Keeping(Delay):
    """A delay that keeps its states and hands out their numbers."""

    def initialize(self, t, u):
        self.kept = []
        return super().initialize(t, u)

    def save(self):
        self.kept.append(super().save())
        return len(self.kept) - 1

    def restore(self, state):
        if state < len(self.kept):
            super().restore(self.kept[state])


def test_a_state_that_rests_on_its_component_is_noticed():
    """It can be pickled, so it is taken for one that another component goes on from."""
    with pytest.raises(AssertionError, match="another component goes on from a pickled state: 'y'"):
        check_rollback(lambda: Keeping(3))


def test_a_state_that_is_not_copied_is_noticed():
    """``restore(save())`` is the identity, also after more steps."""
    with pytest.raises(AssertionError, match="restore goes back to the outputs at save: 'y'"):
        check_rollback(lambda: Forgetful(3))


class Compiled(Delay):
    """A delay whose compiled step has a fault."""

    def __init__(self, fault):
        super().__init__(3)
        self.fault = fault

    def native(self):
        if self.fault == "other bits":
            return delay_step(2, 1)
        if self.fault == "always declines":
            return LookUpTable([np.array([8.0, 9.0])], np.zeros(2)).native()
        own = delay_step(3, 1)
        own.memory[:] = self._step.memory
        return own


@pytest.mark.parametrize(
    ("fault", "law"),
    [
        ("other bits", "the compiled step: has the bits of advance: 'y' at t = 0.0 s: .*got 0.0"),
        ("always declines", "the compiled step: it declined all of 30 steps"),
        ("state of its own", "the compiled step: restore goes back to the outputs at save: 'y' at"),
    ],
)
def test_a_compiled_step_that_is_not_the_component_is_named(fault, law):
    """Compiled step and methods share one state, and give the same bits."""
    check_component(lambda: Delay(3))
    with pytest.raises(AssertionError, match=law):
        check_component(lambda: Compiled(fault))


def test_declared_methods_are_there_and_prepare_is_declared():
    """A method that is declared but missing is named, and a prepare that nobody would call."""

    class Undeclared(Broken):
        def __init__(self):
            super().__init__()
            self.interface = replace(self.interface, prepares=False)

        prepare = Broken.prepare

    class Missing(Broken):
        def __init__(self):
            super().__init__()
            self.interface = replace(self.interface, rollback=True)

    class WithoutStep(Broken):
        def __init__(self):
            super().__init__()
            self.interface = replace(self.interface, native=True)

    with pytest.raises(AssertionError, match="declares native, but there is no native"):
        check_component(WithoutStep)
    with pytest.raises(AssertionError, match="there is prepare, but it is not called"):
        check_component(Undeclared)
    with pytest.raises(AssertionError, match="declares rollback, but there is no save"):
        check_component(Missing)
