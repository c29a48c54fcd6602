"""The component of an FMU, with what the FMU changes of the process put back after every call."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Protocol, TypeVar, final

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import (
    Component,
    Design,
    InputWiring,
    Linearizable,
    PreparableSubsteps,
    Rollback,
    Stopped,
    first_event,
    left_limits,
    take_wiring,
)
from cosim.core.linearization import Linearized
from cosim.core.signals import Interface
from cosim.errors import RunError
from cosim.fmi.binary.messages import Message
from cosim.fmi.binary.process import ROUNDING, Process, describe_changes
from cosim.fmi.driving.diagnostics import Diagnostics
from cosim.fmi.driving.tuning import TunedParameters
from cosim.native.fmi.process import GuardedStruct, guarded_step
from cosim.native.step import Guard, NativeStep

Result = TypeVar("Result")


class FmuComponent(Component, PreparableSubsteps, Rollback[Any], Linearizable, Protocol):
    """What ``ModelExchange`` and ``CoSimulation`` have in common."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What is to be known about the results."""
        ...

    def native(self) -> NativeStep | None:
        """Return the compiled step, if there is one."""
        ...

    def tune(self, t: float, parameters: TunedParameters) -> None:
        """Set tunable parameters at ``t``, the time reached."""
        ...

    def drain(self) -> list[Message]:
        """Return the events and warnings since the last call."""
        ...

    def discard(self) -> None:
        """Forget all events and warnings, so that each may come again."""
        ...


@final
class SharedGuard:
    """Puts back what compiled steps of one or several FMUs change of the process.

    How numbers are computed they put back themselves, after every step; the rest, above all what
    all threads share, is looked at after many steps.

    Parameters
    ----------
    names : sequence of str
        Of the FMUs.
    binaries : frozenset of str
        What their binaries are known by.
    steps : sequence of GuardedStruct
        The compiled steps.
    diagnostics : Diagnostics
        Takes the report; those of the first FMU.
    """

    def __init__(
        self,
        names: Sequence[str],
        binaries: frozenset[str],
        steps: Sequence[GuardedStruct],
        diagnostics: Diagnostics,
    ) -> None:
        self._names = tuple(names)
        self.binaries = binaries
        self._steps = tuple(steps)
        self._diagnostics = diagnostics
        self._process = Process()

    def begin(self) -> None:
        """Remember the process, for the steps too."""
        self._process.save()
        for step in self._steps:
            step.process = self._process.address

    def end(self, t: float) -> None:
        """Put back and report what changed in the call that began at ``t`` [s]."""
        changes = self._process.restore()
        if not changes:
            return
        what = describe_changes(changes)
        others = ", ".join(self._names[1:])
        who = f"it, or one of {others}, " if others else ""
        self._diagnostics.add(t, what, f"{who}changed {what}; it is as before again")

    def joined(self, others: Sequence[Guard]) -> Guard:
        """Return one for the FMUs of all."""
        names = list(self._names)
        binaries = self.binaries
        steps = list(self._steps)
        for other in others:
            assert isinstance(other, SharedGuard)  # all foreign code is that of FMUs
            names += other._names
            binaries |= other.binaries
            steps += other._steps
        return SharedGuard(names, binaries, steps, self._diagnostics)


@final
class Guarded:
    """Passes every call on.

    After a call in which the rounding mode changed the run ends: the rows of that call were
    computed with it, in part at least, and are left out. Other changes are put back and reported,
    each set of them once.

    Parameters
    ----------
    component : FmuComponent
    name : str
        Names the FMU in messages.
    binary : str
        What its binary is known by.
    called : int or None
        The address of its messages; None: it is no loaded FMU.
    """

    def __init__(
        self, component: FmuComponent, name: str, binary: str, *, called: int | None = None
    ) -> None:
        self.component = component
        self._name = name
        self._binary = binary
        self._called = called
        self._process = Process(called)
        self._diagnostics = Diagnostics(name)
        self._compiled = GuardedStruct()  # what compiled steps found

    @property
    def interface(self) -> Interface:
        """Inputs, outputs and feedthrough."""
        return self.component.interface

    @property
    def notes(self) -> tuple[str, ...]:
        """What is to be known about the results."""
        return self.component.notes

    def take_wiring(self, wiring: InputWiring) -> None:
        """Pass on."""
        take_wiring(self.component, wiring)

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Pass on."""
        return self.component.prepare(h, held, recorded)

    def prepare_substeps(self, lengths: tuple[float, ...], recorded: Design) -> Design:
        """Prepare the component."""
        return self._call(None, lambda: self.component.prepare_substeps(lengths, recorded))

    def initialize(self, t: float, u: Vector) -> Vector:
        """Pass on."""
        return self._call(t, lambda: self.component.initialize(t, u))

    def outputs(self, t: float, u: Vector) -> Vector:
        """Pass on."""
        return self._call(t, lambda: self.component.outputs(t, u))

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Pass on."""
        return self._call(float(t[0]), lambda: self.component.advance(t, h, u))

    def left_limits(self, t: Vector) -> Mapping[int, Vector]:
        """Pass on: the FMU is not called."""
        return left_limits(self.component, t)

    def native(self) -> NativeStep | None:
        """Return the compiled step of the component, with the floating-point unit put back."""
        step = self.component.native()
        if step is None:
            return None
        guarded, self._compiled = guarded_step(step, self._called)
        binaries = frozenset([self._binary])
        guarded.guard = SharedGuard([self._name], binaries, [self._compiled], self._diagnostics)
        return guarded

    def linearized(self, t: float, u: Vector) -> Linearized | None:
        """Pass on."""
        return self._call(t, lambda: self.component.linearized(t, u))

    def first_event(self) -> float:
        """Pass on."""
        return first_event(self.component)

    def save(self) -> tuple[Any, int]:
        """Copy the state of the component, with what is known of it."""
        state = self._call(None, self.component.save)
        return state, self._diagnostics.save()

    def restore(self, state: tuple[Any, int]) -> None:
        """Go back to a saved state."""
        of_component, of_diagnostics = state
        self._call(None, lambda: self.component.restore(of_component))
        self._diagnostics.restore(of_diagnostics)

    def tune(self, t: float, parameters: TunedParameters) -> None:
        """Pass on."""
        self._call(t, lambda: self.component.tune(t, parameters))

    @contextmanager
    def outside(self, t: float | None) -> Iterator[None]:
        """Put back what changes in a call that is no part of the run; only report it."""
        self._process.save()
        try:
            yield
        finally:
            self._put_back(t)

    def drain(self) -> list[Message]:
        """Return the events and warnings since the last call."""
        self._report_compiled()
        return self.component.drain() + self._diagnostics.drain()

    def discard(self) -> None:
        """Forget all events and warnings, so that each may come again."""
        self._report_compiled()
        self.component.discard()
        self._diagnostics.discard()

    def _call(self, t: float | None, call: Callable[[], Result]) -> Result:
        """Return what a call of the run returns, and put back what it changed.

        Raises
        ------
        RunError
            If it changed the rounding mode; also in the place of a stop, which brings rows.
        """
        compiled = self._compiled
        if compiled.distrusted:
            # A compiled step ended well, but with another rounding mode: there is nothing to call.
            compiled.distrusted = 0
            self._report_compiled()
            raise RunError(self._distrust(compiled.time))
        self._process.save()
        try:
            result = call()
        except Stopped as stop:
            if self._put_back(t) & ROUNDING:
                raise RunError(f"{self._distrust(t)}; the call ended with: {stop}") from stop
            raise
        except BaseException:
            self._put_back(t)
            raise
        if self._put_back(t) & ROUNDING:
            raise RunError(self._distrust(t))
        return result

    def _distrust(self, t: float | None) -> str:
        call = "a call for its state" if t is None else f"a call at t = {t} s or after it"
        return (
            f"{self._name}: changed {describe_changes(ROUNDING)} in {call}; it is as before "
            "again, but what was computed since then is not to be relied on, and left out"
        )

    def _put_back(self, t: float | None) -> int:
        changes = self._process.restore()
        self._report(t, changes)
        return changes | self._report_compiled()

    def _report_compiled(self) -> int:
        """Report what compiled steps changed since the last time; return it.

        It is put back already.
        """
        compiled = self._compiled
        changes: int = compiled.changes
        compiled.changes = 0
        self._report(compiled.time, changes)
        return changes

    def _report(self, t: float | None, changes: int) -> None:
        if changes:
            what = describe_changes(changes)
            self._diagnostics.add(t, what, f"changed {what}; it is as before again")
