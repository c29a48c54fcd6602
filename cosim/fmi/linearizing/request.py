"""What a linearization is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from cosim.fmi.driving.initialization import Starts
from cosim.fmi.linearizing.linearization import Method


@dataclass(frozen=True, slots=True)
class LinearizationRequest:
    """Where and with respect to what an instance for model exchange is linearized.

    Parameters
    ----------
    at, start, inputs, outputs, states, method
        As of :func:`cosim.linearize`.
    """

    at: float = 0.0
    start: Starts = field(default_factory=dict)
    inputs: Sequence[str] | None = None
    outputs: Sequence[str] | None = None
    states: Sequence[str] | None = None
    method: Method | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the request as JSON keeps it."""
        values = asdict(self)
        for key in ("inputs", "outputs", "states"):
            names = values[key]
            values[key] = None if names is None else list(names)
        return values
