"""The gain of loops of co-simulation FMUs that show nothing but their ports."""

import numpy as np
import pytest

from cosim.core.clock import Clock
from cosim.core.gain.loop_gain import LinearizedLoops
from cosim.core.graph import Graph
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.fmi.component import load
from cosim.fmi.options import FmuOptions
from tests.core.graphs import pair_map
from tests.fmi import small
from tests.fmi.small import ONE, TWO

CONNECTIONS = {"one.u": "two.y", "two.u": "one.y"}
SIGNALS = ("one.x", "one.y", "two.x", "two.y")
H = 0.01


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    return small.compiled(tmp_path_factory.mktemp("small"))


@pytest.fixture
def pair(fmu, tmp_path):
    """Return a function that makes a graph of the pair, with initial states."""
    fmus = []

    def opened(*can, **values):
        path = small.able(fmu, tmp_path / f"{len(fmus)}.fmu", "state", "steps", *can, **values)
        fmus.append(load(path, FmuOptions(start=values)))
        return fmus[-1].component

    def graph(can, coupling, x=(1.0, 1.0), **options):
        one = opened(*can, **{**ONE, "x": x[0]})
        two = opened(*can, **{**TWO, "x": x[1]})
        return Graph({"one": one, "two": two}, CONNECTIONS, coupling=coupling, **options)

    yield graph
    for fmu_opened in fmus:
        fmu_opened.close()


def gain_of(graph, h=H):
    clock = Clock(100 * h, h)
    graph.prepare(clock.step_ns)
    row = np.zeros(graph.layout.width)
    graph.initialize(0.0, row)
    (gain,) = LinearizedLoops.of(graph, clock, row).gains()
    return gain


def rows_of(graph):
    memory = Memory()
    run(graph, Clock(20 * H, H), memory)
    return memory[SIGNALS]


@pytest.mark.fast(
    "can0-gauss-seidel-None", "can3-jacobi-linear", "can8-newton-linear", "can6-newton-zero-order"
)
@pytest.mark.parametrize(
    ("can", "coupling", "interpolation"),
    [
        ((), "gauss-seidel", None),
        (("D",), "gauss-seidel", None),
        ((), "gauss-seidel", "linear"),
        ((), "jacobi", "linear"),
        (("slopes", "D"), "jacobi", "linear"),
        ((), "newton", "linear"),
        ((), "newton", "zero-order"),
        (("slopes",), "gauss-seidel", "linear"),
        (("slopes",), "newton", "linear"),
        (("D",), "newton", "linear"),
        (("D",), "jacobi", "zero-order"),
    ],
)
def test_the_gain_of_two_fmus_is_that_of_runs(pair, can, coupling, interpolation):
    """Whatever becomes of their inputs in a step: by what rows do to the rows behind them."""
    options = {"input_interpolation": interpolation}
    gain = gain_of(pair(can, coupling, **options))
    assert not gain.unknown
    before = []
    after = []
    for x in ((1.0, 1.0), (1.0, -3.0), (0.2, 1.0)):
        rows = rows_of(pair(can, coupling, x, **options))
        scale = np.abs(rows[:-1]).max(axis=1, keepdims=True)
        before.append(rows[:-1] / scale)
        after.append(rows[1:] / scale)
    X = np.vstack(before).T
    U, values, _ = np.linalg.svd(X, full_matrices=False)
    U = U[:, values > 1e-8 * values[0]]
    reduced = U.T @ np.vstack(after).T @ np.linalg.pinv(U.T @ X, rcond=1e-10)
    radius = np.abs(np.linalg.eigvals(reduced)).max()
    # 1e-7 is what responses to pulses of 1e-3 know of poles
    assert gain.rho == pytest.approx(radius, rel=1e-6)
    assert gain.rate == pytest.approx(-2.40687, abs=1e-4)


@pytest.mark.parametrize("can", [(), ("D",), ("slopes", "D")])
def test_jacobi_is_refused_where_it_is_unstable_whatever_the_fmus_can(pair, can):
    """Its gain is that of the map by hand: 1.97 at 10 ms; below 0.61 ms it is stable."""
    for h, verdict in ((0.01, "refused"), (6e-4, "fine")):
        gain = gain_of(pair(can, "jacobi"), h)
        # 1e-7 is what responses to pulses of 1e-3 know of poles
        assert gain.rho == pytest.approx(np.abs(np.linalg.eigvals(pair_map(h))).max(), rel=1e-6)
        assert gain.verdict == verdict


def test_to_be_tried_leaves_no_trace(pair):
    """The run that follows begins as one without, and has its bits."""
    tried = pair((), "gauss-seidel")
    gain_of(tried)
    assert rows_of(tried).tobytes() == rows_of(pair((), "gauss-seidel")).tobytes()


def test_fmus_that_cannot_go_back_and_show_nothing_have_no_gain(fmu, tmp_path):
    """They are named."""
    with (
        load(small.able(fmu, tmp_path / "1.fmu", "steps", **ONE), FmuOptions(start=ONE)) as one,
        load(small.able(fmu, tmp_path / "2.fmu", "steps", **TWO), FmuOptions(start=TWO)) as two,
    ):
        parts = {"one": one.component, "two": two.component}
        assert gain_of(Graph(parts, CONNECTIONS)).unknown == ("one", "two")
