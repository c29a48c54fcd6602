"""Runs for their signals alone: the verdicts at the end of a run take most of a long one's time."""

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from cosim.core import Memory
from cosim.core import run as run_graph
from cosim.scenario.building.build import Builder
from cosim.scenario.document.document import PortNames
from cosim.scenario.kinds.base import Scenario
from cosim.scenario.running.execution import load

# 700 steps in place of 7000: the filter follows them, and identification begins at 6.52 s
COARSE = {"scenario.step": 0.01, "scenario.stop": 7.0, "observer.filter_rate": 100.0}


def signals(
    scenario: str | Scenario,
    *,
    set: Mapping[str, Any] | None = None,
    swap: Mapping[str, str | Path] | None = None,
    map: Mapping[str, PortNames] | None = None,
) -> Memory:
    """Run a scenario as `cosim.run` does, without the verdicts on its identifiers."""
    loaded = scenario if isinstance(scenario, Scenario) else load(scenario)
    memory = Memory()
    with ExitStack() as resources:
        experiment = Builder(loaded.edit(set=set, swap=swap, map=map), resources).experiment()
        run_graph(
            experiment.graph,
            experiment.clock,
            memory,
            experiment.plan,
            designs=experiment.designs,
        )
    return memory
