"""The unknown-input observer (18) with disturbance reconstruction (19)-(20) as a model."""

from __future__ import annotations

from numpy.typing import ArrayLike

from cosim.blocks.plant import linear_model
from cosim.core.signals import Signal
from cosim.core.solver import LinearModel
from cosim.theory.descriptor import ReducedSystem
from cosim.theory.observer import ObserverDesign, realise, start


def observer_model(
    reduced: ReducedSystem, design: ObserverDesign, *, x_a0: ArrayLike | None = None, q0: ArrayLike | None = None
) -> LinearModel:
    """Write the observer as a model: inputs u and y; outputs x_a, delta, x_b (estimates), z and q (its states).

    Parameters
    ----------
    reduced : ReducedSystem
        What the observer believes.
    design : ObserverDesign
    x_a0 : ArrayLike, shape (n_a,), optional
        First estimate; left out: consistent with y(0).
    q0 : ArrayLike, shape (n_y,), optional
        Start of the derivative filter; left out: at the signal, without a transient.
    """
    system = realise(reduced, design)
    X0, Xu = start(reduced, design, x_a0=x_a0, q0=q0)
    n, n_y, n_d, n_b = len(reduced.A_a), len(reduced.C3), reduced.B_2a.shape[1], len(reduced.Kx)
    outputs = [Signal("x_a", n, role="estimate"), Signal("delta", n_d, role="estimate")]
    if n_b:
        outputs.append(Signal("x_b", n_b, role="estimate"))
    states = [Signal("z", n, role="state"), Signal("q", n_y, role="state")]
    return linear_model(
        (Signal("u", reduced.B_1a.shape[1], role="input"), Signal("y", n_y, role="input")),
        (*outputs, *states),
        states=tuple(element for signal in states for element in signal.elements),
        A=system.A,
        B=system.B,
        C=system.C,
        D=system.D,
        X0=X0,
        Xu=Xu,
    )
