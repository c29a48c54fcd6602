"""An FMU linearized where it stands: A, B, C and D without a step.

Model exchange: by central differences of derivatives and outputs, which are functions of time,
states and inputs there (FMI 2.0.4 section 3.2.2). Co-simulation: by directional derivatives, where
the FMU shows its states and their derivatives (FMI 2.0.4 section 2.1.9, FMI 3.0 section 2.2.11).

What changes at instants of its own is not linearized: an FMU with time events, or with real inputs
or outputs that are discrete.
"""

from __future__ import annotations

import numpy as np

from cosim.arrays import Mask, Matrix, Vector
from cosim.core.linearization import InputUse, Linearized
from cosim.fmi.description import Description
from cosim.fmi.instance import Instance, ModelExchangeInstance
from cosim.fmi.references import ReferenceMap, VectorElement
from cosim.fmi.variable import Variable

RELATIVE = 2.0**-17  # steps of central differences: near the cube root of the rounding


def has_continuous_ports(description: Description) -> bool:
    """Return whether all real inputs and outputs are continuous, and no clock ticks."""
    if description.drives_clocks:
        return False
    for causality in ("input", "output"):
        for variable in description.references(causality).variables:
            if variable.signal_type == "real" and variable.variability == "discrete":
                return False
    return True


def differentiated(
    instance: ModelExchangeInstance, x: Vector, u: Vector, nominals: Vector
) -> Linearized:
    """Linearize an instance in continuous-time mode, at the time that it has.

    It has states ``x`` and inputs ``u``, and has them again afterwards.
    """
    description = instance.description
    continuous = ~description.discrete_inputs
    inputs = description.references("input").select(continuous)
    outputs = description.references("output")
    n_x = len(x)
    point = np.concatenate([x, u])
    scale = np.concatenate([np.maximum(np.abs(x), nominals[:n_x]), np.maximum(np.abs(u), 1.0)])
    changing = np.concatenate([np.ones(n_x, np.bool_), continuous])

    def evaluate(values: Vector) -> Vector:
        if n_x:
            instance.set_continuous_states(values[:n_x])
        if inputs.size:
            instance.set_float64(inputs, inputs.take(values[n_x:]))
        dx = instance.get_derivatives() if n_x else np.zeros(0)
        return np.concatenate([dx, instance.get_float64(outputs)])

    jacobian = np.zeros((n_x + outputs.size, len(point)))
    for i in np.flatnonzero(changing):
        step = RELATIVE * 2.0 ** np.ceil(np.log2(scale[i]))
        above = point.copy()
        above[i] += step
        below = point.copy()
        below[i] -= step
        jacobian[:, i] = (evaluate(above) - evaluate(below)) / (2.0 * step)
    rate = evaluate(point)[:n_x]
    return _linearized(jacobian, n_x).at(x, u, rate)


def derived(instance: Instance, *, use: InputUse, corrected: Mask) -> Linearized | None:
    """Linearize an instance for co-simulation by its directional derivatives.

    None: it does not show its states and their derivatives.

    Parameters
    ----------
    instance : Instance
        With the capability for them.
    use : InputUse
        How it takes its inputs through a step.
    corrected : Mask, shape (n_y,)
        Which outputs follow the inputs at the end of a step.

    Raises
    ------
    RunError
        If it refuses.
    """
    description = instance.description
    states = [description[name] for name in description.states]
    derivatives = _derivatives(description, states)
    # One without states among its variables may have some all the same.
    if not states or derivatives is None or description.unnamed_states:
        return None
    outputs = description.references("output")
    state_of = _states_behind(outputs, states)
    of_state = np.array([state >= 0 for state in state_of], np.bool_)
    inputs = description.references("input").where(_is_real)
    knowns = [*states, *_chosen(description.references("input"), inputs)]
    is_unknown = np.array([_is_real(e.variable) for e in outputs.elements], np.bool_) & ~of_state
    unknowns = [*derivatives, *_chosen(outputs, is_unknown)]
    n_x = sum(state.size for state in states)
    jacobian = np.zeros((n_x + outputs.size, n_x + len(inputs)))
    rows = np.concatenate([np.ones(n_x, np.bool_), is_unknown])
    columns = np.concatenate([np.ones(n_x, np.bool_), inputs])
    if rows.any() and columns.any():
        jacobian[np.ix_(rows, columns)] = _directional(instance, unknowns, knowns)
    for row, state in enumerate(state_of):
        if state >= 0:
            jacobian[n_x + row, state] = 1.0
    return _linearized(jacobian, n_x, use=use, corrected=corrected)


def _linearized(
    jacobian: Matrix, n_x: int, *, use: InputUse = "linear", corrected: Mask | None = None
) -> Linearized:
    """Return the parts of a matrix of derivatives and outputs by states and inputs."""
    parts = (
        jacobian[:n_x, :n_x],
        jacobian[:n_x, n_x:],
        jacobian[n_x:, :n_x],
        jacobian[n_x:, n_x:],
    )
    A, B, C, D = (np.ascontiguousarray(part) for part in parts)
    return Linearized(A, B, C, D, input_use=use, corrected=corrected)


def _is_real(variable: Variable) -> bool:
    return variable.type == "Float64" and variable.variability == "continuous"


def _chosen(references: ReferenceMap, mask: Mask) -> list[Variable]:
    """Return the variables whose elements a mask chooses."""
    return list(references.select(mask).variables) if mask.any() else []


def _derivatives(description: Description, states: list[Variable]) -> list[Variable] | None:
    """Return the derivatives of states; None: some are no variables."""
    derivatives = []
    for state in states:
        of_state = [v for v in description.variables if v.derivative_of == state.name]
        declared = [v for v in of_state if v.name in description.dependencies]
        if not of_state:
            return None
        derivatives.append((declared or of_state)[0])
    return derivatives


def _states_behind(outputs: ReferenceMap, states: list[Variable]) -> list[int]:
    """Return for each output element the number of the state that it is; -1: none.

    A state is a known of a directional derivative, not an unknown.
    """
    places: dict[tuple[int, int], int] = {}
    for element in ReferenceMap.of(states).elements:
        places[element.variable.reference, element.index] = len(places)
    return [_place(element, places) for element in outputs.elements]


def _place(element: VectorElement, places: dict[tuple[int, int], int]) -> int:
    if element.variable.type != "Float64":
        return -1
    return places.get((element.variable.reference, element.index), -1)


def _directional(instance: Instance, unknowns: list[Variable], knowns: list[Variable]) -> Matrix:
    """Return the derivatives of unknowns by knowns, column by column."""
    of_unknowns = ReferenceMap.of(unknowns)
    of_knowns = ReferenceMap.of(knowns)
    columns = []
    for seed in np.eye(of_knowns.size):
        columns.append(instance.get_directional_derivative(of_unknowns, of_knowns, seed))
    return np.column_stack(columns)
