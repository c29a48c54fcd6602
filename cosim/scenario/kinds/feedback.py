"""Closed loops: which inputs of an observer depend on its y, and so carry the noise of y."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from cosim.arrays import Mask
from cosim.core.graph import Graph
from cosim.core.port import Port


def inputs_in_feedback(graph: Graph, observer: str) -> Mask:
    """Return which elements of an observer's u depend on what drives its y, shape (n_u,)."""
    u = graph.layout[observer].interface.input_columns().get("u", slice(0, 0))
    in_feedback = np.zeros(u.stop - u.start, np.bool_)
    sources_of_y: set[str] = set()
    for to, connection in graph.connections.items():
        if (to.component, to.signal) == (observer, "y"):
            sources_of_y |= {source.component for source in connection.sources}
    dependent = _driven_by(graph, sources_of_y)
    for to, connection in graph.connections.items():
        if (to.component, to.signal) != (observer, "u"):
            continue
        if any(source.component in dependent for source in connection.sources):
            in_feedback[graph.ports.input(Port(observer, "u", to.element)).elements] = True
    return in_feedback


def _driven_by(graph: Graph, components: set[str]) -> set[str]:
    """Return the components that others drive, directly or through more of them."""
    drives: defaultdict[str, set[str]] = defaultdict(set)
    for to, connection in graph.connections.items():
        for source in connection.sources:
            drives[source.component].add(to.component)
    driven: set[str] = set()
    front = set(components)
    while front:
        front = set().union(*(drives[name] for name in front)) - driven
        driven |= front
    return driven
