"""The unknown-input observer (18) with disturbance reconstruction (19)-(20) as a model."""

from __future__ import annotations

from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from cosim.arrays import Matrix, Vector
from cosim.core.linear import LinearModel, with_dependencies
from cosim.core.signals import Interface, Signal
from cosim.theory.observers.observer import (
    ObserverDesign,
    StateSpace,
    initial_state_map,
    lagging_states,
    realize,
    realize_averages,
)
from cosim.theory.plants.descriptor import ReducedSystem, StateMap, state_maps

if TYPE_CHECKING:
    from cosim.blocks.averages import AveragedModel, Smoothed


def observer_model(
    reduced: ReducedSystem,
    design: ObserverDesign,
    *,
    x_a0: ArrayLike | None = None,
    q0: ArrayLike | None = None,
    constant: bool = False,
) -> LinearModel:
    """Write the observer as a model.

    Inputs u and y; outputs the estimates x_a, delta, x_b, of the general form x, delta, and the
    states z, q. Where there is no u, x_b or filter with the state q, there is no such signal.

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
    n_y, n_d = reduced.C5.shape
    inputs = _inputs(reduced)
    first, *others = [_estimate(state) for state in state_maps(reduced)]
    delta = _delta(n_d)
    own_states = [_observer_state(reduced)]
    if design.filter_rate is not None:
        q = Signal("q", n_y, role="state", description="state of the derivative filter")
        own_states.append(q)
    outputs = (first, delta, *others, *own_states)
    states = tuple(chain.from_iterable(signal.elements for signal in own_states))
    n = len(states)
    model = _model(Interface(inputs, outputs), states, system, X0[:n], Xu[:n])
    return _with_constant_state(model) if constant else model


def averaged_observer(
    reduced: ReducedSystem,
    design: ObserverDesign,
    *,
    x_a0: ArrayLike | None = None,
    constant: bool = False,
) -> AveragedModel:
    """Write the observer with a delta to be averaged, and the states that depend on it.

    Inputs u and y; outputs the states that do not depend on delta, z, then what lags. See
    :func:`observer_model` for the parameters.
    """
    realization = realize_averages(reduced, design)
    n_a = len(reduced.A_a)
    X0, Xu = initial_state_map(reduced, design, x_a0=x_a0)
    z = _observer_state(reduced)
    lagging = [_delta(len(design.G))]
    direct: list[Signal] = []
    for state in state_maps(reduced):
        signals = lagging if state.of_delta.any() else direct
        signals.append(_estimate(state))
    direct.append(z)
    rate = Signal("rate", realization.width)
    level = Signal("level", realization.width)
    system = realization.system
    ports = Interface(_inputs(reduced), (*direct, rate, level))
    model = _model(ports, tuple(z.elements), system, X0[:n_a], Xu[:n_a])
    if constant:
        model = _with_constant_state(model)
    from cosim.blocks.averages import AveragedModel  # rarely needed

    return AveragedModel(model, tuple(lagging))


def consistent_observer(model: AveragedModel, reduced: ReducedSystem, rate: float) -> Smoothed:
    """Build the observer with averages by a consistent filter.

    Initially delta is 0, as with the filter (19), and the states that depend on it are what they
    are without it.
    """
    n_d = reduced.C5.shape[1]
    start = np.eye(model.width)
    start[:n_d, :n_d] = 0.0
    begin = n_d
    for state in lagging_states(reduced):
        end = begin + len(state.of_delta)
        start[begin:end, :n_d] = -state.of_delta
        begin = end
    from cosim.blocks.averages import Smoothed  # rarely needed

    return Smoothed(model, rate, start)


def _model(
    ports: Interface, states: tuple[str, ...], system: StateSpace, X0: Vector, Xu: Matrix
) -> LinearModel:
    matrices = (system.A, system.B, system.C, system.D, X0, Xu)
    return with_dependencies(LinearModel(ports, states, *matrices))


def _inputs(reduced: ReducedSystem) -> tuple[Signal, ...]:
    """Return u and y; only y where there is no u."""
    n_y, n_u = reduced.C4.shape
    y = Signal("y", n_y, role="input", description="measured output")
    u = (Signal("u", n_u, role="input", description="known input"),) if n_u else ()
    return (*u, y)


def _delta(size: int) -> Signal:
    return Signal("delta", size, role="estimate", description="reconstructed disturbance")


def _estimate(state: StateMap) -> Signal:
    text = f"estimate of {state.name}"
    return Signal(state.name, len(state.of_x_a), role="estimate", description=text)


def _observer_state(reduced: ReducedSystem) -> Signal:
    text = "state of the observer"
    return Signal("z", len(reduced.A_a), role="state", description=text)


def _with_constant_state(model: LinearModel) -> LinearModel:
    """Turn the last element of u into a state that stays at 1."""
    u, y = model.interface.inputs
    n_x = len(model.states)
    column = u.size - 1
    others = [i for i in range(model.interface.n_u) if i != column]
    inputs = (y,) if column == 0 else (replace(u, size=column), y)
    B_others = model.B[:, others]
    B_one = model.B[:, [column]]
    D_one = model.D[:, [column]]
    Xu_others = model.Xu[:, others]
    Xu_one = model.Xu[:, column]
    constant_row = np.zeros((1, n_x + 1))
    no_input = np.zeros((1, len(others)))
    dynamics = np.hstack([model.A, B_one])
    A = np.vstack([dynamics, constant_row])
    B = np.vstack([B_others, no_input])
    C = np.hstack([model.C, D_one])
    D = model.D[:, others]
    x0 = model.X0 + Xu_one
    X0 = np.append(x0, 1.0)
    Xu = np.vstack([Xu_others, no_input])
    states = (*model.states, "one")
    outputs = model.interface.outputs
    return with_dependencies(LinearModel(Interface(inputs, outputs), states, A, B, C, D, X0, Xu))
