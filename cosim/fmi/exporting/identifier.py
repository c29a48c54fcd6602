"""The constants of the identifier by output error as C text: structs that point to each other."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cosim.errors import UsageError, steps_text
from cosim.fmi.exporting.kernels import ESTIMATION, Kernel, doubles, integers, past_alphas
from cosim.native.estimation.identifier import IdentifierConstants, IdentifierStep
from cosim.native.estimation.output_error import OutputErrorModel, known_input_struct
from cosim.native.estimation.rayleigh import RayleighModel
from cosim.native.estimation.regression import RegressorConstants
from cosim.native.estimation.start_grid import StartGridModel

# an array, or the name of what stands in the text before
Pointer: TypeAlias = NDArray[Any] | str

NATIVES: Final = (
    "identifier.c",
    "householder.c",
    "output_error.c",
    "rayleigh.c",
    "start_grid.c",
    "between.c",
    "predictor.c",
    "weights.c",
    *ESTIMATION,
)
NOTHING: Final = "0"


class _Writer:
    """Collects lines of C, in the order in which they refer to each other."""

    def __init__(self) -> None:
        self.lines = ["#include <math.h>"]

    def array(self, name: str, values: NDArray[Any]) -> str:
        """Write an array; return its name."""
        if values.dtype == np.float64:
            line = doubles(name, values).replace("inf", "INFINITY")
        elif values.dtype == np.uint8:
            line = integers(name, values.ravel()).replace("int32_t", "uint8_t")
        else:
            line = integers(name, values.ravel())
        self.lines.append(f"static {line}")
        return name

    def struct(
        self, kind: str, name: str, values: ctypes.Structure, pointers: Sequence[Pointer]
    ) -> str:
        """Write a struct, whose pointers are given in their order; return its address."""
        entries = self.entries(name, values, pointers)
        self.lines.append(f"static const {kind} {name} = {{{entries}}};")
        return f"&{name}"

    def entries(self, name: str, values: ctypes.Structure, pointers: Sequence[Pointer]) -> str:
        """Write the arrays of a struct; return its entries."""
        entries = []
        left = list(pointers)
        for field, field_type, *_ in values._fields_:
            value = getattr(values, field)
            if field_type is ctypes.c_void_p:
                to = left.pop(0)
                entries.append(to if isinstance(to, str) else self.array(f"{name}_{field}", to))
            elif field_type is ctypes.c_double:
                entries.append(_number(value))
            else:
                entries.append(str(value))
        return ", ".join(entries)


def output_error(constants: IdentifierConstants) -> Kernel:
    """Write the identifier by output error, with room for the samples of its run.

    Raises
    ------
    UsageError
        If it predicts y from samples that may be missing.
    """
    if constants.predictor is not None:
        raise UsageError(
            "the plant is unstable and samples of y may be missing: an identifier of such samples "
            "cannot be exported yet; expected a sensor without dropouts and without a period"
        )
    step = IdentifierStep(constants)
    writer = _Writer()
    pointers: list[Pointer] = [_regressor(writer, constants.products)]
    writer.lines += past_alphas("lagging", constants.lagging)
    pointers.append("&lagging")
    rayleigh = RayleighModel(constants.rayleigh)
    pointers.append(writer.struct("cosim_rayleigh", "rayleigh", rayleigh.struct, rayleigh.arrays))
    for name in ("on_delta", "on_y"):
        model_constants = getattr(constants, name)
        pointers.append(
            NOTHING
            if model_constants is None
            else _model(writer, name, OutputErrorModel(model_constants))
        )
    pointers.append(_known(writer, constants))
    pointers += [constants.lower, constants.upper, constants.scale, constants.threshold]
    pointers.append(constants.known_deviations)
    pointers += [_grids(writer, constants), np.array(constants.reach, np.int32)]
    # no predictor, and the memory is the instance's
    pointers += [_between(writer, constants), NOTHING, NOTHING]
    writer.struct("cosim_identifier", "kernel_constants", step.step.state, pointers)
    writer.lines[-1] = writer.lines[-1].removeprefix("static ")
    equations = (
        "Theta by output error on y, from a start that is searched on y and on the regression mu: "
        f"every {steps_text(constants.period)}, from all samples since the initialization "
        f"or from those of a window, at most {constants.capacity}. No value (NaN) before there is "
        "one."
    )
    memory = len(step.step.memory)
    return Kernel("output_error_identifier.c", NATIVES, memory, tuple(writer.lines), equations)


def _model(writer: _Writer, name: str, model: OutputErrorModel) -> str:
    return writer.struct("cosim_output_error", name, model.struct, model.arrays)


def _known(writer: _Writer, constants: IdentifierConstants) -> str:
    if constants.known is None:
        return NOTHING
    struct, arrays = known_input_struct(constants.known)
    return writer.struct("cosim_known_input", "known", struct, arrays)


def _grids(writer: _Writer, constants: IdentifierConstants) -> str:
    entries = []
    for number, one in enumerate(constants.grids):
        grid = StartGridModel(one)
        model = _model(writer, f"on_grid_{number}", grid.model)
        entries.append(writer.entries(f"grid_{number}", grid.struct, [model, *grid.arrays]))
    if not entries:
        return NOTHING
    rows = ", ".join(f"{{{entry}}}" for entry in entries)
    writer.lines.append(f"static const cosim_start_grid grids[] = {{{rows}}};")
    return "grids"


def _between(writer: _Writer, constants: IdentifierConstants) -> str:
    if constants.between is None:
        return NOTHING
    struct, arrays = constants.between.struct(constants.capacity)
    return writer.struct("cosim_between", "between", struct, arrays)


def _regressor(writer: _Writer, constants: RegressorConstants) -> str:
    writer.lines += past_alphas("group_alphas", constants.alphas)
    numbers = [len(constants.steps), *np.shape(constants.factor)]
    entries = [str(number) for number in numbers]
    entries.append(writer.array("steps", np.array(constants.steps, np.int32)))
    entries.append("&group_alphas")
    entries.append(writer.array("row", np.array(constants.row, np.int32)))
    entries.append(writer.array("factor", np.array(constants.factor, np.int32)))
    entries.append(writer.array("sign", np.array(constants.sign, np.float64)))
    entries.append(NOTHING)
    writer.lines.append(f"static const cosim_regressor products = {{{', '.join(entries)}}};")
    return "&products"


def _number(value: float) -> str:
    return float(value).hex() if math.isfinite(value) else str(value).replace("inf", "INFINITY")
