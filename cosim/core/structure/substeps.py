"""Which components of a loop take substeps, and which of their outputs these are chosen by.

Of a component that has steps of its own - a delay, a sampled controller, an estimator - nothing
happens inside a communication step. It is *early* where what it reads at the end of a step reaches
none of its outputs there; it is *late* where its outputs hold their values over the step, or only
such components read them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from cosim.core.port import Port
from cosim.core.signals import Interface, Signal, Variability
from cosim.core.structure.feedthrough import Sources
from cosim.errors import RollbackError, listing


@dataclass(frozen=True, slots=True)
class SubstepRoles:
    """The components of a loop by what they do in its substeps.

    Parameters
    ----------
    taking : tuple of str
        They take substeps.
    early, late : tuple of str
        They advance over whole communication steps, before and behind the substeps.
    """

    taking: tuple[str, ...]
    early: tuple[str, ...]
    late: tuple[str, ...]


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

    Raises
    ------
    RollbackError
        If some can do neither.
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
    if unfit:
        raise RollbackError(
            f"substeps: {listing(unfit)} in this loop cannot take part of a step and go back "
            "(rollback or substeps is not declared; of an FMU: canGetAndSetFMUstate, "
            "canHandleVariableCommunicationStepSize), and other components read its outputs "
            "within the step; use a loop without it, or a smaller step without substeps"
        )
    return SubstepRoles(tuple(taking), tuple(early), tuple(late))


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


def driving_outputs(components: Iterable[str], sources: Sources) -> set[Port]:
    """Return the outputs that drive some components."""
    driving: set[Port] = set()
    for component in components:
        for ports in sources[component].values():
            driving.update(ports)
    return driving


def estimated_outputs(
    interfaces: Mapping[str, Interface],
    sources: Sources,
    variability: Callable[[Port], Variability],
) -> dict[Port, Signal]:
    """Return the outputs of a loop whose errors are estimated, in the order of its components.

    Those are the continuous ones, except where they lag and drive nothing in the loop. The
    parameters are those of :func:`substep_roles`.
    """
    driving = driving_outputs(interfaces, sources)
    estimated: dict[Port, Signal] = {}
    for name, interface in interfaces.items():
        for signal in interface.outputs:
            port = Port(name, signal.name)
            is_followed = port in driving or signal.name not in interface.lagging
            if is_followed and variability(port) != "discrete":
                estimated[port] = signal
    return estimated
