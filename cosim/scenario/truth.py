"""What estimates should equal: the entries of [truth] that a run can compare."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosim.core.contracts import Component
from cosim.core.port import Port
from cosim.core.signals import Interface, Signal
from cosim.errors import GraphError, nearest
from cosim.scenario.problems import Problem
from cosim.scenario.schema import File
from cosim.units import conversion


@dataclass(frozen=True, slots=True)
class ComparedSignal:
    """A signal, and how many of its elements are compared."""

    signal: Signal
    size: int


def check_truth(
    file: File,
    components: Mapping[str, Component],
    missing: Collection[str],
    warn: Callable[[str, str], None],
) -> tuple[dict[str, Any], list[Problem]]:
    """Return the truths that can be compared, and the problems of the others.

    A swapped component need not have the signals that only the report asks for.

    Parameters
    ----------
    file : File
    components : mapping of name to Component
    missing : names
        Of components that are not right: truths with their signals are not checked.
    warn : callable
        Told of the truths that a swap leaves out, as (component, text).
    """
    kept: dict[str, Any] = {}
    problems: list[Problem] = []
    interfaces = {name: component.interface for name, component in components.items()}
    for estimate, truth in file.truth.items():
        texts = [estimate, truth] if isinstance(truth, str) else [estimate]
        key = ("truth", estimate)
        try:
            ports = [Port.parse(text) for text in texts]
            if any(port.component in missing for port in ports):
                continue
            signals = [_find(interfaces, port) for port in ports]
        except GraphError as error:
            problems.append((key, str(error)))
            continue
        unknown = [port for port, signal in zip(ports, signals, strict=True) if signal is None]
        lost = [port for port in unknown if port.component in file.swap]
        compared = [signal for signal in signals if signal is not None]
        if lost:
            text = f"has no {str(lost[0])!r}: the report leaves out {estimate!r}"
            warn(lost[0].component, text)
        elif unknown:
            problems += [(key, _unknown(interfaces, port)) for port in unknown]
        elif mismatch := _mismatch(estimate, truth, compared):
            problems.append((key, mismatch))
        else:
            kept[estimate] = truth
    return kept, problems


def _find(interfaces: Mapping[str, Interface], port: Port) -> ComparedSignal | None:
    """Return the signal that a port names; None: there is none.

    Raises
    ------
    GraphError
        If it has no such element.
    """
    interface = interfaces.get(port.component, Interface())
    match = port.find(interface.signals)
    if match is None:
        return None
    signal, elements = match
    return ComparedSignal(signal, len(range(*elements.indices(signal.size))))


def _unknown(interfaces: Mapping[str, Interface], port: Port) -> str:
    names: list[str] = []
    for component, interface in interfaces.items():
        names += [f"{component}.{signal.name}" for signal in interface.signals]
    return f"there is no signal {str(port)!r}; {nearest(str(port), names)}"


def _mismatch(estimate: str, truth: Any, compared: list[ComparedSignal]) -> str:
    """Return why an estimate cannot be compared with its truth; empty: it can."""
    estimated = compared[0]
    if isinstance(truth, str):
        true = compared[1]
    else:
        true = ComparedSignal(estimated.signal, len(np.atleast_1d(truth)))
    if estimated.size != true.size:
        return f"{estimate!r} has size {estimated.size}, its truth {truth!r} has size {true.size}"
    if conversion(true.signal.measure, estimated.signal.measure) is None:
        return (
            f"{estimate!r} has unit {estimated.signal.unit!r}, its truth {truth!r} has unit "
            f"{true.signal.unit!r}; needed units of one kind"
        )
    return ""
