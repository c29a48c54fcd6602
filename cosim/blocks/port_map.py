"""Ports of a component under other names: what each shown port stands for.

A shown port stands for ports of the component, or for elements of them, in the order of its own
elements::

    plant.u    <- plant.force               another name
    plant.y    <- plant.out[2]              one element of a vector
    plant.x_a  <- plant.s1, plant.s2        a vector made of scalars
    plant.x_a  <- plant.s[0:2]              some elements of a vector

Names are resolved to a map in :mod:`cosim.blocks.renaming`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.linearization import Linearized
from cosim.core.signals import Causality, Dependencies, Interface, Signal
from cosim.native.blocks.wrapping import ElementSource
from cosim.units import Conversion, Unit, conversions_between


@dataclass(frozen=True, slots=True)
class PortElement:
    """One element of a port of the component.

    Parameters
    ----------
    signal : Signal
    causality : {"input", "output"}
    index : int
        In the signal.
    column : int
        In the vector of all inputs or outputs.
    """

    signal: Signal
    causality: Causality
    index: int
    column: int

    @property
    def name(self) -> str:
        """Name of the element."""
        return self.signal.element(self.index)

    @property
    def measure(self) -> Unit:
        """Its unit, by name and definition."""
        return self.signal.measure(self.index)

    @property
    def start(self) -> float:
        """Value of an input that nothing drives yet."""
        values = self.signal.start
        return values[self.index] if values else 0.0


@dataclass(frozen=True, slots=True)
class ShownPort:
    """A port as it is shown, and the elements that it stands for, all of one causality."""

    signal: Signal
    elements: tuple[PortElement, ...]

    @property
    def causality(self) -> Causality:
        """Causality of its elements."""
        return self.elements[0].causality

    @property
    def sources(self) -> dict[str, Signal]:
        """The signals of the component that it is made of, by name."""
        return {element.signal.name: element.signal for element in self.elements}


@dataclass(frozen=True)
class PortMap:
    """The ports of a component under the names by which they are shown.

    Parameters
    ----------
    component : Interface
        Of the component itself.
    inputs : tuple of ShownPort
        Cover every input element of the component once.
    outputs : tuple of ShownPort
    """

    component: Interface
    inputs: tuple[ShownPort, ...]
    outputs: tuple[ShownPort, ...]

    @property
    def names(self) -> dict[str, str]:
        """What each shown port stands for, by its name, where that is not its own."""
        names = {}
        for port in (*self.inputs, *self.outputs):
            sources = ", ".join(names_of(port.elements))
            if sources != port.signal.name:
                names[port.signal.name] = sources
        return names

    @cached_property
    def interface(self) -> Interface:
        """The interface that is shown."""
        own_feedthrough = self.component.feedthrough
        own_initial = self.component.initial
        # a signal without initial dependencies of its own has those of its feedthrough
        at_start = {**own_feedthrough, **own_initial}
        feedthrough = {}
        initial = {}
        for port in self.outputs:
            name = port.signal.name
            sources = port.sources.keys()
            if sources & own_feedthrough.keys():
                feedthrough[name] = self._shown_inputs_behind(port, own_feedthrough)
            if sources & own_initial.keys():
                initial[name] = self._shown_inputs_behind(port, at_start)
        inputs = tuple(port.signal for port in self.inputs)
        outputs = tuple(port.signal for port in self.outputs)
        own_delayed = set(self.component.delayed)
        delayed = [port.signal.name for port in self.inputs if port.sources.keys() <= own_delayed]
        once = set(self.component.one_value)
        one_value = [port.signal.name for port in self.inputs if port.sources.keys() & once]
        return replace(
            self.component,
            inputs=inputs,
            outputs=outputs,
            feedthrough=feedthrough,
            initial=initial,
            delayed=tuple(delayed),
            lagging=self._shown_of(self.component.lagging),
            jumping=self._shown_of(self.component.jumping),
            left_limits=self._shown_of(self.component.left_limits),
            one_value=tuple(one_value),
        )

    def _shown_of(self, outputs: Collection[str]) -> tuple[str, ...]:
        """Return the shown outputs that have elements of some outputs."""
        own = frozenset(outputs)
        return tuple(port.signal.name for port in self.outputs if port.sources.keys() & own)

    def _shown_inputs_behind(
        self, output: ShownPort, dependencies: Dependencies
    ) -> tuple[str, ...] | None:
        """Return the shown inputs that an output depends on; None: that is not known."""
        own_inputs: set[str] = set()
        for name in output.sources:
            names = dependencies.get(name, ())
            if names is None:
                return None
            own_inputs.update(names)
        shown_inputs = []
        for port in self.inputs:
            if not own_inputs.isdisjoint(port.sources):
                shown_inputs.append(port.signal.name)
        return tuple(shown_inputs)

    # --- values ---

    def component_inputs(self, shown: Matrix) -> Matrix:
        """Return the component's inputs for shown inputs, shape (..., n_u)."""
        values = _convert(shown, self._inward)
        return np.take(values, self._shown_columns, axis=-1)

    def component_mask(self, shown: Mask) -> Mask:
        """Return a mask of the component's input elements for that of shown elements, (n_u,)."""
        return np.take(shown, self._shown_columns)

    def shown_outputs(self, values: Matrix) -> Matrix:
        """Return the shown outputs for the component's, shape (..., n_y)."""
        picked = np.take(values, self._output_columns, axis=-1)
        return _convert(picked, self._outward)

    def shown_inputs(self, values: Vector) -> Vector:
        """Return the shown inputs for the component's, shape (n_u,)."""
        picked = np.take(values, self._input_columns)
        outward = _conversions(self.inputs, outward=True)
        return _convert(picked, outward)

    def shown_linearized(self, own: Linearized) -> Linearized:
        """Return a linearization between shown ports for that of the component."""
        B, C, D = self.shown_matrices(own.B, own.C, own.D)
        return replace(own, B=B, C=C, D=D, corrected=own.follows[self._output_columns])

    def shown_matrices(self, B: Matrix, C: Matrix, D: Matrix) -> tuple[Matrix, Matrix, Matrix]:
        """Return B, C and D between shown ports for those of the component."""
        inward = _factors(self._inward)
        outward = _factors(self._outward)[:, np.newaxis]
        picked = D[np.ix_(self._output_columns, self._input_columns)]
        return (
            B[:, self._input_columns] * inward,
            outward * C[self._output_columns],
            outward * picked * inward,
        )

    @property
    def keeps_places(self) -> bool:
        """Whether every element, and its value, stands where it stands in the component."""
        inputs = np.arange(self.component.n_u)
        outputs = np.arange(self.component.n_y)
        same_inputs = np.array_equal(self._input_columns, inputs)
        same_outputs = np.array_equal(self._output_columns, outputs)
        copies = all(conversion.copies for conversion in (*self._inward, *self._outward))
        return same_inputs and same_outputs and copies

    def input_elements(self) -> list[ElementSource]:
        """Return for every input element of the component where it stands in those shown."""
        columns = self._shown_columns.tolist()
        return [_element(column, self._inward[column]) for column in columns]

    def output_elements(self) -> list[ElementSource]:
        """Return for every shown output element where it stands in those of the component."""
        pairs = zip(self._output_columns.tolist(), self._outward, strict=True)
        return [_element(column, conversion) for column, conversion in pairs]

    @cached_property
    def _input_columns(self) -> NDArray[np.intp]:
        """Column of the component for every shown input element."""
        return _columns(self.inputs)

    @cached_property
    def _output_columns(self) -> NDArray[np.intp]:
        """Column of the component for every shown output element."""
        return _columns(self.outputs)

    @cached_property
    def _shown_columns(self) -> NDArray[np.intp]:
        """Shown column for every input element of the component."""
        return np.argsort(self._input_columns)

    @cached_property
    def _inward(self) -> list[Conversion]:
        return _conversions(self.inputs, outward=False)

    @cached_property
    def _outward(self) -> list[Conversion]:
        return _conversions(self.outputs, outward=True)


def _columns(ports: Iterable[ShownPort]) -> NDArray[np.intp]:
    columns: list[int] = []
    for port in ports:
        columns += [element.column for element in port.elements]
    return np.array(columns, np.intp)


def _conversions(ports: Iterable[ShownPort], *, outward: bool) -> list[Conversion]:
    """Return the conversion of every shown element, from the component's unit if ``outward``."""
    conversions = []
    for port in ports:
        shown = port.signal.measures
        own = [element.measure for element in port.elements]
        for convert in conversions_between(*((own, shown) if outward else (shown, own))):
            assert convert is not None
            conversions.append(convert)
    return conversions


def _convert(values: Matrix, conversions: Sequence[Conversion]) -> Matrix:
    if all(conversion.copies for conversion in conversions):
        return values
    converted = values.copy()
    for column, convert in enumerate(conversions):
        converted[..., column] = convert(values[..., column])
    return converted


def _element(column: int, conversion: Conversion) -> ElementSource:
    first = (conversion.factor1, conversion.offset1)
    second = (conversion.offset2, conversion.factor2)
    return ElementSource(column, not conversion.copies, *first, *second)


def _factors(conversions: Iterable[Conversion]) -> Vector:
    return np.array([conversion.factor for conversion in conversions], np.float64)


def names_of(elements: Iterable[PortElement]) -> list[str]:
    """Return the names of elements; that of the signal where all of it is there, in order."""
    groups: dict[str, list[PortElement]] = {}
    for element in elements:
        groups.setdefault(element.signal.name, []).append(element)
    names = []
    for name, parts in groups.items():
        size = parts[0].signal.size
        indices = [part.index for part in parts]
        if len(indices) == size and indices == list(range(size)):
            names.append(name)
        else:
            names += [part.name for part in parts]
    return names
