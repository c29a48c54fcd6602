"""The unknown-input observer (18) with disturbance reconstruction (19)-(20) as a model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from cosim.blocks.plant import linear_model
from cosim.core.linear import LinearModel
from cosim.core.signals import Signal
from cosim.theory.descriptor import ReducedSystem
from cosim.theory.observer import ObserverDesign, initial_state_map, realize


def observer_model(
    reduced: ReducedSystem,
    design: ObserverDesign,
    *,
    x_a0: ArrayLike | None = None,
    q0: ArrayLike | None = None,
    constant: bool = False,
) -> LinearModel:
    """Write the observer as a model: inputs u and y; outputs x_a, delta, x_b (estimates), z and q (its states).

    Where there is no u or x_b, there is no such signal.

    Parameters
    ----------
    reduced : ReducedSystem
        What the observer believes.
    design : ObserverDesign
    x_a0 : ArrayLike, shape (n_a,), optional
        First estimate; left out: consistent with y(0).
    q0 : ArrayLike, shape (n_y,), optional
        Start of the derivative filter; left out: at the signal, without a transient.
    constant : bool
        The last input of ``reduced`` is the constant 1: no input of the model, but a state ``one`` that stays at 1.
    """
    system = realize(reduced, design)
    X0, Xu = initial_state_map(reduced, design, x_a0=x_a0, q0=q0)
    n, n_y, n_d, n_b = len(reduced.A_a), len(reduced.C3), reduced.B_2a.shape[1], len(reduced.Kx)
    outputs = [Signal("x_a", n, role="estimate"), Signal("delta", n_d, role="estimate")]
    if n_b:
        outputs.append(Signal("x_b", n_b, role="estimate"))
    states = [Signal("z", n, role="state"), Signal("q", n_y, role="state")]
    inputs = [Signal("u", reduced.B_1a.shape[1], role="input")] if reduced.B_1a.size else []
    model = linear_model(
        (*inputs, Signal("y", n_y, role="input")),
        (*outputs, *states),
        states=tuple(element for signal in states for element in signal.elements),
        A=system.A,
        B=system.B,
        C=system.C,
        D=system.D,
        X0=X0,
        Xu=Xu,
    )
    return _with_one(model) if constant else model


def _with_one(model: LinearModel) -> LinearModel:
    """Turn the last element of u into a state that stays at 1."""
    u, y = model.interface.inputs
    column, n = u.size - 1, len(model.states)
    one, others = [column], [i for i in range(model.interface.n_u) if i != column]
    return linear_model(
        (*([replace(u, size=u.size - 1)] if u.size > 1 else []), y),
        model.interface.outputs,
        states=(*model.states, "one"),
        A=np.block([[model.A, model.B[:, one]], [np.zeros((1, n + 1))]]),
        B=np.vstack([model.B[:, others], np.zeros((1, len(others)))]),
        C=np.hstack([model.C, model.D[:, one]]),
        D=model.D[:, others],
        X0=np.concatenate([model.X0 + model.Xu[:, column], [1.0]]),
        Xu=np.vstack([model.Xu[:, others], np.zeros((1, len(others)))]),
    )
