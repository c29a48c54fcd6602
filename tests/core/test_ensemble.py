"""Members of an ensemble have the bits of their own runs."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest

from cosim.blocks.dynamics import lag
from cosim.core.clock import Clock
from cosim.core.contracts import Stopped
from cosim.core.ensemble import run_members
from cosim.core.graph import Graph
from cosim.core.linear import Linear
from cosim.core.master import run
from cosim.core.recorders import Memory
from cosim.errors import GraphError, NonFiniteError, UsageError
from tests.core.parts import Scripted, integrator, through

CLOCK = Clock(0.5, 1e-3)
CONNECTIONS = {"a.u": "b.y", "b.u": "a.y", "c.u": "b.x"}


def components(**others):
    return {"a": integrator(), "b": through(), "c": integrator(2.0, 0.5), **others}


def plant(initial):
    return Linear(lag(time_constant=0.5, initial=initial))


def own_rows(**others):
    """Return all rows of a run with some components of its own."""
    memory = Memory()
    graph = Graph(components(**others), CONNECTIONS)
    run(graph, CLOCK, memory)
    return np.hstack([memory.rows(name) for name in graph.components])


def test_members_have_the_bits_of_their_own_runs():
    """The last row, and sums over the rows behind the first, added up in the order of time."""
    graph = Graph(components(), CONNECTIONS)
    own = dict(graph.components)
    initials = [0.1, 7.0, -3.0]
    members = [{"a": plant(initial)} for initial in initials] + [{}]
    found = run_members(graph, CLOCK, members)
    needed = [own_rows(a=plant(initial)) for initial in initials] + [own_rows()]
    for number, rows in enumerate(needed):
        sums = np.zeros(rows.shape[1])
        squares = np.zeros(rows.shape[1])
        for row in rows[1:]:
            sums += row
            squares += row * row
        assert found.last[number].tobytes() == rows[-1].tobytes()
        assert found.sums[number].tobytes() == sums.tobytes()
        assert found.squares[number].tobytes() == squares.tobytes()
        assert (found.counts[number] == 500).all()
    assert found.steps.tolist() == [500] * 4
    assert found.errors == (None,) * 4
    assert graph.components == own


def test_values_that_are_missing_are_not_counted():
    """An optional output has no value (NaN) in two of four rows."""
    script = Scripted([0.0, np.nan, 2.0, np.nan, 4.0], optional=True)
    graph = Graph({"s": script}, {})
    found = run_members(graph, Clock(0.004, 1e-3), [{}])
    assert found.counts.tolist() == [[2.0]]
    assert found.sums.tolist() == [[6.0]]
    assert found.squares.tolist() == [[20.0]]


def test_a_member_that_ends_before_its_end_ends_alone():
    """With its error, its completed steps, and the rows up to there."""
    stop = Stopped(np.empty((0, 1)), "enough", failed=False)
    scripts = [[0.0, 1.0, np.inf, 3.0], [0.0, 1.0, 2.0, stop], [0.0, 1.0, 2.0, 3.0]]
    graph = Graph({"s": Scripted([0.0] * 4), "x": integrator()}, {"x.u": "s.y"})
    members = [{"s": Scripted(values)} for values in scripts]
    found = run_members(graph, Clock(0.003, 1e-3), members)
    assert isinstance(found.errors[0], NonFiniteError)
    assert str(found.errors[0]).startswith("'s.y' became inf at t = 0.002 s")
    assert isinstance(found.errors[1], Stopped)
    assert found.errors[2] is None
    assert found.steps.tolist() == [1, 2, 3]
    assert found.last[:, 0].tolist() == [1.0, 2.0, 3.0]
    assert found.sums[:, 0].tolist() == [1.0, 3.0, 6.0]


class Tenfold(Scripted):
    """Ten times the script in numpy, which may overflow."""

    def advance(self, t, h, u):
        return super().advance(t, h, u) * 10.0


@pytest.mark.parametrize(
    "end", [Stopped(np.empty((0, 1)), "enough", failed=False), 1e308], ids=["stop", "overflow"]
)
def test_the_error_is_that_of_a_run_of_its_own(end):
    """Where the first component ends with a block, the next one is asked for no step."""
    for k in (1, 5, 6):
        script = [*np.zeros(k), end, *np.zeros(500)]

        def graph(values=script):
            return Graph(
                {"a": Tenfold(values), "b": Scripted(np.ones(501), inputs=1)}, {"b.u0": "a.y"}
            )

        [error] = run_members(graph(), CLOCK, [{}]).errors
        memory = Memory()
        with suppress(NonFiniteError):
            run(graph(), CLOCK, memory)
        assert str(error) == memory.reason
        assert isinstance(error, Stopped if isinstance(end, Stopped) else NonFiniteError)


def test_members_that_do_not_fit_are_refused():
    """A name that is not there, and another interface; the graph keeps its components."""
    graph = Graph(components(), CONNECTIONS)
    own = dict(graph.components)
    with pytest.raises(GraphError, match=r"there is no component 'aa'; did you mean 'a'"):
        run_members(graph, CLOCK, [{"aa": integrator()}])
    with pytest.raises(GraphError, match=r"component 'a':.*interface"):
        run_members(graph, CLOCK, [{"a": through()}])
    assert graph.components == own
    with pytest.raises(UsageError, match=r"clock: .*got"):
        run_members(graph, 1.0, [])
