"""Cycles of directed graphs, and orders that depend on names alone, never on the order of a file.

``dependencies`` maps each node to the nodes that it depends on directly.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from graphlib import CycleError, TopologicalSorter
from heapq import heapify, heappop, heappush
from typing import TypeVar

from cosim.core.port import Port

Node = TypeVar("Node", str, Port)


def reached_from(
    nodes: Iterable[Node], followers: Mapping[Node, Iterable[Node]]
) -> dict[Node, None]:
    """Return nodes and those that they reach by their followers."""
    found = dict.fromkeys(nodes)
    waiting = list(found)
    for node in waiting:  # grows on the way
        for other in followers.get(node, ()):
            if other not in found:
                found[other] = None
                waiting.append(other)
    return found


def find_cycle(dependencies: Mapping[Node, Collection[Node]]) -> list[Node]:
    """Return a cycle, closed, in the direction of the signals; empty: there is none."""
    try:
        TopologicalSorter(dependencies).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def strongly_connected(dependencies: Mapping[Node, Collection[Node]]) -> dict[Node, Node]:
    """Return for every node the one that stands for its strongly connected component.

    R. Tarjan, Depth-first search and linear graph algorithms, SIAM J. Comput. 1 (1972), without
    recursion: ``path`` is the stack of calls, ``least`` the low link. One function, as the
    algorithm is one loop.
    """
    number: dict[Node, int] = {}
    least: dict[Node, int] = {}
    representative: dict[Node, Node] = {}
    open_nodes: list[Node] = []
    for root in dependencies:
        if root in number:
            continue
        path = [(root, iter(dependencies[root]))]
        while path:
            node, edges = path[-1]
            if node not in number:
                number[node] = least[node] = len(number)
                open_nodes.append(node)
            for other in edges:
                if other not in number:
                    path.append((other, iter(dependencies[other])))
                    break
                if other not in representative:
                    least[node] = min(least[node], number[other])
            else:
                path.pop()
                if path:
                    caller = path[-1][0]
                    least[caller] = min(least[caller], least[node])
                while least[node] == number[node] and node not in representative:
                    representative[open_nodes.pop()] = node
    return representative


def groups_in_order(dependencies: Mapping[Node, Collection[Node]]) -> list[list[Node]]:
    """Return the strongly connected components, each sorted, after those that they depend on.

    Where that leaves a choice, the one that holds the first name comes first.
    """
    group_of = strongly_connected(dependencies)
    groups: dict[Node, list[Node]] = {}
    for node in sorted(dependencies):
        groups.setdefault(group_of[node], []).append(node)
    needed: dict[Node, set[Node]] = {group: set() for group in groups}
    for node, others in dependencies.items():
        needed[group_of[node]].update(group_of[other] for other in others)
    for group, others in needed.items():
        others.discard(group)
    first_names = {group: nodes[0] for group, nodes in groups.items()}
    return [groups[group] for group in _in_order(needed, first_names)]


def _in_order(needed: Mapping[Node, Collection[Node]], names: Mapping[Node, Node]) -> list[Node]:
    """Return groups after those that they need; of several, the one with the first name first."""
    followers: dict[Node, list[Node]] = {group: [] for group in needed}
    for group, others in needed.items():
        for other in others:
            followers[other].append(group)
    missing = {group: len(others) for group, others in needed.items()}
    ready = [(names[group], group) for group, count in missing.items() if count == 0]
    heapify(ready)
    order = []
    while ready:
        _, group = heappop(ready)
        order.append(group)
        for follower in followers[group]:
            missing[follower] -= 1
            if missing[follower] == 0:
                heappush(ready, (names[follower], follower))
    return order
