"""Which continuous outputs jump where discrete ones do, and who has to know their left limits.

A discrete signal jumps at communication points: up to there it has the value that it held, its left
limit, and the row has the right one. What follows it at once jumps too. Where that is interpolated
through a step, the step ends with the left limit and the next one begins with the right one; with
the right limit at both ends a jump would be a ramp over the step before it.

A sum of continuous and discrete signals, whose variability is inherited, is left out: it is
interpolated as a whole, noise that is measured with it included, which is warned of.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import final

from cosim.core.port import Port
from cosim.core.signals import Channel
from cosim.core.structure.cycles import reached_from
from cosim.core.structure.feedthrough import Sources
from cosim.core.structure.variability import BECOMES_A_RAMP, Variabilities


@final
class JumpingOutputs:
    """The continuous outputs of a graph that jump at communication points and are followed.

    Parameters
    ----------
    channels : mapping of component name to Channel
    variabilities : Variabilities

    Attributes
    ----------
    ports : tuple of Port
    """

    def __init__(self, channels: Mapping[str, Channel], variabilities: Variabilities) -> None:
        self._channels = channels
        self._variabilities = variabilities
        self._fed_to: dict[Port, tuple[Port, ...]] = {}
        self.ports: tuple[Port, ...] = ()
        self._jumping: dict[Port, None] = {}
        self._followed = variabilities.interpolated()
        if self._followed:
            self._jumping = self._find_jumping()
            self.ports = self._needed()

    def sources(self) -> dict[str, tuple[Port, ...]]:
        """Return the outputs whose left limits components take at the ends of steps, by these."""
        if not self.ports:
            return {}
        jumping = frozenset(self.ports)
        sources: dict[str, dict[Port, None]] = {}
        for name in self._channels:
            read = self._variabilities.followed_by(name)
            sources[name] = {port: None for port in read if port in jumping}
        for output in self.ports:
            own = sources[output.component]
            own |= dict.fromkeys(self._variabilities.jumps_fed_to(output))
            own |= {port: None for port in self._fed_to[output] if port in jumping}
        return {name: tuple(ports) for name, ports in sources.items() if ports}

    def warnings(
        self, sources: Sources, torn: Iterable[tuple[Port, Port]]
    ) -> Iterator[tuple[str, str]]:
        """Yield (component, text) where a jump becomes a ramp all the same.

        Parameters
        ----------
        sources : mapping of component name to mapping of input to tuple of Port
            The outputs that drive each input.
        torn : iterable of (input Port, source Port)
            The connections that loops are solved for.
        """
        for to, source in torn:
            if source in self.ports:
                yield (
                    source.component,
                    f"{source} jumps{self._cause(source)}, and drives {to}, which its loop is "
                    f"solved for: there {BECOMES_A_RAMP}",
                )
        for output in self._followed:
            interface = self._channels[output.component].interface
            if interface.by_name[output.signal].variability != "inherited":
                continue
            for name in interface.delayed:
                for source in sources[output.component].get(name, ()):
                    if source in self._jumping:
                        yield (
                            output.component,
                            f"{output} follows {source} with a delay, which "
                            f"jumps{self._cause(source)}: where that arrives {BECOMES_A_RAMP}",
                        )

    def _cause(self, output: Port) -> str:
        """Return in words with what an output jumps, where that is a discrete signal itself."""
        jumping = self._variabilities.jumps_fed_to(output)
        return f" with {', '.join(map(str, jumping))}, which feeds through" if jumping else ""

    def _find_jumping(self) -> dict[Port, None]:
        """Return the continuous outputs that jump with what feeds through to them."""
        jumping: dict[Port, None] = {}
        followers: dict[Port, list[Port]] = {}
        for channel in self._channels.values():
            for signal in channel.interface.outputs:
                port = Port(channel.name, signal.name)
                if self._variabilities.of(port) != "continuous":
                    continue
                self._fed_to[port] = tuple(dict.fromkeys(self._variabilities.fed_to(port)))
                for source in self._fed_to[port]:
                    followers.setdefault(source, []).append(port)
                if (
                    self._variabilities.jumps_fed_to(port)
                    or signal.name in channel.interface.left_limits
                ):
                    jumping[port] = None
        return reached_from(jumping, followers)

    def _needed(self) -> tuple[Port, ...]:
        """Return those that are followed, or that what is followed depends on."""
        jumping = self._jumping
        behind: dict[Port, list[Port]] = {}
        for output in jumping:
            behind[output] = [port for port in self._fed_to[output] if port in jumping]
        needed = reached_from([port for port in self._followed if port in jumping], behind)
        return tuple(port for port in jumping if port in needed)
