"""Sum, gain, product, limit, switch, lag, delay, controller, replay against closed forms."""

import numpy as np
import pytest

from cosim.blocks import dynamics
from cosim.blocks.arithmetic import gain, limit, sum_of, switch
from cosim.blocks.dynamics import Delay, lag
from cosim.blocks.product import Product
from cosim.blocks.replay import Replay
from cosim.blocks.source import sine
from cosim.blocks.state_space import controller
from cosim.core.clock import Clock
from cosim.core.contracts import Stopped
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.errors import GraphError, LogError, RunError, UsageError
from tests.blocks.stepping import drive, times

RANDOM = np.random.default_rng(11).standard_normal((60, 2))


def test_sum_adds_with_signs():
    """The sum is y = u1 - u2 on vectors, exactly."""
    computed = drive(sum_of([1.0, -1.0]), RANDOM)
    assert (computed[:, 0] == RANDOM[:, 0] - RANDOM[:, 1]).all()
    with pytest.raises(UsageError, match=r"sum:.*one sign.*input"):
        sum_of([])


def test_gain_multiplies_in_a_fixed_order():
    """The same bits as a plain loop from left to right."""
    K = np.array([[0.1, 0.7], [3.0, -0.2], [0.0, 1.0]])
    expected = [[0.0 + u[0] * row[0] + u[1] * row[1] for row in K] for u in RANDOM]
    assert (drive(gain(K), RANDOM) == np.array(expected)).all()


def test_limit_cuts_off():
    """Values inside pass unchanged."""
    computed = drive(limit(lower=-0.5, upper=0.25, size=2), RANDOM)
    assert (computed == np.minimum(np.maximum(RANDOM, -0.5), 0.25)).all()
    with pytest.raises(UsageError, match=r"limit:.*lower < upper.*lower = 1\.0 and upper = 1\.0"):
        limit(lower=1.0, upper=1.0)


def test_the_step_response_of_a_lag_is_exact():
    """After a step of u that is held, y = 1 - exp(-t/T) at every communication point."""
    u = np.ones((201, 1))
    t = times(200)
    computed = drive(Linear(lag(time_constant=0.05, initial=0.0)), u, held=True)[:, 0]
    # the factor exp(-h/T) carries an error of one unit in the last place, 1.1e-16, which 200 steps
    # add up
    np.testing.assert_allclose(computed, -np.expm1(-t / 0.05), rtol=0, atol=200 * 1.2e-16)


def test_a_lag_follows_a_linearly_interpolated_ramp_exactly():
    """For u = t: y = t - T (1 - exp(-t/T)): no error of the step size.

    A zero-order hold of the input lags by half a step more.
    """
    t = times(200)
    exact = t - 0.05 * -np.expm1(-t / 0.05)
    linear, zero_order = (
        drive(Linear(lag(time_constant=0.05)), t[:, None], held=held)[:, 0]
        for held in (False, True)
    )
    np.testing.assert_allclose(linear, exact, rtol=0, atol=200 * 1.2e-16)
    assert zero_order[-1] - exact[-1] == pytest.approx(
        -0.5e-3, rel=0.03
    )  # 1 - exp(-4) of it has decayed; next term h/(12 T)


def test_a_lag_starts_without_a_transient_by_default():
    """By default y(0) = u(0) and stays there; else y(0) = `initial`, whatever the input."""
    u = np.full((30, 2), 3.0)
    # Ad + B0 + B1 = 1 up to rounding, added up over 30 steps of a value of 3
    np.testing.assert_allclose(
        drive(Linear(lag(time_constant=0.01, size=2)), u), u, rtol=0, atol=30 * 3 * 2.3e-16
    )
    assert (drive(Linear(lag(time_constant=0.01, initial=-1.0, size=2)), u)[0] == -1.0).all()
    with pytest.raises(UsageError, match=r"lag: time_constant:.*a time.*0\.0 s"):
        lag(time_constant=0.0)


@pytest.mark.parametrize("n", [1, 2, 7, 59, 80])
def test_a_delay_gives_the_input_n_steps_later(n):
    """y(t) = u(t - n h), before that the first input, or what is given."""
    k = np.maximum(np.arange(len(RANDOM)) - n, 0)
    assert (drive(Delay(n, size=2), RANDOM) == RANDOM[k]).all()
    given = np.where((np.arange(len(RANDOM)) < n)[:, None], 9.0, RANDOM[k])
    assert (drive(Delay(n, initial=9.0, size=2), RANDOM) == given).all()


def test_a_delay_of_nothing_is_refused():
    """It would feed through."""
    with pytest.raises(UsageError, match=r"delay:.*at least 1 communication step.*0"):
        Delay(0)


def test_a_controller_shows_its_state_and_declares_its_feedthrough():
    """Take x' = -2 x + u with y = 3 x + 0.5 u, u held at 1: x = (1 - exp(-2 t)) / 2."""
    model = controller(A=np.array([[-2.0]]), B=np.eye(1), C=np.array([[3.0]]), D=np.array([[0.5]]))
    assert model.interface.feeds("y") == ("u",)
    assert model.interface.feeds("x") == ()
    computed = drive(Linear(model), np.ones((101, 1)), held=True)
    x = -np.expm1(-2.0 * times(100)) / 2.0
    np.testing.assert_allclose(
        computed, np.column_stack([3.0 * x + 0.5, x]), rtol=0, atol=100 * 3 * 1.2e-16
    )
    assert controller(A=np.eye(1), B=np.eye(1), C=np.eye(1)).interface.feeds("y") == ()


@pytest.mark.parametrize(
    ("name", "shape"), [("B", (3, 1)), ("C", (1, 3)), ("D", (2, 1)), ("x0", (3,))]
)
def test_a_controller_of_the_wrong_shape_is_refused(name, shape):
    """The matrix is named, with both shapes."""
    matrices = {
        "A": np.eye(2),
        "B": np.ones((2, 1)),
        "C": np.ones((1, 2)),
        "D": np.zeros((1, 1)),
        "x0": np.zeros(2),
    }
    text = f"controller: {name}: expected shape {matrices[name].shape}, got {shape}"
    with pytest.raises(UsageError) as error:
        controller(**{**matrices, name: np.zeros(shape)})
    assert str(error.value) == text


@pytest.fixture(scope="module")
def recording():
    components = {
        "u": sine(amplitude=1.0, rate=90.0, phase=0.1, offset=0.0),
        "lag": Linear(lag(time_constant=0.01)),
    }
    memory = Memory()
    run(Graph(components, {"lag.u": "u.y"}), Clock(0.03, 1e-3), memory)
    return memory


def test_a_replay_gives_the_recorded_rows_whatever_its_inputs_are(recording):
    """Bit for bit, with the recorded inputs shown or hidden."""
    for inputs in (True, False):
        replay = Replay(recording, "lag", inputs=inputs)
        u = np.full((31, replay.interface.n_u), 5.0)
        assert (drive(replay, u)[:, 0] == recording["lag.y"]).all()


def test_a_replay_stops_where_the_recording_ends(recording):
    """With every row up to there."""
    with pytest.raises(Stopped, match=r"the recording ends at 0.03 s") as stop:
        drive(Replay(recording, "u"), np.zeros((36, 0)))
    assert (stop.value.outputs[:, 0] == recording["u.y"][1:]).all()


def test_a_replay_refuses_what_was_not_recorded(recording):
    """A component that is not there, a time before the recording."""
    with pytest.raises(LogError, match=r"the run has no component 'lab'; did you mean 'lag'\?"):
        Replay(recording, "lab")
    with pytest.raises(GraphError, match=r"the recording begins at 0\.0 s.*-1\.0 s"):
        Replay(recording, "u").initialize(-1.0, np.zeros(0))


def test_a_delay_line_counts_the_values_of_all_elements(monkeypatch):
    """As many as the limit fit, one more does not, whichever of the two makes it long."""
    monkeypatch.setattr(dynamics, "LARGEST_MEMORY", 12)
    for steps, size in ((12, 1), (3, 4), (4, 3), (1, 12)):
        assert Delay(steps, size=size).interface.outputs[0].size == size
    for steps, size in ((13, 1), (3, 5), (5, 3), (1, 13)):
        with pytest.raises(UsageError, match=f"{steps} communication steps of {size} values"):
            Delay(steps, size=size)


@pytest.mark.parametrize(
    ("operations", "function"),
    [
        ("**", lambda a, b: a * b),
        ("*/", lambda a, b: a / b),
        ("/*", lambda a, b: 1.0 / a * b),
        ("//", lambda a, b: 1.0 / a / b),
    ],
)
def test_a_product_multiplies_and_divides_from_left_to_right(operations, function):
    """On vectors, with the bits of plain Python."""
    u = np.hstack([RANDOM, RANDOM[::-1]])
    y = drive(Product(operations, size=2), u)
    assert y.tolist() == [[function(a, c), function(b, d)] for a, b, c, d in u.tolist()]


def test_a_division_by_zero_stops_the_run_with_the_rows_before_it():
    """The input is named; it may be 0 where y is multiplied by it."""
    u = np.array([[0.0, 1.0], [1.0, 2.0], [1.0, 0.0]])
    text = r"product:.*u2 is 0"
    with pytest.raises(Stopped, match=text) as stop:
        drive(Product("*/"), u)
    assert stop.value.outputs.tolist() == [[0.5]]
    with pytest.raises(RunError, match=r"u1\[1\] is 0"):
        Product("/", size=2).initialize(0.0, np.array([1.0, 0.0]))
    with pytest.raises(UsageError, match=r"operations: .*, got '\*-'"):
        Product("*-")
    with pytest.raises(UsageError, match=r"operations: .*, got ''"):
        Product("")


def test_a_switch_takes_the_first_input_at_the_threshold():
    """And above it; else the second one, as vectors."""
    control = np.array([0.5, 0.4999, -1.0, 1.0])
    u = np.column_stack([np.ones((4, 2)), np.full((4, 2), 2.0), control])
    y = drive(switch(size=2), u)
    assert y.tolist() == [[1.0, 1.0], [2.0, 2.0], [2.0, 2.0], [1.0, 1.0]]
    assert drive(switch(threshold=-1.0), u[:, [0, 2, 4]])[2] == 1.0
