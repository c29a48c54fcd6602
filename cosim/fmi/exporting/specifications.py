"""The two forms of a model that can be exported: continuous (linear), or discrete.

What they have in common is what an FMU is made of, whatever its version: files, numbers as C, kinds, structure, equations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape

import numpy as np

from cosim.arrays import Matrix
from cosim.core.clock import NANOSECONDS
from cosim.core.linear import DescriptorModel, LinearModel
from cosim.fmi.describing import describe, element_dependencies, states_of_outputs
from cosim.fmi.description import (
    Capabilities,
    Dae,
    Description,
    Formulation,
    InterfaceType,
)
from cosim.fmi.exporting.kernels import DiscreteModel, doubles, integer, integers
from cosim.fmi.variable import Variable

RESIDUAL = (
    "residual"  # the variable that is zero where the algebraic variables solve their equations
)
NO_DESCRIPTOR = "const model_descriptor *const model_form = 0;"
BOTH = Capabilities(
    directional_derivatives=True,
    adjoint_derivatives=True,
    saves_state=True,
    serializes_state=True,
    completed_step=False,
)
STEPPED = replace(BOTH, interpolates_inputs=True, event_mode=True)


@dataclass(frozen=True, slots=True)
class ExportSpecification:
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
    residuals : int
        Elements of the residual, where it has one.
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
    residuals: int = 0


def form_of(model: LinearModel | DescriptorModel | DiscreteModel, name: str) -> ExportSpecification:
    """Give the form of a model; ``name`` is that of the unit."""
    if isinstance(model, DescriptorModel):
        return _descriptor(model, name)
    return _continuous(model, name) if isinstance(model, LinearModel) else _discrete(model, name)


# --- continuous ---


def _continuous(model: LinearModel, name: str) -> ExportSpecification:
    n, m, p = len(model.states), model.interface.n_u, model.interface.n_y
    unit = describe(model, name, model)
    kinds: dict[InterfaceType, Capabilities] = {
        "me": BOTH,
        "cs": replace(STEPPED, variable_step=True),
    }
    return ExportSpecification(
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
            NO_DESCRIPTOR,
        ),
        numbers=model.arrays,
        equations=_linear_equations(model),
    )


def _linear_start(unit: Description, model: LinearModel) -> dict[str, tuple[str, ...] | None]:
    """Give what the unknowns of the initialization depend on: inputs, and states whose start value is given."""
    inputs = [v.name for v in unit.variables if v.causality == "input"]
    through = {
        x: tuple(u for u, value in zip(inputs, row, strict=True) if value)
        for x, row in zip(model.states, model.Xu, strict=True)
    }
    unknowns: dict[str, tuple[str, ...] | None] = {}
    for variable in unit.variables:
        if variable.initial != "calculated":
            continue
        needs: dict[str, None] = {}
        direct = (
            (variable.name,)
            if variable.name in unit.states
            else unit.dependencies[variable.name] or ()
        )
        for name in direct:
            needs |= dict.fromkeys(through.get(name) or (name,))
        unknowns[variable.name] = tuple(needs)
    return unknowns


def _linear_equations(model: LinearModel) -> str:
    names = ", ".join(model.states)
    matrices = "".join(
        f"<pre>{letter} =\n{escape(np.array2string(array, threshold=1000))}</pre>\n"
        for letter, array in model.arrays.items()
    )
    return (
        f"<p>x' = A x + B u, y = C x + D u, started at x = X0 + Xu u; states x: {escape(names) or 'none'}. Steps in "
        f"co-simulation are exact for inputs that move in straight lines over a step.</p>\n{matrices}"
    )


# --- a linear model that keeps its algebraic equations ---


def _descriptor(model: DescriptorModel, name: str) -> ExportSpecification:
    """Give the form of the reduced model, with the residual and its equations beside it; its references are the last."""
    form, face = _continuous(model.reduced, name), model.reduced.interface
    z, (n, m, p) = face.output_columns()[model.algebraic], form.size
    n_z = z.stop - z.start
    names = [RESIDUAL] if n_z == 1 else [f"{RESIDUAL}[{k}]" for k in range(n_z)]
    variables = [
        Variable(
            residual,
            m + p + 2 * n + 1 + k,
            "local",
            initial="calculated",
            doc=f"zero where {model.algebraic} is the solution",
        )
        for k, residual in enumerate(names)
    ]
    unit = replace(
        form.description,
        variables=(*form.description.variables, *variables),
        dae=_residual_form(model, names),
    )
    of_output = [k - z.start if z.start <= k < z.stop else -1 for k in range(p)]
    functions = "residual_follow, residual_rest, residual_partial"
    return replace(
        form,
        description=unit,
        sources=(*form.sources, "residual.c"),
        headers=(*form.headers, "residual.h"),
        constants=(
            *(line for line in form.constants if line != NO_DESCRIPTOR),
            '#include "residual.h"',
            *(doubles(f"residual_{letter}", array) for letter, array in model.arrays.items()),
            "static " + integers("of_output", of_output),
            f"static const model_descriptor form = {{{n_z}, of_output, {functions}}};",
            "const model_descriptor *const model_form = &form;",
        ),
        numbers={**form.numbers, **model.arrays},
        equations=form.equations + _descriptor_equations(model),
        residuals=n_z,
    )


def _residual_form(model: DescriptorModel, residuals: Sequence[str]) -> Dae:
    face, states = model.reduced.interface, model.reduced.states
    outputs = [element for signal in face.outputs for element in signal.elements]
    algebraic = outputs[face.output_columns()[model.algebraic]]
    knowns = [
        *states,
        *algebraic,
        *(element for signal in face.inputs for element in signal.elements),
    ]
    unknowns = [*(f"der({x})" for x in states), *outputs, *residuals]
    rows = np.hstack([model.by_x, model.by_z, model.by_u])
    needs = {
        name: element_dependencies(knowns, row) for name, row in zip(unknowns, rows, strict=True)
    }
    equations = tuple((Formulation(name, needs.pop(name)),) for name in residuals)
    return Dae("", tuple(algebraic), equations, needs)


def _descriptor_equations(model: DescriptorModel) -> str:
    matrices = "".join(
        f"<pre>{letter} =\n{escape(np.array2string(array, threshold=1000))}</pre>\n"
        for letter, array in model.arrays.items()
    )
    return (
        "<h3>Residual form</h3>\n<p>The rows of x', of y and of the residual are by_x x + by_z z + by_u u. z is "
        f"{model.algebraic}: calculated, so that the residual is zero up to rounding, until the importer sets it in event or "
        "continuous-time mode; then x', y and the residual are those of the z that is set. See extra/, FMI-LS-DAE.</p>\n"
        + matrices
    )


# --- discrete ---


def _discrete(model: DiscreteModel, name: str) -> ExportSpecification:
    m, p = model.interface.n_u, model.interface.n_y
    unit = describe(model, name, None)
    step = model.step_ns / NANOSECONDS if model.step_ns else None
    return ExportSpecification(
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
            NO_DESCRIPTOR,
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
    step = (
        f"Its communication step is {model.step_ns / NANOSECONDS} s, and no other. "
        if model.step_ns
        else ""
    )
    every = (
        f"It answers after every {model.every} steps; its outputs hold between. "
        if model.every > 1
        else ""
    )
    return f"<p>{escape(model.kernel.equations)}</p>\n<p>{step}{every}Co-simulation only: {escape(model.reason)}.</p>"
