"""What a child process does with a foreign binary, as it may crash or hang there.

``python -m cosim.fmi.checking.trial TASK LOG ARGUMENT...`` does a task and writes to the file LOG,
a JSON object a line: the stages it comes to, the problems it finds, that it is done. A log without
an end names the last stage before the process was lost.
"""

from __future__ import annotations

import json
import math
import os
import pickle
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, NoReturn, TextIO

from cosim.errors import CosimError
from cosim.fmi.platforms import load_library
from cosim.processes import end_with_parent, leave_no_core

if TYPE_CHECKING:
    from cosim.arrays import Matrix, Vector
    from cosim.fmi.child_process import ProblemKind
    from cosim.fmi.component import Fmu
    from cosim.fmi.description import Description, InterfaceType
    from cosim.fmi.driving.guarded import FmuComponent
    from cosim.fmi.driving.initialization import Starts

STEP: Final = 1e-3  # [s], where the FMU prefers none
OTHER_STEPS: Final = (0.1, 0.01, 1e-3, 1e-4, 1.0)  # [s], in this order where that is refused
STEPS: Final = 3
CLOSE: Final = 0.1  # of the change in the steps: what a solver that starts anew makes of them
ROUNDING: Final = 1e-6  # relative


class TrialLog:
    """Records what happens; each record is flushed, so that it is known after a crash."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def stage(self, text: str) -> None:
        """Record what begins now."""
        self._write({"stage": text})

    def problem(self, text: str, kind: ProblemKind = "other") -> None:
        """Record a problem."""
        self._write({"problem": text, "kind": kind})

    def done(self, task: str) -> None:
        """Record the end."""
        self._write({"done": task})

    def _write(self, record: Mapping[str, str]) -> None:
        self._file.write(json.dumps(record) + "\n")
        self._file.flush()


def find_symbols(log: TrialLog, path: str, *names: str) -> None:
    """Load a library and look functions up."""
    log.stage("loading the library")
    try:
        library = load_library(Path(path))
    except OSError as error:
        reason = str(error).replace(path, Path(path).name)
        log.problem(f"cannot be loaded: {reason}")
        return
    for name in names:
        try:
            library[name]
        except AttributeError:
            log.problem(f"missing function {name}", "missing function")


class _RefusedStep(Exception):
    """The first steps of a trial failed; the reason is its text."""


def run(log: TrialLog, fmu: Fmu, h: float) -> None:
    """Go through a short run."""
    if fmu.refused:
        log.problem(fmu.refused, "refused")
    component = fmu.component
    t = _times(h, STEPS)
    u = _initial_inputs(component, STEPS)
    log.stage("initialization")
    y = component.initialize(0.0, u[0])
    _check_initial_values(log, fmu.description, y)
    log.stage(f"steps of {h:g} s")
    rows = _first_steps(component, t, h, u)
    _check_finite(log, component, rows)
    if fmu.model_exchange is not None:
        for state, nominal in fmu.model_exchange.nominals().items():
            if not 0.0 < nominal < math.inf:
                expected = f"expected a finite number > 0, got {nominal:g}"
                log.problem(f"nominal value of {state!r}: {expected}", "inexact")
    log.stage("terminate and free")


def roll_back(log: TrialLog, fmu: Fmu, h: float) -> None:
    """Save, step, restore and step again, also after other inputs: the same bits each time."""
    component = fmu.component
    t = _times(h, 2 * STEPS)
    u = _initial_inputs(component, 2 * STEPS)
    log.stage("initialization")
    component.initialize(0.0, u[0])
    log.stage("steps before the state is saved")
    _first_steps(component, t[: STEPS + 1], h, u[: STEPS + 1])
    _compare_repeated_steps(log, fmu, t[STEPS:], h, u[STEPS:])
    log.stage("terminate and free")


def _first_steps(component: FmuComponent, t: Vector, h: float, u: Matrix) -> Matrix:
    try:
        return component.advance(t, h, u)
    except CosimError as error:
        raise _RefusedStep(str(error)) from error


def _with_a_step(
    trial: Callable[[TrialLog, Fmu, float], None],
    log: TrialLog,
    path: str,
    interface_type: InterfaceType,
    given: str = "",
    step: str = "",
) -> None:
    """Try an FMU with the first communication step that it takes, and record which it is.

    Co-simulation FMUs that take steps of one length only need not say which. ``step`` [s] is that
    of the scenario, or empty.
    """
    refusals: dict[float, str] = {}
    h: float | None = float(step) if step else None
    while True:
        try:
            with _opened(log, path, interface_type, given, h) as (fmu, h):
                trial(log, fmu, h)
                break
        except _RefusedStep as refusal:
            assert h is not None
            refusals[h] = str(refusal)
        untried = [other for other in OTHER_STEPS if other not in refusals]
        if interface_type == "me" or not untried:
            log.problem(next(iter(refusals.values())))
            return
        h = untried[0]
    if refusals:
        refused = ", ".join(f"{refused:g} s" for refused in refusals)
        text = f"tried with steps of {h:g} s, as those of {refused} are refused"
        log.problem(f"{text}: {next(iter(refusals.values()))}", "step")


def _compare_repeated_steps(log: TrialLog, fmu: Fmu, t: Vector, h: float, u: Matrix) -> None:
    """Compare the steps after each rollback with the first ones.

    Those are made as in a run that never goes back: an FMU may take the announcement that it may
    happen for the order to repeat the last step.
    """
    component = fmu.component
    other_inputs = 2.0 * u + 1.0  # they may be more than it bears
    log.stage("saving the state")
    try:
        saved = component.save()
    except CosimError as error:
        log.problem(f"is declared and then refused: {error}", "refused")
        return
    log.stage("steps after the state was saved")
    fmu.may_go_back = False
    expected = component.advance(t, h, u)
    fmu.may_go_back = True

    def step_with_other_inputs() -> None:
        component.restore(saved)
        with suppress(CosimError):
            component.advance(t, h, other_inputs)

    detours: dict[str, Callable[[], object]] = {
        "steps": lambda: None,  # those above
        "steps with other inputs": step_with_other_inputs,
        "saving anew": component.save,
    }
    for name, detour in detours.items():
        log.stage(name)
        detour()
        log.stage(f"going back after {name}")
        try:
            component.restore(saved)
        except CosimError as error:
            log.problem(f"is declared and then refused: {error}", "refused")
            return
        repeated = component.advance(t, h, u)
        if repeated.tobytes() != expected.tobytes():
            _record_difference(log, name, component, expected, repeated)
            return
    log.stage("other inputs")
    rows = []
    with suppress(CosimError):
        for may_go_back in (False, True):
            component.restore(saved)
            fmu.may_go_back = may_go_back
            rows.append(component.advance(t, h, other_inputs))
        if rows[0].tobytes() != rows[1].tobytes():
            _record_difference(log, "steps with other inputs", component, *rows)


def _record_difference(
    log: TrialLog, detour: str, component: FmuComponent, expected: Matrix, repeated: Matrix
) -> None:
    """Record how far the outputs are from those before, relative to how far they moved."""
    import numpy as np

    from cosim.core.signals import element_names

    motion = np.ptp(expected, axis=0)
    rounding = ROUNDING * np.maximum(1.0, np.abs(expected).max(axis=0))
    by_output = np.abs(repeated - expected).max(axis=0) / (motion + rounding)
    worst = int(by_output.argmax())
    names = element_names(component.interface.outputs)
    is_close = bool(by_output[worst] <= CLOSE)  # not where it is NaN
    log.problem(
        f"goes back {'inexactly' if is_close else 'wrongly'}: after {detour} the same steps give "
        f"other outputs, {names[worst]!r} by {by_output[worst]:.1g} of its change",
        "inexact" if is_close else "wrong",
    )


@contextmanager
def _opened(
    log: TrialLog, path: str, interface_type: InterfaceType, given: str, step: float | None
) -> Iterator[tuple[Fmu, float]]:
    """Yield the FMU and its step; ``given`` is the file with what the parent knows, or empty."""
    import numpy as np

    from cosim.fmi.component import load
    from cosim.fmi.options import FmuOptions

    log.stage("loading and instantiating")
    archive = None
    start: Starts = {}
    if given:
        archive, start = pickle.loads(Path(given).read_bytes())
    options = FmuOptions(interface_type=interface_type, start=start)
    with load(path, options, archive=archive) as fmu:
        log.stage("preparing")
        h = step or _step_size(fmu.description, interface_type)
        held = np.zeros(fmu.component.interface.n_u, np.bool_)
        try:
            fmu.component.prepare(h, held, {})
        except CosimError as error:
            if step is None:
                raise
            raise _RefusedStep(str(error)) from error
        yield fmu, h


def _step_size(description: Description, interface_type: InterfaceType) -> float:
    return description.capabilities[interface_type].fixed_step or description.default_step or STEP


def _times(h: float, steps: int) -> Vector:
    import numpy as np

    return np.array([k * h for k in range(steps + 1)], np.float64)


def _initial_inputs(component: FmuComponent, steps: int) -> Matrix:
    """Return a row a step in which every input has its initial value."""
    import numpy as np

    values: list[float] = []
    for signal in component.interface.inputs:
        values += signal.initial_values
    return np.tile(np.array(values, np.float64), (steps + 1, 1))


def _check_initial_values(log: TrialLog, description: Description, y: Vector) -> None:
    """Compare outputs whose initial values are exact with what the FMU returns."""
    column = 0
    for _, group in description.ports("output"):
        for variable in group:
            values = tuple(y[column : column + variable.size].tolist())
            column += variable.size
            if variable.initial == "exact" and variable.start not in (None, values):
                found = ", ".join(f"{value:g}" for value in values)
                expected = ", ".join(f"{value:g}" for value in variable.start or ())
                log.problem(
                    f"{variable.name!r} starts at {found}; the declared start is {expected} (exact)"
                )


def _check_finite(log: TrialLog, component: FmuComponent, rows: Matrix) -> None:
    """Compare the outputs of all steps with what may be recorded: NaN only in an optional one."""
    import numpy as np

    column = 0
    for signal in component.interface.outputs:
        for element in signal.elements:
            values = rows[:, column]
            column += 1
            allowed = np.isfinite(values)
            if signal.optional:
                allowed |= np.isnan(values)
            not_allowed = values[~allowed]
            if len(not_allowed):
                log.problem(f"output {element!r} is {not_allowed[0]} after a step")


TASKS: Final[dict[str, Callable[..., None]]] = {
    "symbols": find_symbols,
    "run": partial(_with_a_step, run),
    "rollback": partial(_with_a_step, roll_back),
}


def main(arguments: Sequence[str]) -> NoReturn:
    """Do a task, and end the process without the handlers of its end.

    Those of a library that pins itself may crash: pythonfmu3's uses memory that it has freed. What
    they do after the instance was freed says nothing about the rest of the FMU.
    """
    task, path, *task_arguments = arguments
    end_with_parent()
    leave_no_core()
    with open(path, "a", encoding="utf-8", buffering=1) as file:
        log = TrialLog(file)
        try:
            TASKS[task](log, *task_arguments)
        except CosimError as error:
            log.problem(str(error))
        except Exception as error:  # a foreign binary may make Python raise anything
            log.problem(f"{type(error).__name__}: {error}")
        log.done(task)
    os._exit(0)


if __name__ == "__main__":
    main(sys.argv[1:])
