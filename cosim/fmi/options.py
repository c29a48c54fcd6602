"""The options that an FMU is opened with."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Final

from cosim.fmi.description import InterfaceType
from cosim.fmi.driving.initialization import Starts
from cosim.fmi.driving.residual import DaeForm


@dataclass(frozen=True, slots=True)
class FmuOptions:
    """How an FMU is opened.

    ``solver``, ``tolerance``, ``max_step`` and ``dae`` are for model exchange.

    Parameters
    ----------
    interface_type : {"me", "cs"} or None
        Model exchange or co-simulation; None: the one that the FMU has, model exchange where it
        has both.
    solver : str or None
        One of ``cosim.fmi.driving.solvers.STEPPING``; None: ``RK45``.
    tolerance : float or None
        Relative tolerance of the states, for the solvers that keep one; None: 1e-9.
    max_step : float or None
        The longest step of the solver [s]; None: as long as the tolerance allows.
    dae : {"ode", "residual"}
        Of an FMU with a residual form (FMI-LS-DAE): which of its forms is integrated.
    start : mapping of variable name to StartValue
        Values for the variables' ``start``, instead of the FMU's own: numbers, Booleans, items of
        enumerations, texts, lists; see ``cosim.fmi.driving.initialization``.
    outputs : sequence of str
        Names of local variables and parameters that become outputs too.
    apart : collection of str
        Names of variables that are signals of their own, though they may look like elements.
    called : collection of str
        Of an input that has several names, the one that it has as a port; it may have others, too.
    step : float or None
        The communication step of the run [s], with which saving its state is tried; None: one that
        the FMU prefers, or takes.
    """

    interface_type: InterfaceType | None = None
    solver: str | None = None
    tolerance: float | None = None
    max_step: float | None = None
    dae: DaeForm = "ode"
    start: Starts = field(default_factory=dict)
    outputs: Sequence[str] = ()
    apart: Collection[str] = ()
    called: Collection[str] = ()
    step: float | None = None


DEFAULT_OPTIONS: Final = FmuOptions()
