"""What only some kinds can do: a kind derives from those it has, and is asked where it has them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from cosim.core.signals import Interface
from cosim.instants import StepNs
from cosim.scenario.kinds.base import BuildContext
from cosim.scenario.kinds.initial_states import GivenStates

if TYPE_CHECKING:
    from cosim.blocks.renaming import Renaming
    from cosim.fmi.description import Description, InterfaceType


class Advising(ABC):
    """Its result may be right but costly or poor."""

    @abstractmethod
    def advice(
        self, name: str, context: BuildContext, *, held: Mapping[str, bool], h: float
    ) -> list[str]:
        """Return warnings about that.

        Parameters
        ----------
        name : str
            Of the component.
        context : BuildContext
            That it was built in.
        held : mapping of input name to bool
            Whether the input keeps its value over a communication step.
        h : float
            Communication step [s].
        """


class DecidedByStep(ABC):
    """Keys of its table follow from the communication step, where they are not given."""

    @abstractmethod
    def decided(
        self, table: Mapping[str, Any], metadata: Mapping[str, Any], step_ns: StepNs
    ) -> Mapping[str, Any]:
        """Return the table with what the communication step has decided.

        With a smaller step it is the same then: an instant of a communication point, for example.

        Parameters
        ----------
        table : Mapping
            Of the component, as the scenario has it.
        metadata : Mapping
            That it has recorded while it was built.
        step_ns : int
            Communication step [ns] that it was built with.
        """


class HasSamples(ABC):
    """Its outputs may have values that are no new samples; the samples are outputs beside them."""

    @abstractmethod
    def samples_of(self, output: str) -> str | None:
        """Return the output with another output's samples at times of their own; None: none."""

    @property
    @abstractmethod
    def samples_at_points(self) -> bool:
        """Whether samples are of communication points, at most one of each."""

    @abstractmethod
    def most_in_a_step(self, name: str, context: BuildContext) -> int:
        """Return for how many samples in a communication step there is a place; 0: none."""

    def late_steps(self, context: BuildContext) -> int:
        """Return how many communication steps after its instant a sample may come."""
        return 0


class RenamesMore(ABC):
    """Further outputs take part where a map renames one."""

    @abstractmethod
    def renamings(self, interface: Interface, given: Sequence[Renaming]) -> Sequence[Renaming]:
        """Return the renamings of a swap, and those that follow from them.

        Parameters
        ----------
        interface : Interface
            Of the component.
        given : sequence of Renaming
        """


class HasGivenStates(ABC):
    """It has initial states of which a run may keep a part only."""

    @abstractmethod
    def given_states(self, name: str, context: BuildContext) -> GivenStates | None:
        """Return these; None: there are none."""


class HasDescription(ABC):
    """It drives an instance of FMI."""

    @abstractmethod
    def description(self, name: str, context: BuildContext) -> tuple[InterfaceType, Description]:
        """Return interface type and description of the instance."""
