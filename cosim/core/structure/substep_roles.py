"""Which components of a loop take substeps, and which keep to communication steps.

Of a component that has steps of its own - a delay, a sampled controller, an estimator - nothing
happens inside a communication step. It is *early* where what it reads at the end of a step reaches
none of its outputs there; it is *late* where its outputs hold their values over the step, or only
such components read them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from cosim.core.port import Port
from cosim.core.signals import Interface, Variability
from cosim.core.structure.feedthrough import Sources


@dataclass(frozen=True, slots=True)
class SubstepRoles:
    """The components of a loop by what they do in its substeps.

    Parameters
    ----------
    taking : tuple of str
        They take substeps.
    early, late : tuple of str
        They advance over whole communication steps, before and behind the substeps.
    unfit : tuple of str
        They can do neither.
    """

    taking: tuple[str, ...]
    early: tuple[str, ...]
    late: tuple[str, ...]
    unfit: tuple[str, ...]


def substep_roles(
    interfaces: Mapping[str, Interface],
    sources: Sources,
    variability: Callable[[Port], Variability],
) -> SubstepRoles:
    """Return what the components of a loop do in its substeps.

    Parameters
    ----------
    interfaces : mapping of component name to Interface
        The components of the loop.
    sources : mapping of component name to mapping of input to tuple of Port
        What drives each input.
    variability : callable
        Of an output.
    """
    taking = [name for name, own in interfaces.items() if own.substeps and own.rollback]
    others = [name for name in interfaces if name not in taking]
    early = [name for name in others if _is_early(interfaces[name])]
    late = [name for name in others if name not in early]
    unfit: list[str] = []
    while True:
        read = _read_continuously(taking + unfit, sources, variability)
        followed = [name for name in late if name in read]
        if not followed:
            break
        unfit += followed
        late = [name for name in late if name not in read]
    return SubstepRoles(tuple(taking), tuple(early), tuple(late), tuple(unfit))


def _is_early(interface: Interface) -> bool:
    """Return whether no output at the end of a step depends on an input there."""
    delayed = interface.input_names <= frozenset(interface.delayed)
    return delayed and not any(interface.feeds(signal.name) for signal in interface.outputs)


def _read_continuously(
    readers: list[str], sources: Sources, variability: Callable[[Port], Variability]
) -> set[str]:
    """Return the components that drive some others with outputs that are not discrete."""
    read: set[str] = set()
    for reader in readers:
        for ports in sources[reader].values():
            read.update(port.component for port in ports if variability(port) != "discrete")
    return read
