"""Which input elements have a zero-order hold, by the variability of their sources."""

import pytest

from cosim.blocks.arithmetic import sum_of, switch
from cosim.blocks.source import constant, step
from cosim.core.connections import Connection
from cosim.core.graph import Graph
from cosim.core.signals import Interface, Signal
from tests.core.parts import Scripted, half_through, integrator, times


def test_an_element_that_nothing_drives_has_no_zero_order_hold():
    """It is constant: a hold there would cost a component its second order for nothing."""
    part = Scripted([0.0] * 3)
    part.interface = Interface((Signal("u", 2, connection="optional"),), (Signal("y"),), {"y": ()})
    graph = Graph({"a": integrator(), "part": part}, {"a.u": "a.y", "part.u[1]": "a.y"})
    assert graph.held["part"].tolist() == [False, False]


def test_the_masks_of_a_graph_are_read_only():
    """They are handed to components, and go to the log as they are."""
    graph = Graph({"s": constant([1.0]), "a": integrator()}, {"a.u": "s.y"})
    with pytest.raises(ValueError, match="read-only"):
        graph.held["a"][0] = True


def test_what_is_continuous_by_construction_is_known_behind_static_parts_too():
    """Of a component in Python nothing is known; behind a gain, in a sum, in a vector neither."""
    parts = {
        "own": integrator(),
        "user": Scripted([0.0] * 3),
        "gain": times(2.0),
        "sum": sum_of([1.0, 1.0]),
        "s": constant([1.0]),
        "reader": Scripted([0.0] * 3),
    }
    parts["reader"].interface = Interface((Signal("u", 5), Signal("v")), (Signal("y"),))
    connections = {
        "own.u": "s.y",
        "gain.u": "user.y",
        "sum.u1": "own.y",
        "sum.u2": "user.y",
        "reader.u": ["own.y", "user.y", "gain.y", "sum.y", "s.y"],
        "reader.v": Connection(["own.y", "user.y"], gain=[[1.0, 1.0]]),
    }
    graph = Graph(parts, connections)
    assert graph.latest["reader"].tolist() == [False, True, True, True, False, True]
    for means in ({"means": ["reader"]}, {"coupling": "newton"}, {"input_interpolation": "linear"}):
        assert not Graph(parts, connections, **means).latest["reader"].any()


def test_direct_feedthrough_passes_a_jump_on():
    """A switch jumps itself. Of a discrete signal left limits are known, so its mean is a value."""
    parts = {
        "user": Scripted([0.0] * 3),
        "own": integrator(),
        "held": step(time=1.0),
        "switch": switch(),
        "through_user": half_through(),
        "through_switch": half_through(),
        "through_own": half_through(),
        "through_held": half_through(),
        "filtered": integrator(),
        "reader": Scripted([0.0] * 3),
    }
    parts["reader"].interface = Interface((Signal("u", 6),), (Signal("y"),))
    connections = {
        "own.u": "held.y",
        "switch.u1": "own.y",
        "switch.u2": "own.y",
        "switch.control": "own.y",
        "through_user.u": "user.y",
        "through_switch.u": "switch.y",
        "through_own.u": "own.y",
        "through_held.u": "held.y",
        "filtered.u": "through_user.y",
    }
    read = ["switch", "through_user", "through_switch", "through_own", "through_held", "filtered"]
    connections["reader.u"] = [f"{name}.y" for name in read]
    latest = Graph(parts, connections).latest["reader"].tolist()
    assert dict(zip(read, latest, strict=True)) == {
        "switch": True,
        "through_user": True,
        "through_switch": True,
        "through_own": False,
        "through_held": False,
        "filtered": False,
    }
