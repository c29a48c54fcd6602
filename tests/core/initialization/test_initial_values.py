"""Initial values: every input has what drives it, whatever the order of the components.

Algebraic loops are solved, or refused by name.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.arrays import NAN
from cosim.blocks.arithmetic import sum_of
from cosim.blocks.dynamics import Delay, lag
from cosim.blocks.source import constant
from cosim.core.clock import Clock
from cosim.core.connections import Connection
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.core.signals import Interface, Signal
from cosim.errors import GraphError
from cosim.units import BaseUnit
from tests.core.parts import Starter, integrator, through, times


def start(components, connections):
    """Return the first row by signal."""
    found = Graph(components, connections)
    found.prepare(10**7)
    row = np.full(found.layout.width, 7.0)
    found.initialize(0.0, row)
    values = {}
    for channel in found.layout.channels:
        for name, columns in channel.signal_columns.items():
            values[f"{channel.name}.{name}"] = row[columns]
    return values


def test_a_chain_starts_in_its_order():
    """Every component is initialized once, with the outputs that drive it.

    An output that does not depend on an input is known before it.
    """
    parts = {
        "c": Starter(lambda u: 2.0 * u),
        "b": Starter(lambda u: u + 1.0),
        "a": constant([3.0]),
        "free": integrator(start=0.5),
    }
    found = start(parts, {"b.u": "a.y", "c.u": "b.y", "free.u": "c.y"})
    assert {name: value.item() for name, value in found.items()} == {
        "a.y": 3.0,
        "b.u": 3.0,
        "b.y": 4.0,
        "c.u": 4.0,
        "c.y": 8.0,
        "free.u": 8.0,
        "free.y": 0.5,
    }
    assert parts["c"].calls == [[4.0]]
    assert parts["b"].calls == [[3.0]]


class LateStarter(Starter):
    """A component that shows 1 more once it has started; it records when it was asked for that."""

    def outputs(self, t, u):
        self.calls.append("outputs")
        return self.y + 1.0


def test_row_0_shows_what_components_start_with():
    """Behind one that starts with other outputs than initially all are initialized with these.

    No one is asked for them before its inputs are final: an FMU can be initialized again before
    that without a reset.
    """
    parts = {
        "c": LateStarter(lambda u: 2.0 * u),
        "b": LateStarter(lambda u: 10.0 * u),
        "a": constant([3.0]),
    }
    found = start(parts, {"b.u": "a.y", "c.u": "b.y"})
    assert {name: value.item() for name, value in found.items()} == {
        "a.y": 3.0,
        "b.u": 3.0,
        "b.y": 31.0,
        "c.u": 31.0,
        "c.y": 63.0,
    }
    assert parts["b"].calls == [[3.0], "outputs"]
    assert parts["c"].calls == [[30.0], [31.0], "outputs"]


def test_a_loop_is_solved_for_what_its_components_start_with():
    """y = u / 2 + 1 in both: 2, and everything was initialized with the recorded inputs.

    Initially y = u / 2, so 0.
    """
    parts = {name: LateStarter(lambda u: 0.5 * u) for name in ("a", "b")}
    found = start(parts, {"a.u": "b.y", "b.u": "a.y"})
    for value in found.values():
        assert value.item() == pytest.approx(2.0, abs=1e-12)
    for name, part in parts.items():
        initializations = [call for call in part.calls if call != "outputs"]
        assert initializations[-1] == found[f"{name}.u"].tolist()
        assert part.calls[-1] == "outputs"


def test_an_input_that_nothing_drives_yet_has_its_start_value():
    """v = 2 w is taken before u is known; then the component starts again with u, and v stays."""
    interface = Interface(
        (Signal("u", start=(5.0,)), Signal("w")),
        (Signal("v"), Signal("y")),
        {"v": (), "y": ()},
        {"v": ("w",), "y": ("u",)},
    )
    part = Starter(lambda u, w: np.concatenate([2.0 * w, u]), ("u", "w"))
    part.interface = interface
    found = start(
        {"part": part, "k": times(10.0), "one": constant([1.0])},
        {"part.u": "k.y", "part.w": "one.y", "k.u": "part.v"},
    )
    assert part.calls == [[5.0, 1.0], [20.0, 1.0]]
    assert (found["part.v"].item(), found["part.y"].item()) == (2.0, 20.0)


def test_start_values_have_the_size_of_their_signal():
    """One number an element."""
    with pytest.raises(GraphError, match=r"signal 'u':.*3 start values, or none.*2"):
        Signal("u", 3, start=(1.0, 2.0))


def network():
    """Return a chain with branches and a loop of lags that start at their inputs.

    The loop is x = 1 - 3 z, z = 2 x.
    """
    components = {
        "one": constant([1.0]),
        "s": sum_of([1.0, -1.0]),
        "x": Linear(lag(time_constant=1.0)),
        "z": Linear(lag(time_constant=2.0)),
        "behind": sum_of([1.0, 1.0]),
        "last": Delay(2),
    }
    connections = {
        "s.u1": "one.y",
        "s.u2": Connection("z.y", 3.0),
        "x.u": "s.y",
        "z.u": Connection("x.y", 2.0),
        "behind.u1": "x.y",
        "behind.u2": "z.y",
        "last.u": "behind.y",
    }
    return components, connections


@pytest.mark.slow
@settings(max_examples=40)
@given(st.permutations(["one", "s", "x", "z", "behind", "last"]))
def test_the_order_of_the_components_does_not_matter(names):
    """Equal bits, the loop included."""
    components, connections = network()
    expected = start(components, connections)
    found = start({name: components[name] for name in names}, connections)
    assert all(found[name].tobytes() == value.tobytes() for name, value in expected.items())


def test_a_loop_has_its_closed_form():
    """x = 1 - 3 (2 x) = 1/7, though sweeps would diverge; what stands behind follows it."""
    found = start(*network())
    for name, value in {
        "x.y": 1 / 7,
        "z.y": 2 / 7,
        "s.u2": 6 / 7,
        "behind.y": 3 / 7,
        "last.y": 3 / 7,
    }.items():
        assert abs(found[name].item() - value) <= 1e-13, name


@given(st.integers(1, 4), st.integers(0, 2**32 - 1))
def test_linear_loops_of_vectors_have_their_closed_form(n, seed):
    """x = A z + a, z = B x + b: x = (1 - A B)^-1 (A b + a) to 1e-13 of its condition."""
    random = np.random.default_rng(seed)
    A, B, a, b = (random.uniform(-2.0, 2.0, shape) for shape in ((n, n), (n, n), n, n))
    if np.linalg.cond(np.eye(n) - A @ B) > 50.0:
        return
    parts = {"x": Starter(lambda u: A @ u + a, size=n), "z": Starter(lambda u: B @ u + b, size=n)}
    found = start(parts, {"x.u": "z.y", "z.u": "x.y"})
    exact = np.linalg.solve(np.eye(n) - A @ B, A @ b + a)
    assert np.abs(found["x.y"] - exact).max() <= 1e-13 * max(1.0, np.abs(exact).max()) * 50.0
    assert found["x.u"].tobytes() == found["z.y"].tobytes()
    assert found["z.u"].tobytes() == found["x.y"].tobytes()
    assert parts["x"].calls[-1] == found["x.u"].tolist()
    assert parts["z"].calls[-1] == found["z.u"].tolist()


def test_a_nonlinear_loop_starts_from_the_start_values():
    """x = z^2, z = x / 4 + 1 / 2, so x^2 - 12 x + 4 = 0 with the roots 6 +- 4 sqrt(2).

    The start values decide which of the two is found.
    """
    for value, root in ((10.0, 6.0 + 4.0 * np.sqrt(2.0)), (0.3, 6.0 - 4.0 * np.sqrt(2.0))):
        parts = {
            "x": Starter(lambda u: u * u, start=(value,)),
            "z": Starter(lambda u: u / 4.0 + 0.5, start=(value,)),
        }
        found = start(parts, {"x.u": "z.y", "z.u": "x.y"})
        assert abs(found["x.y"].item() - root) <= 1e-13 * root


def test_two_loops_are_solved_one_after_the_other():
    """x = -2 x + 3 gives 1; behind it y = x - 4 y gives 1/5.

    No component behind a loop is initialized with a trial value of it.
    """
    seen = Starter(lambda u: u)
    parts = {
        "x": Starter(lambda u: -2.0 * u + 3.0),
        "y": Starter(lambda a, u: a - 4.0 * u, ("a", "u")),
        "seen": seen,
    }
    found = start(parts, {"x.u": "x.y", "y.a": "x.y", "y.u": "y.y", "seen.u": "x.y"})
    assert abs(found["x.y"].item() - 1.0) <= 1e-15
    assert abs(found["y.y"].item() - 0.2) <= 1e-15
    assert seen.calls == [[found["x.y"].item()]]


def test_dependencies_that_are_unknown_are_tried():
    """A chain that looks like a loop has its exact bits; a loop in truth is solved: x = 1 - 3 x."""
    one = constant([1.0])
    chain = Starter(lambda a, b: 3.0 * a, ("a", "b"), declared=None)
    found = start(
        {"one": one, "p": chain, "k": times(0.1)}, {"p.a": "one.y", "p.b": "k.y", "k.u": "p.y"}
    )
    assert (found["p.y"].item(), found["k.y"].item()) == (3.0, 3.0 * 0.1)
    closed = Starter(lambda a, b: a - 3.0 * b, ("a", "b"), declared=None)
    found = start(
        {"one": one, "p": closed, "k": times(1.0)}, {"p.a": "one.y", "p.b": "k.y", "k.u": "p.y"}
    )
    assert abs(found["p.y"].item() - 0.25) <= 1e-15


def refused(components, connections, text):
    with pytest.raises(GraphError) as error:
        start(components, connections)
    assert text in str(error.value)
    way = "; give a component among them an initial value of its own: a lag or a delay with initial"
    if "depend on each other" in text:
        assert str(error.value).endswith(f"{way}, or other start values")


def test_a_loop_without_a_solution_is_named():
    """The message has every port of the loop, the residual and what is needed.

    It has them too where several loops share a port. The residual is that of the input on which an
    output depends at initialization alone, where another one of the loop feeds through.
    """
    chase = {"lag": Linear(lag(time_constant=1.0))}
    name = (
        "no initial values for lag.u -> lag.y -> lag.u, which form an algebraic loop at "
        "initialization: "
    )
    refused(
        chase,
        {"lag.u": Connection("lag.y", 1.0, 1.0)},
        name + "1 - w' is singular, with a residual of 1 at 'lag.u', expected at most 1",
    )
    refused(
        chase,
        {"lag.u": "lag.y"},
        name + "1 - w' is singular, so that other values solve it as well; give",
    )
    refused(
        chase | {"direct": times(1.0)},
        {"lag.u": Connection("direct.y", 1.0, 1.0), "direct.u": "lag.y"},
        "with a residual of 1 at 'lag.u', expected at most 1",
    )
    square = {"x": Starter(lambda u: u * u + 1.0, start=(0.2,))}
    name = (
        "no initial values for x.u -> x.y -> x.u, which form an algebraic loop at "
        "initialization: Newton's method ended with a residual"
    )
    refused(square, {"x.u": "x.y"}, name)
    refused(square, {"x.u": "x.y"}, " at 'x.u', expected at most ")
    both = {
        "x": Starter(lambda a, b: np.exp(a) + np.exp(b) + 1.0, ("a", "b")),
        "k": Starter(lambda u: u),
    }
    refused(
        both,
        {"x.a": "x.y", "x.b": "k.y", "k.u": "x.y"},
        "no initial values for k.u, k.y, x.a, x.b, x.y, which form an algebraic loop",
    )


def test_missing_values_are_kept_only_where_they_may_be_missing():
    """NaN solves no equation between numbers; in optional signals it means "no value yet"."""
    interface = Interface(
        (Signal("u", optional=True),), (Signal("y", optional=True),), {"y": ()}, {"y": ("u",)}
    )
    part = Starter(lambda u: np.full(1, NAN))
    part.interface = interface
    assert np.isnan(start({"p": part}, {"p.u": "p.y"})["p.u"])
    root = {"x": Starter(lambda u: np.sqrt(u - 1.0) - 3.0)}
    refused(root, {"x.u": Connection("x.y", 1.0, 0.5)}, "Newton's method ended with a residual of ")
    refused(
        root,
        {"x.u": Connection("x.y", 1.0, 0.5)},
        "expected at most 0, as 'x.y' became nan; give",
    )


def test_discrete_signals_in_a_loop_converge_or_are_refused():
    """n = n // 2 + 21 climbs to 41 in halves and stays; b = not b never does."""
    whole = Starter(lambda u: u // 2.0 + 21.0, signal_type="integer")
    found = start({"n": whole}, {"n.u": "n.y"})
    assert (found["n.u"].item(), found["n.y"].item()) == (41.0, 41.0)
    flip = Starter(lambda u: 1.0 - u, signal_type="boolean")
    text = (
        "b.u -> b.y -> b.u, which form an algebraic loop at initialization: with a discrete "
        "signal among them, and still changing "
    )
    refused({"b": flip}, {"b.u": "b.y"}, f"{text}after 102 sweeps")


def test_a_dependency_that_is_not_declared_is_followed_or_refused():
    """Initialization is repeated beyond what is declared until nothing changes.

    A chain converges, a loop that grows does not.
    """
    quiet = Starter(lambda u: 2.0 * u, declared=())
    found = start(
        {"p": quiet, "k": times(0.5), "one": constant([4.0])}, {"p.u": "one.y", "k.u": "p.y"}
    )
    assert (found["p.y"].item(), found["k.y"].item()) == (8.0, 4.0)
    liar = Starter(lambda u: 2.0 * u + 1.0, declared=())
    text = (
        "initial values do not converge: k.u, k.y, p.u, p.y still change after 4 rounds; an "
        "output there depends at initialization on "
    )
    refused({"p": liar, "k": times(1.0)}, {"p.u": "k.y", "k.u": "p.y"}, text)


def test_every_input_is_what_its_connection_gives():
    """A matrix, an offset and units act at initialization too, also inside a loop.

    The recorded initial values satisfy all equations.
    """
    celsius = BaseUnit((0, 0, 0, 0, 1, 0, 0, 0), 1.0, 273.15)
    kelvin = BaseUnit((0, 0, 0, 0, 1, 0, 0, 0))
    part = Starter(lambda u: 0.5 * u + np.array([1.0, 2.0]), size=2)
    part.interface = Interface(
        (Signal("u", 2, "K", base=kelvin),),
        (Signal("y", 2, "theirs", base=celsius),),
        {"y": ()},
        {"y": ("u",)},
    )
    found = start({"p": part}, {"p.u": Connection("p.y", ((0.0, 1.0), (1.0, 0.0)), 3.0)})
    assert np.array_equal(found["p.u"], ((found["p.y"][::-1] + 3.0) + 273.15) - 0.0)
    # u1 = u2 / 2 + 2 + 3 + 273.15, u2 = u1 / 2 + 1 + 3 + 273.15
    exact = np.linalg.solve([[1.0, -0.5], [-0.5, 1.0]], [278.15, 277.15])
    assert np.abs(found["p.u"] - exact).max() <= 1e-13 * 600.0


def test_a_run_goes_on_from_the_start_that_was_found():
    """Lags that start at their inputs: without a transient as long as nothing changes."""
    memory = Memory()
    run(Graph(*network()), Clock(0.1, 0.01), memory)
    for name in ("x.y", "z.y"):
        assert np.abs(memory[name] - memory[name][0]).max() <= 1e-15


def test_our_models_say_what_their_start_depends_on():
    """A lag without ``initial`` starts at its input, a lag with ``initial`` does not.

    Mere feedthrough adds no dependency at initialization.
    """
    assert lag(time_constant=1.0).interface.feeds_initially("y") == ("u",)
    assert lag(time_constant=1.0, initial=0.0).interface.feeds_initially("y") == ()
    assert Delay(2).interface.feeds_initially("y") == ("u",)
    assert Delay(2, initial=0.0).interface.feeds_initially("y") == ()
    assert through(0.5).interface.initial == {}
