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
    """Write the observer as a model.

    Inputs u and y; outputs the estimates x_a, delta, x_b and the states z, q. Where there is no u
    or x_b, there is no such signal.

    Parameters
    ----------
    reduced : ReducedSystem
        The design model.
    design : ObserverDesign
    x_a0 : ArrayLike, shape (n_a,), optional
        Initial estimate; by default consistent with y(0).
    q0 : ArrayLike, shape (n_y,), optional
        Initial state of the derivative filter; by default the signal, without a transient.
    constant : bool
        The last input of ``reduced`` is the constant 1: no input of the model, but a state ``one``
        that stays at 1.
    """
    system = realize(reduced, design)
    X0, Xu = initial_state_map(reduced, design, x_a0=x_a0, q0=q0)
    n_a, n_u = reduced.B_1a.shape
    n_y, n_d = reduced.C5.shape
    n_b = len(reduced.Kx)
    inputs = [Signal("u", n_u, role="input")] if n_u else []
    inputs.append(Signal("y", n_y, role="input"))
    outputs = [Signal("x_a", n_a, role="estimate"), Signal("delta", n_d, role="estimate")]
    if n_b:
        outputs.append(Signal("x_b", n_b, role="estimate"))
    z = Signal("z", n_a, role="state")
    q = Signal("q", n_y, role="state")
    states = (*z.elements, *q.elements)
    A = system.A
    B = system.B
    C = system.C
    D = system.D
    outputs += [z, q]
    model = linear_model(
        tuple(inputs), tuple(outputs), states=states, A=A, B=B, C=C, D=D, X0=X0, Xu=Xu
    )
    return _with_constant_state(model) if constant else model


def _with_constant_state(model: LinearModel) -> LinearModel:
    """Turn the last element of u into a state that stays at 1."""
    u, y = model.interface.inputs
    column = u.size - 1
    others = [i for i in range(model.interface.n_u) if i != column]
    inputs = (y,) if column == 0 else (replace(u, size=column), y)
    from_one = model.B[:, [column]]
    to_one = np.zeros((1, len(model.states) + 1))
    no_input = np.zeros((1, len(others)))
    A = np.block([[model.A, from_one], [to_one]])
    B = np.vstack([model.B[:, others], no_input])
    C = np.hstack([model.C, model.D[:, [column]]])
    D = model.D[:, others]
    x0 = model.X0 + model.Xu[:, column]
    X0 = np.concatenate([x0, [1.0]])
    Xu = np.vstack([model.Xu[:, others], no_input])
    states = (*model.states, "one")
    outputs = model.interface.outputs
    return linear_model(inputs, outputs, states=states, A=A, B=B, C=C, D=D, X0=X0, Xu=Xu)
