"""The steps of ``wrapping.c``: components inside others."""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import Array, Structure, addressof, c_double, c_int32, c_void_p
from typing import NamedTuple

import numpy as np

from cosim.arrays import Vector
from cosim.native.library import address, int32, pointer
from cosim.native.step import NativeStep


class InnerStruct(Structure):
    """cosim_inner."""

    _fields_ = tuple((name, c_void_p) for name in ("step", "outputs", "self"))


class KeptStruct(Structure):
    """cosim_kept."""

    _fields_ = (("inner", InnerStruct), ("width", c_int32), ("last", c_void_p))


def inner_struct(step: NativeStep) -> InnerStruct:
    """Return the struct of a step inside another, which it must not outlive."""
    return InnerStruct(step.function, step.outputs, step.address)


def kept_step(step: NativeStep, last: Vector) -> NativeStep:
    """Build a step whose outputs stay until the next one; its memory is ``last``, these outputs.

    Whatever else changes is in the memory of ``step``.
    """
    state = KeptStruct(inner_struct(step), step.n_y, pointer(last))
    return _wrapped("cosim_kept", state, last, step.n_y, [step])


class SampledStruct(Structure):
    """cosim_sampled."""

    _fields_ = (
        ("inner", InnerStruct),
        *((name, c_int32) for name in ("steps", "n_u", "n_y")),
        ("h", c_double),
        ("memory", c_void_p),
    )


class DecimatedStruct(Structure):
    """cosim_decimated."""

    _fields_ = (
        ("inner", InnerStruct),
        *((name, c_int32) for name in ("steps", "n_y")),
        ("memory", c_void_p),
    )


class ElementStruct(Structure):
    """cosim_element."""

    _fields_ = (
        *((name, c_int32) for name in ("from", "converts")),
        *((name, c_double) for name in ("factor1", "offset1", "offset2", "factor2")),
    )


class PortsStruct(Structure):
    """cosim_ports."""

    _fields_ = (
        ("inner", InnerStruct),
        *((name, c_int32) for name in ("n_u", "n_y")),
        *((name, c_void_p) for name in ("inputs", "outputs", "work")),
    )


class PartStruct(Structure):
    """cosim_part."""

    _fields_ = (
        ("inner", InnerStruct),
        *((name, c_int32) for name in ("n_u", "n_y")),
        *((name, c_void_p) for name in ("columns", "u")),
    )


class PartsStruct(Structure):
    """cosim_parts."""

    _fields_ = (("count", c_int32), ("parts", c_void_p))


class SampledMemory:
    """What changes in a component that advances by larger steps.

    Parameters
    ----------
    n_u, n_y : int

    Attributes
    ----------
    values : Vector
        All of it.
    u_begin : Vector, shape (n_u,)
        Inputs where its own step began.
    y : Vector, shape (n_y,)
        The outputs that are held.
    """

    def __init__(self, n_u: int, n_y: int) -> None:
        self.values = np.zeros(2 + n_u + n_y)
        self.u_begin = self.values[2 : 2 + n_u]
        self.y = self.values[2 + n_u :]

    @property
    def steps(self) -> int:
        """Communication steps since its own step began; negative before the first one."""
        return int(self.values[0])

    @steps.setter
    def steps(self, steps: int) -> None:
        self.values[0] = steps

    @property
    def begin(self) -> float:
        """Time where its own step began [s]."""
        return float(self.values[1])

    @begin.setter
    def begin(self, t: float) -> None:
        self.values[1] = t


def sampled_step(step: NativeStep, memory: SampledMemory, *, steps: int, h: float) -> NativeStep:
    """Build a step that takes one of a component, ``h`` [s] long, in every ``steps`` of its own."""
    n_u = len(memory.u_begin)
    values = memory.values
    state = SampledStruct(inner_struct(step), steps, n_u, step.n_y, h, pointer(values))
    return _wrapped("cosim_sampled", state, values, step.n_y, [step])


class DecimatedMemory:
    """What changes in a component whose outputs are sampled.

    Parameters
    ----------
    n_y : int

    Attributes
    ----------
    values : Vector
        All of it, and scratch.
    y : Vector, shape (n_y,)
        The outputs that are held.
    """

    def __init__(self, n_y: int) -> None:
        self.values = np.zeros(1 + 2 * n_y)
        self.y = self.values[1 : 1 + n_y]

    @property
    def steps(self) -> int:
        """Communication steps since the last sample."""
        return int(self.values[0])

    @steps.setter
    def steps(self, steps: int) -> None:
        self.values[0] = steps


def decimated_step(step: NativeStep, memory: DecimatedMemory, *, steps: int) -> NativeStep:
    """Build a step that passes on the outputs of every one in ``steps``, and holds them between."""
    values = memory.values
    state = DecimatedStruct(inner_struct(step), steps, step.n_y, pointer(values))
    return _wrapped("cosim_decimated", state, values, step.n_y, [step])


class ElementSource(NamedTuple):
    """Where an element stands, and ``((v factor1 + offset1) - offset2) / factor2`` if converted."""

    column: int
    converts: bool
    factor1: float
    offset1: float
    offset2: float
    factor2: float


def ports_step(
    step: NativeStep, inputs: Sequence[ElementSource], outputs: Sequence[ElementSource]
) -> NativeStep:
    """Build a step with other ports: its inputs by those shown, the shown outputs by its own."""
    n_u = len(inputs)
    n_y = len(outputs)
    of_inputs = _elements(inputs)
    of_outputs = _elements(outputs)
    work = np.zeros(2 * n_u + step.n_y)
    elements = (addressof(of_inputs), addressof(of_outputs))
    state = PortsStruct(inner_struct(step), n_u, n_y, *elements, pointer(work))
    no_memory = np.zeros(0)
    return _wrapped("cosim_ports", state, no_memory, n_y, [step], of_inputs, of_outputs, work)


def _elements(elements: Sequence[ElementSource]) -> Array[ElementStruct]:
    structs = (ElementStruct * max(len(elements), 1))()
    for i, element in enumerate(elements):
        structs[i] = ElementStruct(*element)
    return structs


def parts_step(parts: Sequence[tuple[NativeStep, Sequence[int]]]) -> NativeStep:
    """Build the steps of components side by side, none of which ever declines.

    Parameters
    ----------
    parts : sequence of (NativeStep, sequence of int)
        Each with the columns of its inputs; the outputs stand one behind the other.
    """
    structs = (PartStruct * len(parts))()
    keep: list[object] = [structs]
    for i, (step, columns) in enumerate(parts):
        of_inputs = int32(columns)
        u = np.zeros(2 * len(columns))
        arrays = (pointer(of_inputs), pointer(u))
        structs[i] = PartStruct(inner_struct(step), len(columns), step.n_y, *arrays)
        keep += [of_inputs, u]
    steps = [step for step, _ in parts]
    n_y = sum(step.n_y for step in steps)
    state = PartsStruct(len(parts), addressof(structs))
    no_memory = np.zeros(0)
    return _wrapped("cosim_parts", state, no_memory, n_y, steps, *keep)


def _wrapped(
    name: str,
    state: Structure,
    memory: Vector,
    n_y: int,
    steps: Sequence[NativeStep],
    *keep: object,
) -> NativeStep:
    """Build the step ``name_step`` with the outputs ``name_outputs``, of some steps inside it.

    Foreign code among these needs its guard here too: without it, it has nothing to remember the
    process in.
    """
    guards = [step.guard for step in steps if step.guard is not None]
    return NativeStep(
        address(f"{name}_step"),
        state,
        n_y=n_y,
        memory=memory,
        keep=(*steps, *keep),
        outputs=address(f"{name}_outputs"),
        guard=guards[0].joined(guards[1:]) if guards else None,
    )
