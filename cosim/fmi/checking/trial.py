"""What a child process does with a foreign binary; what crashes, hangs or lies does it there.

``python -m cosim.fmi.checking.trial TASK RESULT ARGUMENT...`` does a task and writes its story to the file RESULT, an object
a line: where it is, what it found, that it is done. A story without an end tells where the process was lost.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from cosim.errors import CosimError
from cosim.fmi.child_process import MISSING_FUNCTION

if TYPE_CHECKING:
    from cosim.arrays import Matrix, Vector
    from cosim.fmi.component import Fmu
    from cosim.fmi.description import Description, InterfaceType

STEP: Final = 1e-3  # [s], where the FMU prefers none
STEPS: Final = 3


class _Story:
    """Writes what happens, so that it is known after a crash."""

    def __init__(self, path: str) -> None:
        self._file = open(path, "a", encoding="utf-8", buffering=1)

    def tell(self, key: str, text: str) -> None:
        """Write a line."""
        self._file.write(json.dumps({key: text}) + "\n")
        self._file.flush()

    def at(self, text: str) -> None:
        """Say what comes now."""
        self.tell("stage", text)

    def problem(self, text: str) -> None:
        """Say what is wrong."""
        self.tell("problem", text)


def symbols(story: _Story, library: str, *names: str) -> None:
    """Load a library and look functions up."""
    import ctypes

    story.at("loading the library")
    try:
        found = ctypes.CDLL(library)
    except OSError as error:
        story.problem(f"cannot be loaded: {str(error).replace(library, Path(library).name)}")
        return
    for name in names:
        if not hasattr(found, name):
            story.problem(f"{MISSING_FUNCTION} {name}")


def run(story: _Story, path: str, interface_type: InterfaceType) -> None:
    """Go through a short run."""
    import numpy as np

    with _opened(story, path, interface_type) as fmu:
        component, h = fmu.component, _step(fmu.description, interface_type)
        outputs = [
            (element, signal.optional)
            for signal in component.interface.outputs
            for element in signal.elements
        ]
        t, u = _times(h, STEPS), _inputs(fmu, STEPS)
        story.at("initialization")
        y = component.initialize(0.0, u[0])
        _check_starts(story, fmu.description, y)
        story.at(f"steps of {h:g} s")
        rows = component.advance(t, h, u)
        for (name, optional), values in zip(outputs, rows.T, strict=True):
            wrong = values[~(np.isfinite(values) | (np.isnan(values) & optional))]
            if len(wrong):
                story.problem(f"output {name!r} is {wrong[0]} after a step")
        story.at("terminate and free")
    story.at("the end of the process")


def rollback(story: _Story, path: str, interface_type: InterfaceType) -> None:
    """Save, step, restore and step again, also after other inputs: the same bits each time."""
    with _opened(story, path, interface_type) as fmu:
        component, h = fmu.component, _step(fmu.description, interface_type)
        t, u = _times(h, 2 * STEPS), _inputs(fmu, 2 * STEPS)
        story.at("initialization")
        component.initialize(0.0, u[0])
        story.at("steps before the state is saved")
        component.advance(t[: STEPS + 1], h, u[: STEPS + 1])
        ahead = (t[STEPS:], h, u[STEPS:])
        story.at("saving the state")
        saved = component.save()
        story.at("steps after the state was saved")
        first = component.advance(*ahead).tobytes()

        def other_inputs() -> None:
            component.restore(saved)
            with suppress(CosimError):  # they may be more than it bears
                component.advance(t[STEPS:], h, 2.0 * u[STEPS:] + 1.0)

        detours = {
            "steps": lambda: None,
            "steps with other inputs": other_inputs,
            "saving anew": component.save,
        }
        for what, detour in detours.items():
            story.at(what)
            detour()
            story.at(f"going back after {what}")
            component.restore(saved)
            if component.advance(*ahead).tobytes() != first:
                story.problem(f"goes back wrongly: after {what} the same steps give other outputs")
                break
        story.at("terminate and free")
    story.at("the end of the process")


@contextmanager
def _opened(story: _Story, path: str, interface_type: InterfaceType) -> Iterator[Fmu]:
    import numpy as np

    from cosim.fmi.component import load
    from cosim.fmi.options import FmuOptions

    story.at("loading and instantiating")
    with load(path, FmuOptions(interface_type=interface_type)) as fmu:
        story.at("preparing")
        fmu.component.prepare(
            _step(fmu.description, interface_type),
            np.zeros(fmu.component.interface.n_u, np.bool_),
            {},
        )
        yield fmu


def _step(description: Description, interface_type: InterfaceType) -> float:
    return description.capabilities[interface_type].fixed_step or description.default_step or STEP


def _times(h: float, steps: int) -> Vector:
    import numpy as np

    return np.array([k * h for k in range(steps + 1)], np.float64)


def _inputs(fmu: Fmu, steps: int) -> Matrix:
    """Hold every input at its start value."""
    import numpy as np

    starts = [
        value
        for signal in fmu.component.interface.inputs
        for value in (signal.start or (0.0,) * signal.size)
    ]
    return np.tile(np.array(starts, np.float64), (steps + 1, 1))


def _check_starts(story: _Story, description: Description, y: Vector) -> None:
    """Compare outputs whose start values are exact with what the unit gives."""
    column = 0
    for _, group in description.ports("output"):
        for variable in group:
            values = tuple(y[column : column + variable.size].tolist())
            column += variable.size
            if variable.initial == "exact" and variable.start not in (None, values):
                said, given = (
                    ", ".join(f"{v:g}" for v in row) for row in (variable.start or (), values)
                )
                story.problem(f"{variable.name!r} starts at {given}; the file says exactly {said}")


TASKS: Final[dict[str, Callable[..., None]]] = {
    "symbols": symbols,
    "run": run,
    "rollback": rollback,
}


def main(arguments: Sequence[str]) -> None:
    """Do a task."""
    task, result, *rest = arguments
    story = _Story(result)
    with suppress(ImportError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        TASKS[task](story, *rest)
    except CosimError as error:
        story.problem(str(error))
    except Exception as error:  # the process is there to find out what a foreign binary makes of it
        story.problem(f"{type(error).__name__}: {error}")
    story.tell("done", task)


if __name__ == "__main__":
    main(sys.argv[1:])
