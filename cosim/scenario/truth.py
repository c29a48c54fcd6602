"""What estimates should equal: the entries of [truth] that a run can compare."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np

from cosim.core.contracts import Component
from cosim.core.signals import Signal
from cosim.errors import nearest
from cosim.scenario.document import Problem
from cosim.scenario.schema import File
from cosim.units import conversion


def check_truth(
    file: File,
    components: Mapping[str, Component],
    missing: Collection[str],
    warn: Callable[[str, str], None],
) -> tuple[dict[str, Any], list[Problem]]:
    """Give the truths that can be compared, and what is wrong with others.

    A swapped component need not have the signals that only the report asks for.

    Parameters
    ----------
    file : File
    components : mapping of name to Component
    missing : names
        Of components that could not be built: what touches them is not judged.
    warn : callable
        Told of the truths that a swap leaves out, as (component, text).
    """
    kept: dict[str, Any] = {}
    problems: list[Problem] = []
    signals = {
        f"{n}.{s.name}": s
        for n, c in components.items()
        for s in (*c.interface.inputs, *c.interface.outputs)
    }
    mapped = {f"{name}.{port}" for name, swap in file.swap.items() for port in swap.map.values()}
    for estimate, truth in file.truth.items():
        found = {estimate: _sized(signals, estimate)} | (
            {truth: _true(signals, truth)} if isinstance(truth, str) else {}
        )
        unknown = [port for port, one in found.items() if one is None]
        lost = [port for port in unknown if _component(port) in file.swap and port not in mapped]
        if {_component(port) for port in found} & set(missing):
            continue
        if lost:
            warn(_component(lost[0]), f"has no {lost[0]!r}: the report leaves out {estimate!r}")
        elif unknown:
            problems += [
                (("truth", estimate), f"there is no signal {port!r}; {nearest(port, signals)}")
                for port in unknown
            ]
        elif text := _mismatch(estimate, truth, [one for one in found.values() if one is not None]):
            problems.append((("truth", estimate), text))
        else:
            kept[estimate] = truth
    return kept, problems


_Sized = tuple[Signal, int]  # a signal, and of how many of its elements


def _sized(signals: Mapping[str, Signal], port: str) -> _Sized | None:
    return (signals[port], signals[port].size) if port in signals else None


def _true(signals: Mapping[str, Signal], port: str) -> _Sized | None:
    """Find a signal, or one element of it."""
    element = re.fullmatch(r"(.*)\[(\d+)\]", port)
    if (
        port not in signals
        and element
        and element[1] in signals
        and int(element[2]) < signals[element[1]].size
    ):
        return signals[element[1]], 1
    return _sized(signals, port)


def _mismatch(estimate: str, truth: Any, found: list[_Sized]) -> str:
    """Say why an estimate cannot be compared with its truth; empty: it can."""
    signal, size = found[0]
    true, needed = found[-1] if isinstance(truth, str) else (signal, len(np.atleast_1d(truth)))
    if size != needed:
        return f"{estimate!r} has size {size}, its truth {truth!r} has size {needed}"
    if conversion(true.measure, signal.measure) is None:
        return f"{estimate!r} has unit {signal.unit!r}, its truth {truth!r} has unit {true.unit!r}; needed units of one kind"
    return ""


def _component(port: str) -> str:
    return port.partition(".")[0]
