"""A scenario ready to run: its graph, clock and actions, and what its log keeps beside them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from cosim.core.clock import Clock, exact_nanoseconds
from cosim.core.contracts import Design
from cosim.core.gain.loop_gain import LoopGain
from cosim.core.graph import Graph
from cosim.core.recording import Plan, SignalEvent
from cosim.core.signals import Channel
from cosim.core.stepping.actions import AT_CONDITION, Action, ConditionalAction, TimedAction
from cosim.instants import step_value
from cosim.log.metadata import encode_design
from cosim.scenario.kinds.base import BuildContext, Scenario
from cosim.scenario.kinds.capabilities import GivenStates
from cosim.scenario.kinds.identified_plant import IdentifiedPlant
from cosim.scenario.record import ReplayOrigin

if TYPE_CHECKING:
    from cosim.blocks.port_map import PortMap
    from cosim.fmi.binary.messages import Message


def warnings_among(messages: Mapping[str, Sequence[Message]]) -> list[tuple[str, str]]:
    """Return the warnings among messages of FMUs, each with its component."""
    warnings = []
    for name, of_fmu in messages.items():
        warnings += [(name, message.text) for message in of_fmu if message.level == "warning"]
    return warnings


@dataclass
class Experiment:
    """A scenario ready to run.

    Whoever prepares it for its run fills in what is known only then, such as the gains of loops, or
    the recorded events of a replay.

    Parameters
    ----------
    scenario : Scenario
    graph : Graph
    clock : Clock
    built : BuildContext
        What the components were built in: what was read, opened and recorded for that.
    truth : mapping of estimate to its truth
        What the report compares.
    port_maps : mapping of component name to PortMap
        Of components that have other ports than those shown.
    identified : mapping of identifier to IdentifiedPlant
        What its estimates are judged by.
    given_states : mapping of component name to GivenStates
        Initial states that the run may have to change.
    actions : tuple of TimedAction
        What happens at communication points.
    reactions : tuple of ConditionalAction
        What happens where conditions come true.
    until : str or None
        The condition where it ends before its stop.
    settings : mapping of (int, str) to Action
        What sets parameters, by time [ns] and component; those of a replay too.
    recorded : tuple of str
        Of a replay: the components that are taken from the recording.
    declared : mapping of component name to Channel
        Of a replay: all that the recorded run had, some of which need not be here.
    plan : Plan or None
        Of the graph, where it was prepared already.
    gains : tuple of LoopGain
        Of its loops; of a replay as they were recorded.
    designs : mapping of component name to Design, or None
        Of a replay: the recorded designs that it takes; where it has a plan, that has them.
    setting_designs : mapping of str to str
        The designs of the components that take the places of others, for the log.
    messages : mapping of component name to list of Message
        What was drained from FMUs already.
    origin : ReplayOrigin or None
        Of a replay: the log it is made from.
    events : tuple of SignalEvent
        Of a replay: overrides and releases of inputs, and what followed them.
    """

    scenario: Scenario
    graph: Graph
    clock: Clock
    built: BuildContext
    truth: Mapping[str, Any]
    port_maps: Mapping[str, PortMap]
    identified: Mapping[str, IdentifiedPlant]
    given_states: Mapping[str, GivenStates]
    actions: tuple[TimedAction, ...]
    reactions: tuple[ConditionalAction, ...]
    until: str | None
    settings: Mapping[tuple[int, str], Action]
    recorded: tuple[str, ...]
    declared: Mapping[str, Channel]
    plan: Plan | None = None
    gains: tuple[LoopGain, ...] = ()
    designs: Mapping[str, Design] | None = None
    setting_designs: Mapping[str, str] = field(default_factory=dict)
    messages: Mapping[str, Sequence[Message]] = field(default_factory=dict)
    origin: ReplayOrigin | None = None
    events: tuple[SignalEvent, ...] = ()

    @property
    def has_events(self) -> bool:
        """Whether there may be events: actions, those of a recording, outputs that jump."""
        acts = self.events or self.actions or self.reactions
        return bool(acts or self.graph.layout.jumping)

    def prepare_settings(self, recorded: Mapping[str, Design]) -> dict[str, str]:
        """Prepare the variants of all settings; return their designs, encoded, by time and name."""
        designs = {}
        for (time_ns, name), action in self.settings.items():
            for component in action.variants.values():
                key = f"{time_ns} {name}"
                taken = recorded.get(key) or recorded.get(f"{AT_CONDITION} {name}") or {}
                design = self.graph.prepare_variant(
                    name, component, self.clock.step_ns, taken, transfers=action.transfers
                )
                designs[key] = encode_design(design)
        return designs


def fingerprint(scenario: Scenario, name: str, reads: frozenset[str]) -> str:
    """Hash everything that the design of a component rests on.

    This is its table, the tables that it read, communication step and substeps, input interpolation
    and coupling.
    """
    settings = scenario.file.scenario
    tables = {}
    for dotted in sorted({f"components.{name}", *reads}):
        table, _, entry = dotted.partition(".")
        tables[dotted] = scenario.tree.get(table, {}).get(entry)
    method: list[Any] = [settings.coupling, settings.iterations]
    if settings.substeps is not None:
        method.append(settings.substeps.model_dump())
    step = step_value(exact_nanoseconds(settings.step))
    values = [tables, step, settings.input_interpolation or "linear", *method]
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
