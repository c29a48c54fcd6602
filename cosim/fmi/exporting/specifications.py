"""Specify what the FMU of a model is made of, whatever its version.

Files, constants in C, capabilities, structure, equations. A model is continuous in time (linear,
with or without its algebraic equations), or changes at communication points only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from typing import TypeAlias

import numpy as np

from cosim.arrays import Matrix
from cosim.core.linear import DescriptorModel, LinearModel
from cosim.core.signals import element_names
from cosim.fmi.describing import describe, element_dependencies, states_of_outputs
from cosim.fmi.description import (
    Capabilities,
    Dae,
    Description,
    Formulation,
    InterfaceType,
    VariableDependencies,
)
from cosim.fmi.exporting.kernels import DiscreteModel, doubles, integer, integers
from cosim.fmi.variable import Variable
from cosim.instants import step_seconds, step_value

Exportable: TypeAlias = LinearModel | DiscreteModel

# the name of the variable that is zero where the algebraic variables solve their equations
RESIDUAL = "residual"
NO_RESIDUAL_FORM = "const residual_form *const model_residual_form = 0;"
COMMON = Capabilities(
    directional_derivatives=True,
    adjoint_derivatives=True,
    saves_state=True,
    serializes_state=True,
    completed_step=False,
)
CO_SIMULATION = replace(COMMON, interpolates_inputs=True, event_mode=True)


@dataclass(frozen=True, slots=True)
class ExportSpecification:
    """What an FMU is made of.

    Parameters
    ----------
    description : Description
        Scalars, structure, capabilities; no token and no identifier yet.
    sources, headers, natives : tuple of str
        Files of ``c/``, and C files of ``cosim/native``.
    size : tuple of int
        Number of states, inputs and outputs: of their elements.
    memory, work : int
        Doubles of an instance: those that change, and scratch.
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
    n_residuals : int
        Number of elements of the residual, where there is one.
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
    step: float = 0.0
    constant: bool = True
    reason: str = ""
    n_residuals: int = 0


def specify(model: Exportable | DescriptorModel, name: str) -> ExportSpecification:
    """Specify the FMU of a model; ``name`` is that of the FMU's model."""
    if isinstance(model, DescriptorModel):
        return _with_residual_form(specify(model.reduced, name), model)
    if isinstance(model, LinearModel):
        return _specify_linear(model, describe(model, name, model))
    return _specify_discrete(model, describe(model, name, None))


# --- linear models ---


def _specify_linear(model: LinearModel, description: Description) -> ExportSpecification:
    n = len(model.states)
    m = model.interface.n_u
    p = model.interface.n_y
    capabilities: dict[InterfaceType, Capabilities] = {
        "me": COMMON,
        "cs": replace(CO_SIMULATION, variable_step=True),
    }
    description = replace(
        description,
        capabilities=capabilities,
        initial_dependencies=_initial_dependencies(description, model),
    )
    is_exact = [not row.any() for row in model.Xu]
    not_held = ", ".join(["0"] * max(1, m))
    constants = [integers("model_is_exact", is_exact)]
    constants.append(integers("model_state_of", states_of_outputs(model)))
    for letter, array in model.arrays.items():
        constants.append(doubles(f"model_{letter}", array))
    constants.append(f"const uint8_t model_free[] = {{{not_held}}};")
    constants.append(NO_RESIDUAL_FORM)
    discretization = 1 + n * n + 2 * n * m
    scratch = 4 * (n + 2 * m) ** 2
    return ExportSpecification(
        description,
        sources=("continuous.c",),
        headers=("continuous.h",),
        natives=("linear.c",),
        size=(n, m, p),
        memory=2 * n,
        work=discretization + scratch,
        constants=tuple(constants),
        numbers=model.arrays,
        equations=_linear_equations(model),
    )


def _initial_dependencies(description: Description, model: LinearModel) -> VariableDependencies:
    """Return what initial unknowns depend on: inputs, and states whose start value can be set."""
    inputs = [v.name for v in description.variables if v.causality == "input"]
    inputs_of = {}
    for state, row in zip(model.states, model.Xu, strict=True):
        inputs_of[state] = element_dependencies(inputs, row)
    dependencies = {}
    for variable in description.variables:
        if variable.initial != "calculated":
            continue
        if variable.name in description.states:
            direct: tuple[str, ...] = (variable.name,)
        else:
            direct = description.dependencies[variable.name] or ()
        needs: list[str] = []
        for name in direct:
            # a state that follows inputs in initialization mode stands for these inputs
            needs += inputs_of.get(name) or (name,)
        dependencies[variable.name] = tuple(dict.fromkeys(needs))
    return dependencies


def _linear_equations(model: LinearModel) -> str:
    states = escape(", ".join(model.states)) or "none"
    return (
        f"<p>x' = A x + B u, y = C x + D u, initially x = X0 + Xu u; states x: {states}. Steps in "
        "co-simulation are exact for linearly interpolated inputs.</p>\n"
        f"{_matrices(model.arrays)}"
    )


def _matrices(arrays: Mapping[str, Matrix]) -> str:
    paragraphs = []
    for letter, array in arrays.items():
        numbers = escape(np.array2string(array, threshold=1000))
        paragraphs.append(f"<pre>{letter} =\n{numbers}</pre>\n")
    return "".join(paragraphs)


# --- linear models that keep their algebraic equations ---


def _with_residual_form(
    reduced: ExportSpecification, model: DescriptorModel
) -> ExportSpecification:
    """Return the reduced model with the residual beside it, whose references are the last."""
    n, m, p = reduced.size
    columns = model.reduced.interface.output_columns()[model.algebraic]
    n_z = columns.stop - columns.start
    first_reference = m + p + 2 * n + 1
    residuals = _residual_variables(model, n_z, first_reference)
    dae = _residual_form(model, [variable.name for variable in residuals])
    variables = (*reduced.description.variables, *residuals)
    of_output = [-1] * p
    of_output[columns] = range(n_z)
    functions = "residual_outputs, residual_values, residual_partial"
    constants = [line for line in reduced.constants if line != NO_RESIDUAL_FORM]
    constants.append('#include "residual.h"')
    for letter, array in model.arrays.items():
        constants.append(doubles(f"residual_{letter}", array))
    constants.append("static " + integers("of_output", of_output))
    constants.append(f"static const residual_form form = {{{n_z}, of_output, {functions}}};")
    constants.append("const residual_form *const model_residual_form = &form;")
    return replace(
        reduced,
        description=replace(reduced.description, variables=variables, dae=dae),
        sources=(*reduced.sources, "residual.c"),
        headers=(*reduced.headers, "residual.h"),
        constants=tuple(constants),
        numbers={**reduced.numbers, **model.arrays},
        equations=reduced.equations + _descriptor_equations(model),
        n_residuals=n_z,
    )


def _residual_variables(model: DescriptorModel, n_z: int, first_reference: int) -> list[Variable]:
    doc = f"zero where {model.algebraic} is the solution"
    variables = []
    for k in range(n_z):
        name = RESIDUAL if n_z == 1 else f"{RESIDUAL}[{k}]"
        reference = first_reference + k
        variables.append(Variable(name, reference, "local", initial="calculated", doc=doc))
    return variables


def _residual_form(model: DescriptorModel, residuals: Sequence[str]) -> Dae:
    interface = model.reduced.interface
    states = model.reduced.states
    inputs = element_names(interface.inputs)
    outputs = element_names(interface.outputs)
    algebraic = outputs[interface.output_columns()[model.algebraic]]
    derivatives = [f"der({x})" for x in states]
    knowns = [*states, *algebraic, *inputs]
    unknowns = [*derivatives, *outputs, *residuals]
    rows = np.hstack([model.by_x, model.by_z, model.by_u])
    needs = {}
    for name, row in zip(unknowns, rows, strict=True):
        needs[name] = element_dependencies(knowns, row)
    equations = tuple((Formulation(name, needs.pop(name)),) for name in residuals)
    return Dae("", tuple(algebraic), equations, needs)


def _descriptor_equations(model: DescriptorModel) -> str:
    return (
        "<h3>Residual form</h3>\n"
        "<p>The rows of x', of y and of the residual are by_x x + by_z z + by_u u. z is "
        f"{model.algebraic}: calculated, so that the residual is zero up to rounding, until the "
        "importer sets it in event or continuous-time mode; then x', y and the residual are those "
        "of the z that is set. See extra/, FMI-LS-DAE.</p>\n"
        f"{_matrices(model.arrays)}"
    )


# --- discrete models ---


def _specify_discrete(model: DiscreteModel, description: Description) -> ExportSpecification:
    m = model.interface.n_u
    p = model.interface.n_y
    step = step_seconds(model.step_ns) if model.step_ns else None
    able = replace(
        CO_SIMULATION,
        variable_step=step is None,
        fixed_step=step,
        directional_derivatives=model.kernel.affine,
        adjoint_derivatives=model.kernel.affine,
    )
    description = replace(
        description,
        capabilities={"cs": able},
        initial_dependencies=_discrete_initial_dependencies(model),
        default_step=step,
    )
    kernel = model.kernel
    constants = [NO_RESIDUAL_FORM, integers("model_is_exact", [])]
    constants.append(integers("model_state_of", [-1] * p))
    constants.append(doubles("model_X0", []))
    constants.append(integer("model_steps_per_sample", model.steps_per_sample))
    period = step_seconds(model.step_ns * model.steps_per_sample)
    constants.append(f"const double model_period = {period!r};")
    constants.append(integer("model_is_zero_order_hold", int(model.zero_order_hold)))
    constants.append(integer("kernel_memory", kernel.memory))
    constants += kernel.constants
    return ExportSpecification(
        description,
        sources=("discrete.c", kernel.source),
        headers=("discrete.h",),
        natives=kernel.natives,
        size=(0, m, p),
        memory=2 + m + p + kernel.memory,
        work=p,
        constants=tuple(constants),
        numbers={},
        equations=_discrete_equations(model),
        step=step or 0.0,
        constant=kernel.linear,
        reason=model.reason,
    )


def _discrete_initial_dependencies(model: DiscreteModel) -> VariableDependencies:
    interface = model.interface
    elements_of = {signal.name: signal.elements for signal in interface.inputs}
    dependencies: dict[str, tuple[str, ...]] = {}
    for output in interface.outputs:
        needs: list[str] = []
        for name in interface.feeds_initially(output.name):
            needs += elements_of[name]
        dependencies |= dict.fromkeys(output.elements, tuple(needs))
    return dependencies


def _discrete_equations(model: DiscreteModel) -> str:
    step = ""
    if model.step_ns:
        step = f"Its communication step is {step_value(model.step_ns)} s, and no other. "
    period = ""
    if model.steps_per_sample > 1:
        period = (
            f"Its outputs change every {model.steps_per_sample} steps, with a zero-order hold "
            "between. "
        )
    reason = f"Co-simulation only: {escape(model.reason)}."
    return f"<p>{escape(model.kernel.equations)}</p>\n<p>{step}{period}{reason}</p>"
