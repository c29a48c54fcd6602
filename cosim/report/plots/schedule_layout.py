"""Where the components of a schedule stand in a picture: layers from left to right.

A stage stands right of all that drive it. The components of a loop stand below each other, in the
order in which they advance. A connection over several layers has a place of its own in each layer
between, so that it runs beside what stands there. Within a layer, what is connected to the layer
before comes in the order that this has there, by the mean place of its sources (barycenters;
K. Sugiyama, S. Tagawa, M. Toda, IEEE Trans. SMC 11, 1981), and in a second sweep by that of what
it drives.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from cosim.report.schedule import GraphSchedule, ScheduledStage

SWEEPS: Final = 4
LANE: Final = 0.3  # height of the place of a connection, of that of a component
LOOP: Final = 0.35  # more height of a loop, for its frame and its title


@dataclass(frozen=True, slots=True)
class SchedulePlaces:
    """Places of components and the ways of connections.

    Parameters
    ----------
    places : mapping of component name to (layer, height from the top)
        Heights are counted in components.
    frames : mapping of stage number to (layer, top, bottom)
        Of the loops.
    lanes : mapping of (source, target) to sequence of (layer, height)
        What a connection between stages passes on its way, by the components at its ends.
    layers : int
    height : float
    """

    places: Mapping[str, tuple[int, float]]
    frames: Mapping[int, tuple[int, float, float]]
    lanes: Mapping[tuple[str, str], Sequence[tuple[int, float]]]
    layers: int
    height: float


@dataclass(slots=True)
class _Block:
    """What stands in a layer: a stage, or the place of a connection."""

    layer: int
    height: float
    stage: ScheduledStage | None = None
    before: list[_Block] = field(default_factory=list)
    behind: list[_Block] = field(default_factory=list)
    top: float = 0.0

    @property
    def middle(self) -> float:
        return self.top + 0.5 * self.height


def layout_of(schedule: GraphSchedule) -> SchedulePlaces:
    """Place the components of a schedule."""
    stage_of: dict[str, int] = {}
    for stage in schedule.stages:
        stage_of.update(dict.fromkeys(stage.members, stage.number))
    pairs: dict[tuple[str, str], None] = {}
    for connection in schedule.connections:
        source, target = connection.components
        if stage_of[source] != stage_of[target]:
            pairs[source, target] = None
    layers = _layers(schedule, [(stage_of[a], stage_of[b]) for a, b in pairs])
    blocks = {
        stage.number: _Block(layers[stage.number], _height(stage), stage)
        for stage in schedule.stages
    }
    columns: list[list[_Block]] = [[] for _ in range(max(layers.values(), default=0) + 1)]
    for block in blocks.values():
        columns[block.layer].append(block)
    lanes = {}
    for source, target in pairs:
        lanes[source, target] = _connect(
            blocks[stage_of[source]], blocks[stage_of[target]], columns
        )
    height = _arrange(columns)
    ways = {
        pair: [(block.layer, block.middle) for block in passed] for pair, passed in lanes.items()
    }
    places: dict[str, tuple[int, float]] = {}
    frames: dict[int, tuple[int, float, float]] = {}
    for number, block in blocks.items():
        assert block.stage is not None
        top = block.top + (LOOP if block.stage.coupling else 0.0)
        for row, name in enumerate(block.stage.members):
            places[name] = (block.layer, top + row + 0.5)
        if block.stage.coupling:
            frames[number] = (block.layer, block.top, block.top + block.height)
    return SchedulePlaces(places, frames, ways, len(columns), height)


def _height(stage: ScheduledStage) -> float:
    return len(stage.members) + (LOOP if stage.coupling else 0.0)


def _layers(schedule: GraphSchedule, edges: Sequence[tuple[int, int]]) -> dict[int, int]:
    """Return the layer of every stage; sources stand just before what they drive."""
    layers: dict[int, int] = {}
    for stage in schedule.stages:  # in topological order
        before = [layers[source] for source, target in edges if target == stage.number]
        layers[stage.number] = max(before, default=-1) + 1
    for stage in reversed(schedule.stages):
        is_source = not any(target == stage.number for _, target in edges)
        behind = [layers[target] for source, target in edges if source == stage.number]
        if is_source and behind:
            layers[stage.number] = min(behind) - 1
    return layers


def _connect(source: _Block, target: _Block, columns: Sequence[list[_Block]]) -> list[_Block]:
    """Add places of a connection to the layers between; return them."""
    passed = []
    last = source
    for layer in range(source.layer + 1, target.layer):
        lane = _Block(layer, LANE)
        columns[layer].append(lane)
        passed.append(lane)
        last.behind.append(lane)
        lane.before.append(last)
        last = lane
    last.behind.append(target)
    target.before.append(last)
    return passed


def _arrange(columns: Sequence[list[_Block]]) -> float:
    """Order the blocks of every layer, and give them their heights; return that of the whole."""
    _stack(columns)
    for sweep in range(SWEEPS):
        forward = sweep % 2 == 0
        for column in columns if forward else reversed(columns):
            ranks = {id(block): _rank(block, forward=forward) for block in column}
            column.sort(key=lambda block, ranks=ranks: ranks[id(block)])  # type: ignore[misc]
            _stack(columns)
    return max((sum(block.height for block in column) for column in columns), default=0.0)


def _rank(block: _Block, *, forward: bool) -> float:
    """Return the mean height of what a block is connected to in the layer before, or behind."""
    others = block.before if forward else block.behind
    if not others:
        return block.middle
    return sum(other.middle for other in others) / len(others)


def _stack(columns: Sequence[list[_Block]]) -> None:
    """Put the blocks of every layer below each other, around the middle."""
    whole = max((sum(block.height for block in column) for column in columns), default=0.0)
    for column in columns:
        top = 0.5 * (whole - sum(block.height for block in column))
        for block in column:
            block.top = top
            top += block.height
