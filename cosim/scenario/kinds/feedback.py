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
    drives: defaultdict[str, set[str]] = defaultdict(set)
    front: set[str] = set()
    for to, connection in graph.connections.items():
        sources = {source.component for source in connection.sources}
        if (to.component, to.signal) == (observer, "y"):
            front |= sources
        for source in sources:
            drives[source].add(to.component)
    dependent: set[str] = set()
    while front:
        front = set().union(*(drives[name] for name in front)) - dependent
        dependent |= front
    for to, connection in graph.connections.items():
        follows_y = any(source.component in dependent for source in connection.sources)
        if follows_y and (to.component, to.signal) == (observer, "u"):
            in_feedback[graph.ports.input(Port(observer, "u", to.element)).elements] = True
    return in_feedback
