"""A co-simulation unit as a component.

``stepping.py`` says what happens in a communication step. The end of the run that a unit asks for is remembered, and comes with
the next ``advance`` at the latest.
"""

from __future__ import annotations

from dataclasses import replace
from typing import final

import numpy as np
from numpy.typing import NDArray

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.contracts import Design, Stopped
from cosim.errors import FmuError, RunError
from cosim.fmi.binary.messages import Message
from cosim.fmi.description import Description
from cosim.fmi.driving.diagnostics import Diagnostics
from cosim.fmi.driving.direct import Direct
from cosim.fmi.driving.initialization import Initialization, Starts
from cosim.fmi.driving.inner_step import InnerStep
from cosim.fmi.driving.saved import SavedState, save
from cosim.fmi.driving.stepping import Stepper
from cosim.fmi.instance import TERMINATED, CoSimulationInstance


@final
class CoSimulation:
    """A co-simulation unit.

    Parameters
    ----------
    unit : CoSimulationInstance
        Just instantiated.
    starts : mapping of variable name to StartValue
        Start values to set instead of the unit's own.

    Raises
    ------
    FmuError
        If a start value is wrong.
    """

    def __init__(self, instance: CoSimulationInstance, *, starts: Starts | None = None) -> None:
        description = instance.description
        self._instance, self._name = instance, description.name
        self.interface = replace(
            instance.interface,
            prepares=True,
            rollback=instance.description.capabilities["cs"].saves_state,
        )
        self._start = Initialization(instance, starts or {})
        self._can = description.capabilities["cs"]
        self._in_events = frozenset(
            s.name
            for s in self.interface.inputs
            if self._can.event_mode and s.variability == "discrete"
        )
        self._direct = (
            Direct(instance, self._in_events) if self._can.directional_derivatives else None
        )
        self._copy: object | None = (
            None  # of the unit's state before an event that is only shown; its memory is used again
        )
        self._inner_step = InnerStep(_watched(description))
        self._remarks = Diagnostics(self._name)
        self._stepping = Stepper(instance, self._remarks)

    def prepare(self, h: float, held: Mask, recorded: Design) -> Design:
        """Learn which inputs are held; nothing is designed.

        Raises
        ------
        FmuError
            If the unit has a fixed inner step and ``h`` is not a whole number of them.
        """
        fixed = self._can.fixed_step
        if fixed and not self._can.variable_step and abs(round(h / fixed) * fixed - h) > 1e-9 * h:
            raise FmuError(
                f"{self._name}: the communication step {h} s is not a whole number of the unit's inner steps of {fixed} s; "
                f"nearest: {max(1, round(h / fixed)) * fixed} s"
            )
        self._stepping.hold(held)
        return {}

    @property
    def notes(self) -> tuple[str, ...]:
        """What is to be known about the results."""
        face = self.interface
        corrected = self._direct.corrected if self._direct else ()
        fed = [
            o.name
            for o in face.outputs
            if o.name not in corrected and not self._in_events.issuperset(face.feeds(o.name))
        ]
        if not fed:
            return ()
        verb = (
            "may depend"
            if not all(face.knows(name) for name in fed)
            else "depend"
            if len(fed) > 1
            else "depends"
        )
        where = (
            "where inputs are held, what is read belongs to their value"
            if self._stepping.now.interpolates
            else "what is read belongs to the inputs"
        )
        why = (
            "directional derivatives are for real variables"
            if self._direct
            else "the unit has no directional derivatives"
        )
        return (
            f"{self._name}: {', '.join(fed)} {verb} directly on inputs; {where} inside the step, not at its end (first order in "
            f"the step), as {why}",
        )

    def initialize(self, t: float, u: Vector) -> Vector:
        """Start at ``t``; stays in initialization mode until the first advance."""
        u = np.array(u, np.float64)
        y = self._start.enter(t, u)
        self._stepping.begin(u, y)
        self._inner_step.reset()
        return y.copy()

    def outputs(self, t: float, u: Vector) -> Vector:
        """Give the outputs last read, corrected to the inputs ``u`` where D is known; after an event where one is due."""
        self._leave_initialization(t)
        return self._look(t, np.array(u, np.float64)).copy()

    def advance(self, t: Vector, h: float, u: Matrix) -> Matrix:
        """Step K times; see :class:`cosim.core.contracts.Component`."""
        rows, instants, stepping, k = (
            list(np.array(u, np.float64, order="C")),
            t.tolist(),
            self._stepping,
            0,
        )
        y = np.empty((len(rows) - 1, self.interface.n_y))
        try:
            self._leave_initialization(instants[0])
            for k, t1 in enumerate(instants[1:]):
                completed = stepping.step(instants[k], h, rows[k], rows[k + 1])
                if completed:
                    self._look_for_an_inner_step(t1, h)
                    if k < len(y) - 1:
                        stepping.jump(t1, rows[k + 1])
                    y[k] = self._look(t1, rows[k + 1])
                if stepping.now.ended:
                    raise Stopped(y[: k + completed].copy(), TERMINATED, failed=False)
        except Stopped:
            raise
        except RunError as error:
            raise Stopped(y[:k].copy(), str(error)) from error
        return y

    def _leave_initialization(self, t: float) -> None:
        if self._start.leave():
            self._stepping.leave_initialization(t)

    def _look(self, t: float, u: Vector) -> Vector:
        """Give the outputs at ``t``, the time reached, for inputs ``u``; goes back before an event, if the unit can."""
        stepping = self._stepping
        if not (self._can.saves_state and stepping.jumps(u)):
            stepping.jump(t, u)
            return self._outputs_for(u)
        self._copy, before = self._instance.get_fmu_state(self._copy), stepping.save()
        stepping.jump(t, u)
        y = self._outputs_for(u)
        if not stepping.now.ended:
            self._instance.set_fmu_state(self._copy)
            stepping.restore(before)
        return y

    def _outputs_for(self, u: Vector) -> Vector:
        """Give y + D (u - u_end)."""
        now = self._stepping.now
        return (
            now.read
            if self._direct is None or u is now.end
            else self._direct.add(now.read, u - now.end)
        )

    # --- messages, states ---

    def _look_for_an_inner_step(self, t: float, h: float) -> None:
        n = self._inner_step.see(self._stepping.now.read, self._stepping.now.end)
        if n:
            self._remarks.add(
                t,
                "inner step",
                f"its outputs change at every {_ordinal(n)} communication step only: it seems to keep an inner step of "
                f"{n * h:.12g} s and to ignore the communication step of {h} s",
            )

    def drain(self) -> list[Message]:
        """Give what the run showed about the unit since the last call; each kind is said once."""
        return self._remarks.drain()

    def save(self) -> SavedState:
        """Copy the state.

        Raises
        ------
        FmuError
            If the unit cannot.
        """
        return save(
            self._instance, self._can, (self._start.t, self._stepping.save(), self._inner_step.seen)
        )

    def restore(self, state: SavedState) -> None:
        """Go back to a saved state."""
        self._instance.set_fmu_state(state.instance)
        self._start.t, stepping, self._inner_step.seen = state.own  # type: ignore[assignment]
        self._stepping.restore(stepping)  # type: ignore[arg-type]


def _watched(description: Description) -> NDArray[np.intp]:
    """Give the outputs that show whether time moves in the unit: real, continuous, if possible not fed directly by inputs."""
    face = description.interface
    moving = [
        output
        for output in face.outputs
        if output.kind == "real" and output.variability == "continuous"
    ]
    chosen = {o.name for o in moving if not face.feeds(o.name)} or {o.name for o in moving}
    columns = face.output_columns()
    return np.array(
        [
            i
            for name in columns
            if name in chosen
            for i in range(columns[name].start, columns[name].stop)
        ],
        np.intp,
    )


def _ordinal(n: int) -> str:
    ending = "th" if 10 <= n % 100 <= 20 else {1: "st", 2: "nd", 3: "rd"}.get(n % 10, "th")
    return f"{n}{ending}"
