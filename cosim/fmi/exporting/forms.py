"""The two forms of a model that can be exported: continuous (linear), or discrete.

What they have in common is what an FMU is made of, whatever its version: files, numbers as C, kinds, structure, equations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from html import escape

import numpy as np

from cosim.arrays import Matrix
from cosim.core.clock import NANOSECONDS
from cosim.core.solver import LinearModel
from cosim.fmi.description import Capabilities, Description, Mode, describe, states_of_outputs
from cosim.fmi.exporting.kernels import DiscreteModel, doubles, integer, integers

BOTH = Capabilities(
    directional_derivatives=True, adjoint_derivatives=True, saves_state=True, serializes_state=True, completed_step=False
)
STEPPED = replace(BOTH, interpolates_inputs=True, event_mode=True)


@dataclass(frozen=True, slots=True)
class Form:
    """What an FMU is made of.

    Parameters
    ----------
    description : Description
        Scalars, structure, kinds; no token and no identifier yet.
    sources, headers, natives : tuple of str
        Files of ``c/``, and C files of ``cosim/native``.
    size : tuple of int
        States, inputs, outputs: their elements.
    memory, work : int
        Doubles of an instance: that change, and of scratch.
    constants : tuple of str
        Lines of C.
    numbers : mapping of name to Matrix
        What must be finite.
    equations : str
        HTML.
    step_ns : int
        The only communication step [ns]; 0: any.
    constant : bool
        Every unknown is a sum of constants times what it depends on.
    reason : str
        Why it is for co-simulation only; empty: it is for model exchange too.
    """

    description: Description
    sources: tuple[str, ...]
    headers: tuple[str, ...]
    natives: tuple[str, ...]
    size: tuple[int, int, int]
    memory: int
    work: int
    constants: tuple[str, ...]
    numbers: Mapping[str, Matrix]
    equations: str
    step_ns: int = 0
    constant: bool = True
    reason: str = ""


def form_of(model: LinearModel | DiscreteModel, name: str) -> Form:
    """Give the form of a model; ``name`` is that of the unit."""
    return _continuous(model, name) if isinstance(model, LinearModel) else _discrete(model, name)


# --- continuous ---


def _continuous(model: LinearModel, name: str) -> Form:
    n, m, p = len(model.states), model.interface.n_u, model.interface.n_y
    unit = describe(model, name, model)
    kinds: dict[Mode, Capabilities] = {"me": BOTH, "cs": replace(STEPPED, variable_step=True)}
    return Form(
        replace(unit, capabilities=kinds, initial_dependencies=_linear_start(unit, model)),
        sources=("continuous.c",),
        headers=("continuous.h",),
        natives=("linear.c",),
        size=(n, m, p),
        memory=2 * n,
        work=1 + n * n + 2 * n * m + 4 * (n + 2 * m) ** 2,
        constants=(
            integers("model_is_exact", [not row.any() for row in model.Xu]),
            integers("model_state_of", states_of_outputs(model)),
            *(doubles(f"model_{letter}", array) for letter, array in model.arrays.items()),
            f"const uint8_t model_free[] = {{{', '.join(['0'] * max(1, m))}}};",
        ),
        numbers=model.arrays,
        equations=_linear_equations(model),
    )


def _linear_start(unit: Description, model: LinearModel) -> dict[str, tuple[str, ...] | None]:
    """Give what the unknowns of the initialization depend on: inputs, and states whose start value is given."""
    inputs = [v.name for v in unit.variables if v.causality == "input"]
    through = {
        x: tuple(u for u, value in zip(inputs, row, strict=True) if value) for x, row in zip(model.states, model.Xu, strict=True)
    }
    unknowns: dict[str, tuple[str, ...] | None] = {}
    for variable in unit.variables:
        if variable.initial != "calculated":
            continue
        needs: dict[str, None] = {}
        direct = (variable.name,) if variable.name in unit.states else unit.dependencies[variable.name] or ()
        for name in direct:
            needs |= dict.fromkeys(through.get(name) or (name,))
        unknowns[variable.name] = tuple(needs)
    return unknowns


def _linear_equations(model: LinearModel) -> str:
    names = ", ".join(model.states)
    matrices = "".join(
        f"<pre>{letter} =\n{escape(np.array2string(array, threshold=1000))}</pre>\n" for letter, array in model.arrays.items()
    )
    return (
        f"<p>x' = A x + B u, y = C x + D u, started at x = X0 + Xu u; states x: {escape(names) or 'none'}. Steps in "
        f"co-simulation are exact for inputs that move in straight lines over a step.</p>\n{matrices}"
    )


# --- discrete ---


def _discrete(model: DiscreteModel, name: str) -> Form:
    m, p = model.interface.n_u, model.interface.n_y
    unit = describe(model, name, None)
    step = model.step_ns / NANOSECONDS if model.step_ns else None
    return Form(
        replace(
            unit,
            capabilities={"cs": replace(STEPPED, variable_step=step is None, fixed_step=step)},
            initial_dependencies=_discrete_start(model),
            default_step=step,
        ),
        sources=("discrete.c", model.kernel.source),
        headers=("discrete.h",),
        natives=model.kernel.natives,
        size=(0, m, p),
        memory=2 + m + p + model.kernel.memory,
        work=p,
        constants=(
            integers("model_is_exact", []),
            integers("model_state_of", [-1] * p),
            doubles("model_X0", []),
            integer("model_every", model.every),
            integer("model_holds", int(model.holds)),
            integer("kernel_memory", model.kernel.memory),
            *model.kernel.constants,
        ),
        numbers={},
        equations=_discrete_equations(model),
        step_ns=model.step_ns,
        constant=model.kernel.linear,
        reason=model.reason,
    )


def _discrete_start(model: DiscreteModel) -> dict[str, tuple[str, ...] | None]:
    face = model.interface
    elements = {signal.name: signal.elements for signal in face.inputs}
    return {
        element: tuple(e for name in face.feeds_at_start(output.name) for e in elements[name])
        for output in face.outputs
        for element in output.elements
    }


def _discrete_equations(model: DiscreteModel) -> str:
    step = f"Its communication step is {model.step_ns / NANOSECONDS} s, and no other. " if model.step_ns else ""
    every = f"It answers after every {model.every} steps; its outputs hold between. " if model.every > 1 else ""
    return f"<p>{escape(model.kernel.equations)}</p>\n<p>{step}{every}Co-simulation only: {escape(model.reason)}.</p>"
