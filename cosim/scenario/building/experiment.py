"""A scenario ready to run: its graph, clock and actions, and what its log keeps beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from cosim.core.clock import Clock
from cosim.core.contracts import Design
from cosim.core.gain.loop_gain import LoopGain
from cosim.core.graph import Graph
from cosim.core.recording import Plan, SignalEvent
from cosim.core.signals import Channel
from cosim.core.stepping.actions import Action, ConditionalAction, TimedAction
from cosim.scenario.identification.model import IdentifiedPlant
from cosim.scenario.kinds.initial_states import GivenStates
from cosim.scenario.parsing import Scenario
from cosim.scenario.record import ReplayOrigin

if TYPE_CHECKING:
    from cosim.blocks.port_map import PortMap
    from cosim.fmi.binary.messages import Message
    from cosim.fmi.driving.diagnostics import InputLimits


class MessageSource(Protocol):
    """An opened FMU, as a run sees it beside its component."""

    def terminate(self) -> None:
        """End the run; raise RunError where the FMU says that it failed."""
        ...

    def discard(self) -> None:
        """Forget the messages since the last call of ``drain``; what warns only once may again."""
        ...

    def drain(self) -> Sequence[Message]:
        """Return the messages since the last call."""
        ...

    @property
    def input_limits(self) -> InputLimits:
        """What it allows of its inputs."""
        ...


def warnings_among(messages: Mapping[str, Sequence[Message]]) -> list[tuple[str, str]]:
    """Return the warnings among messages of FMUs, each with its component."""
    warnings = []
    for name, of_fmu in messages.items():
        warnings += [(name, message.text) for message in of_fmu if message.level == "warning"]
    return warnings


@dataclass(frozen=True)
class Experiment:
    """A scenario ready to run.

    Parameters
    ----------
    scenario : Scenario
    graph : Graph
    clock : Clock
    truth : mapping of estimate to its truth
        What the report compares.
    metadata : mapping of component name to plain values
        What the log keeps of a component.
    warnings : tuple of (component, text)
    reads : mapping of component name to names of tables
        That were read to build the component, beside its own.
    attachments : mapping of file name to text
        For the log: modelDescription.xml of each FMU.
    fmus : mapping of component name to MessageSource
        What was opened for this run and may have messages.
    port_maps : mapping of component name to PortMap
        Of components that have other ports than those shown.
    files : frozenset of Path
        What is read beside the scenario.
    modules : frozenset of Path
        The files of the classes of users.
    identified : mapping of identifier to IdentifiedPlant
        What its estimates are judged by.
    models : mapping of name to plain values
        Of those that were read from files: file, hash and matrices.
    given_states : mapping of component name to GivenStates
        Initial states that the run may have to change.
    plan : Plan or None
        Of the graph, where it was prepared already.
    gains : tuple of LoopGain
        Of its loops; of a replay as they were recorded.
    designs : mapping of component name to Design, or None
        Of a replay: the recorded designs that it takes; where it has a plan, that has them.
    messages : mapping of component name to list of Message
        What was drained from ``fmus`` already.
    origin : ReplayOrigin or None
        Of a replay: the log it is made from.
    events : tuple of SignalEvent
        Of a replay: overrides and releases of inputs, and what followed them.
    actions : tuple of TimedAction
        What happens at communication points.
    reactions : tuple of ConditionalAction
        What happens where conditions come true.
    until : str or None
        The condition where it ends before its stop.
    settings : mapping of (int, str) to Action
        What sets parameters, by time [ns] and component; those of a replay too.
    setting_designs : mapping of str to str
        The designs of the components that take the places of others, for the log.
    recorded : tuple of str
        Of a replay: the components that are taken from the recording.
    declared : mapping of component name to Channel
        Of a replay: all that the recorded run had, some of which need not be here.
    fmu_files : mapping of SHA-256 to Path
        The files of the FMUs that components are.
    absent : mapping of component name to str
        Of a replay of a partial log: why components are not here.
    uncomputed : mapping of component name to str
        Of it: why components are not computed that could be from a whole log.
    """

    scenario: Scenario
    graph: Graph
    clock: Clock
    truth: Mapping[str, Any]
    metadata: Mapping[str, Mapping[str, Any]]
    warnings: tuple[tuple[str, str], ...]
    reads: Mapping[str, frozenset[str]]
    attachments: Mapping[str, str]
    fmus: Mapping[str, MessageSource]
    files: frozenset[Path]
    modules: frozenset[Path] = frozenset()
    port_maps: Mapping[str, PortMap] = field(default_factory=dict)
    identified: Mapping[str, IdentifiedPlant] = field(default_factory=dict)
    models: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    given_states: Mapping[str, GivenStates] = field(default_factory=dict)
    plan: Plan | None = None
    gains: tuple[LoopGain, ...] = ()
    designs: Mapping[str, Design] | None = None
    messages: Mapping[str, Sequence[Message]] = field(default_factory=dict)
    origin: ReplayOrigin | None = None
    events: tuple[SignalEvent, ...] = ()
    actions: tuple[TimedAction, ...] = ()
    reactions: tuple[ConditionalAction, ...] = ()
    until: str | None = None
    settings: Mapping[tuple[int, str], Action] = field(default_factory=dict)
    setting_designs: Mapping[str, str] = field(default_factory=dict)
    recorded: tuple[str, ...] = ()
    declared: Mapping[str, Channel] = field(default_factory=dict)
    fmu_files: Mapping[str, Path] = field(default_factory=dict)
    absent: Mapping[str, str] = field(default_factory=dict)
    uncomputed: Mapping[str, str] = field(default_factory=dict)

    @property
    def has_events(self) -> bool:
        """Whether there may be events: actions, those of a recording, outputs that jump."""
        acts = self.events or self.actions or self.reactions
        return bool(acts or self.graph.layout.jumping)
