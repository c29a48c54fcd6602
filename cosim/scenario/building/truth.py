"""What estimates should equal: the entries of [truth] that a run can compare."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from typing import Any

import numpy as np

from cosim.core.contracts import Component
from cosim.core.port import Port
from cosim.core.signals import Signal
from cosim.core.structure.connection_checks import unknown_units
from cosim.errors import GraphError, nearest
from cosim.scenario.places import Problem
from cosim.scenario.schema import File, truth_ports
from cosim.units import Unit, conversion


def check_truth(
    file: File,
    components: Mapping[str, Component],
    missing: Set[str],
    warn: Callable[[str, str], None],
) -> tuple[dict[str, Any], list[Problem]]:
    """Return the truths that can be compared, and the problems of the others.

    A swapped component need not have the signals that only the report asks for.

    Parameters
    ----------
    file : File
    components : mapping of name to Component
    missing : set of names
        Of components that are not right: truths with their signals are not checked.
    warn : callable
        Called with the truths that a swap leaves out, as (component, text).
    """
    kept: dict[str, Any] = {}
    problems: list[Problem] = []
    signals = _Signals(components)
    for estimate, truth in file.truth.items():
        texts = [estimate, *truth_ports(truth)]
        try:
            ports = [Port.parse(text) for text in texts]
            if not missing.isdisjoint(port.component for port in ports):
                continue
            unknown = signals.unknown(ports)
            dropped = [port for port in unknown if port.component in file.swap]
            if dropped:
                text = f"has no {str(dropped[0])!r}: the report leaves out {estimate!r}"
                warn(dropped[0].component, text)
                continue
            estimated, *true_signals = [signals.units(port) for port in ports]
            _check_size(estimate, truth, estimated, true_signals)
            first = 0
            for port, true in zip(ports[1:], true_signals, strict=True):
                beside = estimated[first : first + len(true)]
                for pair in dict.fromkeys(zip(beside, true, strict=True)):
                    _check_unit(estimate, port, *pair, warn)
                first += len(true)
        except GraphError as error:
            problems.append((("truth", estimate), str(error)))
        else:
            kept[estimate] = truth
    return kept, problems


class _Signals:
    """The signals of components by port."""

    def __init__(self, components: Mapping[str, Component]) -> None:
        self._signals: dict[str, Mapping[str, Signal]] = {}
        self._names: list[str] = []
        for name, component in components.items():
            signals = component.interface.by_name
            self._signals[name] = signals
            self._names += [f"{name}.{signal}" for signal in signals]

    def unknown(self, ports: Sequence[Port]) -> list[Port]:
        """Return those of some ports that there are not."""
        return [port for port in ports if self._match(port) is None]

    def units(self, port: Port) -> tuple[Unit, ...]:
        """Return the units of the elements that a port names.

        Raises
        ------
        GraphError
            If there is no such signal or element.
        """
        match = self._match(port)
        if match is None:
            suggestion = nearest(str(port), self._names)
            raise GraphError(f"unknown signal {str(port)!r}; {suggestion}")
        signal, elements = match
        return signal.measures_of(elements)

    def _match(self, port: Port) -> tuple[Signal, slice] | None:
        return port.find(self._signals.get(port.component, {}))


def _check_size(
    estimate: str, truth: Any, estimated: Sequence[Unit], true_signals: Sequence[Sequence[Unit]]
) -> None:
    """Check that an estimate has as many elements as its truth: all signals of it, or numbers.

    Raises
    ------
    GraphError
        If it has not.
    """
    true_size = sum(map(len, true_signals))
    if not true_signals:
        true_size = len(np.atleast_1d(truth))
    if len(estimated) != true_size:
        shown_truth = list(truth) if isinstance(truth, tuple) else truth
        raise GraphError(
            f"{estimate!r} has size {len(estimated)}, "
            f"its true value {shown_truth!r} has size {true_size}"
        )


def _check_unit(
    estimate: str,
    port: Port,
    unit: Unit,
    true_unit: Unit,
    warn: Callable[[str, str], None],
) -> None:
    """Check that the unit of a true signal can be converted to that of the estimate.

    Warn where nobody can say.

    Raises
    ------
    GraphError
        If it cannot.
    """
    if conversion(true_unit, unit) is None:
        raise GraphError(
            f"{estimate!r} has unit {unit.name!r}, its true value {str(port)!r} has unit "
            f"{true_unit.name!r}; expected compatible units"
        )
    if unknown := unknown_units(true_unit, unit):
        warn(
            Port.parse(estimate).component,
            f"{estimate}, its truth {port}: {unknown}, so values in {true_unit.name!r} are taken "
            f"as {unit.name!r}, as they are",
        )
