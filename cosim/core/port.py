"""Ports: the written names of signals, parsed once at the border.

::

    plant.x_a         a signal of a component; the first dot ends the component's name
    plant.x_a[1]      one element of it, numbered from 0
    plant.x_a[0:2]    some of its elements, the end not included, as in Python

A signal may have a name of its own that looks like that of an element, such as the FMI variable
``x[1]``: where a component has it, it comes first.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

from cosim.core.signals import Signal
from cosim.errors import GraphError

ElementIndex: TypeAlias = int | range | None


@dataclass(frozen=True, slots=True, order=True)
class Port:
    """A signal of a component, or some of its elements.

    Parameters
    ----------
    component : str
    signal : str
    element : int, range or None
        None: the whole signal.
    """

    component: str
    signal: str
    element: ElementIndex = None

    def __post_init__(self) -> None:
        for name in (self.component, self.signal):
            if not isinstance(name, str) or not name:
                raise GraphError(f"port: expected a component and a signal name, got {name!r}")
        if self.element is not None:
            self._check_element(self.element)

    def _check_element(self, element: int | range) -> None:
        if type(element) is int and element >= 0:
            return
        if isinstance(element, range) and element and element.start >= 0 and element.step == 1:
            return
        label = f"{self.component}.{self.signal}"
        raise GraphError(
            f"'{label}': expected an index from 0, or a slice such as [0:2], got {element!r}"
        )

    @classmethod
    def parse(cls, text: str) -> Port:
        """Return the port that a text names: ``component.signal``, also with ``[1]`` or ``[0:2]``.

        Raises
        ------
        GraphError
            If it is no text, if there is no dot, nothing before or behind it, or no element in a
            slice.
        """
        if not isinstance(text, str):
            raise GraphError(f"expected a port such as 'plant.y', got {text!r}")
        component, dot, name = text.partition(".")
        if not (component and dot and name):
            raise GraphError(f"expected a port COMPONENT.SIGNAL, such as plant.y, got {text!r}")
        signal, element = split_element(name)
        if isinstance(element, range) and not element:
            raise GraphError(f"{text!r} has no elements; expected a slice such as [0:2]")
        return cls(component, signal, element)

    @property
    def name(self) -> str:
        """The name without that of the component: ``x_a[1]``."""
        match self.element:
            case None:
                return self.signal
            case int():
                return f"{self.signal}[{self.element}]"
            case range():
                return f"{self.signal}[{self.element.start}:{self.element.stop}]"

    def __str__(self) -> str:
        return f"{self.component}.{self.name}"

    @property
    def whole(self) -> Port:
        """The port of the whole signal."""
        return Port(self.component, self.signal)

    def find(self, by_name: Mapping[str, Signal]) -> tuple[Signal, slice] | None:
        """Return the signal that is meant, and which of its elements.

        None: it is none of the signals.

        Raises
        ------
        GraphError
            If the signal has no such element.
        """
        if self.name in by_name:
            signal = by_name[self.name]
            return signal, slice(0, signal.size)
        if self.signal not in by_name:
            return None
        signal = by_name[self.signal]
        return signal, self.elements_of(signal)

    def element_names(self, size: int) -> list[str]:
        """Return the names of its elements, numbered as in its signal; a scalar's is its own."""
        if isinstance(self.element, range):
            return [str(replace(self, element=i)) for i in self.element]
        return [str(self)] if size == 1 else [f"{self}[{i}]" for i in range(size)]

    def elements_of(self, signal: Signal) -> slice:
        """Return which elements of its signal are meant.

        Raises
        ------
        GraphError
            If the signal has no such element.
        """
        match self.element:
            case None:
                return slice(0, signal.size)
            case int():
                elements = slice(self.element, self.element + 1)
            case range():
                elements = slice(self.element.start, self.element.stop)
        if elements.stop > signal.size:
            count = "1 element" if signal.size == 1 else f"{signal.size} elements"
            origin = f" (of the FMU: {signal.origin})" if signal.origin else ""
            raise GraphError(f"{str(self)!r}: '{self.whole}' has {count}, numbered from 0{origin}")
        return elements


def split_element(name: str) -> tuple[str, ElementIndex]:
    """Split ``x[1]`` into ``x`` and 1, ``x[0:2]`` into ``x`` and range(0, 2).

    Without brackets the element is None.
    """
    # Of 18 digits at most: Python refuses to read very long numbers.
    match = re.fullmatch(r"(.+)\[(\d{1,18})(?::(\d{1,18}))?\]", name)
    if match is None:
        return name, None
    first = int(match[2])
    if match[3] is None:
        return match[1], first
    return match[1], range(first, int(match[3]))


def named_ports(value: Any) -> list[str]:
    """Return the ports that a value lists, one or several; none where it is numbers."""
    if isinstance(value, str):
        return [value]
    if isinstance(value, list | tuple):
        return [entry for entry in value if isinstance(entry, str)]
    return []
