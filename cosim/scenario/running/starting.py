"""Start a scenario that is advanced by hand."""

from __future__ import annotations

import hashlib
import json
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path

from cosim.arguments import truth_argument
from cosim.core.recorders import Nothing
from cosim.core.simulation import Simulation
from cosim.errors import UsageError
from cosim.log.mcap_file.paths import log_path
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.building.parsing import Scenario
from cosim.scenario.recordings.message_recorder import MessageRecorder
from cosim.scenario.recordings.recording import (
    Target,
    build_experiment,
    check_target,
    chosen_of,
    log_recorder,
)
from cosim.scenario.recordings.records import metadata_of
from cosim.scenario.session import Opened, Session


def start(
    scenario: Scenario, out: str | Path | None, *, force: bool = False, numbered: bool = False
) -> Session:
    """Start a scenario; see :meth:`cosim.scenario.building.parsing.Scenario.start`.

    Raises
    ------
    CosimError
        If it cannot be built, initialized, or recorded.
    """
    force = truth_argument("force", force)
    numbered = truth_argument("numbered", numbered)
    check_target(out, force=force, numbered=numbered)
    return Session(partial(_opened, scenario, Target(out, force, numbered)))


def _opened(scenario: Scenario, target: Target, resources: ExitStack, is_next: bool) -> Opened:
    """Build a scenario, and begin its simulation and its log."""
    experiment = build_experiment(scenario, resources, None)
    identity = _identity(experiment)
    out = target.out
    if out is None:
        unlogged = MessageRecorder(Nothing(), replace(experiment, identified={}))
        simulation = _begun(experiment, identity, unlogged, is_logged=False)
        return Opened(simulation, unlogged, lambda: None, lambda: unlogged.warnings)
    if is_next:
        target = Target(out, numbered=True)
    elif log_path(out).resolve() in experiment.built.files and not target.numbered:
        raise UsageError(f"{out} is read by this run; choose another path for the log")
    log = log_recorder(experiment, out, target, events=True)
    recorder = MessageRecorder(chosen_of(experiment, log), experiment)
    with ExitStack() as entered:
        entered.enter_context(recorder)
        simulation = _begun(experiment, identity, recorder)
        entered.pop_all()  # the session closes it
    return Opened(simulation, recorder, lambda: log.path, lambda: recorder.warnings)


def _begun(
    experiment: Experiment, identity: str, recorder: MessageRecorder, *, is_logged: bool = True
) -> Simulation:
    """Prepare and initialize the graph."""
    graph = experiment.graph
    plan = experiment.plan
    if plan is None:
        plan = graph.prepare(experiment.clock.step_ns)
    recorder.begin(plan)
    return Simulation(
        graph,
        experiment.clock,
        plan,
        recorder=recorder if is_logged else None,
        identity=identity,
        actions=experiment.actions,
        reactions=experiment.reactions,
        until=experiment.until,
    )


def _identity(experiment: Experiment) -> str:
    """Return the hash of all values of a scenario that its states rest on, but for times."""
    records = metadata_of(experiment)
    del records["cosim.run"]
    text = json.dumps(records, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
