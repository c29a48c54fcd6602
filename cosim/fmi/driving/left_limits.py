"""What the outputs of an FMU were before events of its own at the ends of its last steps."""

from __future__ import annotations

from typing import final

from cosim.arrays import Vector
from cosim.fmi.description import Description


def jumping_outputs(description: Description) -> tuple[str, ...]:
    """Return the outputs that may jump in events of the FMU's own: the continuous ones."""
    outputs = description.interface.outputs
    return tuple(signal.name for signal in outputs if signal.variability == "continuous")


@final
class LeftLimits:
    """Outputs before events, by the times of the last steps."""

    def __init__(self) -> None:
        self._outputs: dict[float, Vector] = {}

    def clear(self) -> None:
        """Forget those of the steps before."""
        self._outputs.clear()

    def keep(self, t: float, outputs: Vector | None) -> None:
        """Keep the outputs, shape (n_y,), before an event at ``t`` [s]; None: there was none."""
        if outputs is not None:
            self._outputs[t] = outputs

    def at(self, t: Vector) -> dict[int, Vector]:
        """Return those that there are, by place in ``t`` [s]."""
        kept = self._outputs
        return {place: kept[time] for place, time in enumerate(t.tolist()) if time in kept}
