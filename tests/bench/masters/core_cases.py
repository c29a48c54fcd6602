"""The cases without FMUs: only cosim runs them, beside the same arithmetic without a master."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cosim.scenario.exporting import export_component
from tests.bench.masters.building import build_program
from tests.bench.masters.cases import CONTENDERS, FLOOR, FmuCase, sampled_steps
from tests.bench.masters.core_systems import GAIN, OFFSET, WITHOUT_IDENTIFIER, loop_of_lags
from tests.bench.masters.environments import Command, Result, driver
from tests.bench.masters.systems import STEP_NS, Lag, System, ring

STEP = STEP_NS / 1e9  # s
OURS = "drive_core.py"
LAG_STEPS = 5_000_000  # of all lags of a loop together, whose rows are 80 MB then


class CoreCase(ABC):
    """A graph of ``core_systems.py``.

    Attributes
    ----------
    name : str
    contenders : tuple of str
    watched : tuple of str
        The signals that are compared with what they should be.
    fixed_steps : int or None
        Of the longer run; None: it is chosen.
    floor_name : str
    """

    name: str
    watched: tuple[str, ...]
    contenders: tuple[str, ...] = ("cosim",)
    fixed_steps: int | None = None
    floor_name: str = "C"

    @abstractmethod
    def build(self, folder: Path) -> None:
        """Compile what it needs."""

    def command(self, contender: str, steps: int) -> Command:
        """Return the process of a contender."""
        if contender == FLOOR:
            return self.floor(steps)
        return driver(OURS, (), self.task(steps))

    @abstractmethod
    def floor(self, steps: int) -> Command:
        """Return the process that all are compared with."""

    def task(self, steps: int) -> dict[str, Any]:
        """Return what a driver reads."""
        return {
            "system": self.name,
            "step_ns": STEP_NS,
            "steps": steps,
            "samples": sampled_steps(steps),
            "watched": self.watched,
        }

    def keeps(self, contender: str) -> str:
        """Return what a contender keeps of every step."""
        return "u, y"

    @abstractmethod
    def error(self, result: Result) -> float:
        """Return the largest error of the watched signals."""


@dataclass
class LagsCase(CoreCase):
    """Lags in a loop, beside ``lags.c``."""

    count: int
    _program: Path = field(init=False, default=Path())

    def __post_init__(self) -> None:
        self.name = f"lags-{self.count}"
        self.watched = tuple(f"lag{i}.y" for i in range(self.count))
        self.fixed_steps = LAG_STEPS // self.count

    def build(self, folder: Path) -> None:
        """Compile the program."""
        self._program = build_program(folder, "lags.c", "linear.c", "elementary.c")

    def floor(self, steps: int) -> Command:
        """Return the C program."""
        samples = ",".join(map(str, sampled_steps(steps)))
        values = (self.count, GAIN, OFFSET, STEP_NS, steps, samples)
        return Command((str(self._program), *map(str, values)))

    def error(self, result: Result) -> float:
        """Return the largest distance from the closed form."""
        return loop_of_lags(self.count).error(result.samples)


@dataclass
class ScenarioCase(CoreCase):
    """A shipped scenario, beside the kernels of its components in a plain loop (``kernels.c``).

    The identifier's first estimate takes more time than all other steps of the scenario together,
    and comes before the shorter run ends; that is one reason for the number of steps. Without it
    the master can be seen.
    """

    name: str
    watched: tuple[str, ...] = ("delta.y", "observer.delta")
    floor_name: str = "kernels"
    fixed_steps: int | None = 200_000
    settled: int = 6500  # steps that the observer takes; then it has the disturbance
    _library: Path = field(init=False, default=Path())

    def build(self, folder: Path) -> None:
        """Compile the loop."""
        self._library = build_program(folder, "kernels.c", shared=True)

    def floor(self, steps: int) -> Command:
        """Return the loop, behind the preparation by cosim."""
        task = {**self.task(steps), "library": str(self._library)}
        return driver("drive_kernels.py", (), task)

    def error(self, result: Result) -> float:
        """Return how far the observer is from the disturbance; NaN: the run is too short."""
        errors = [abs(a - b) for step, (a, b) in result.samples if step >= self.settled]
        return max(errors, default=np.nan)


@dataclass
class PythonCase(CoreCase):
    """A component written in Python, beside calls of its ``advance`` with the same arrays."""

    name: str
    watched: tuple[str, ...] = ("python.y",)
    floor_name: str = "body"

    def build(self, folder: Path) -> None:
        """Compile nothing."""

    def floor(self, steps: int) -> Command:
        """Return the calls."""
        return driver("drive_body.py", (), self.task(steps))

    def error(self, result: Result) -> float:
        """Return the largest distance from the closed form."""
        if self.name == "python-loop":
            lags = (Lag(gain=GAIN, bias=OFFSET, source=1), Lag(gain=1.0, bias=0.0, source=0))
            steps = [step for step, _ in result.samples]
            exact = System(self.name, lags).exact(steps)[:, 0]
        else:
            t = np.array([step for step, _ in result.samples]) * STEP
            exact = 0.5 * (np.sin(t) - np.cos(t) + np.exp(-t))
        outputs = np.array([row for _, (row,) in result.samples])
        return float(np.abs(outputs - exact).max())


@dataclass
class PlantCase(CoreCase):
    """The plant of ``academic`` as an exported FMU, beside the component itself."""

    fmi_version: str
    method: str
    floor_name: str = "component"
    _fmu: Path = field(init=False, default=Path())

    def __post_init__(self) -> None:
        self.name = f"plant FMI {self.fmi_version} {self.method}"
        self.watched = ("plant.x_a",)

    def build(self, folder: Path) -> None:
        """Export the plant."""
        self._fmu = folder / f"plant{self.fmi_version}.fmu"
        export_component("academic", "plant", self._fmu, fmi=self.fmi_version, force=True)

    def command(self, contender: str, steps: int) -> Command:
        """Return the process that runs the FMU."""
        if contender == FLOOR:
            return self.floor(steps)
        task = {**self.task(steps), "fmu": str(self._fmu), "method": self.method}
        return driver("drive_plant.py", (), task)

    def floor(self, steps: int) -> Command:
        """Return the process that runs the component."""
        return driver("drive_plant.py", (), {**self.task(steps), "fmu": None})

    def error(self, result: Result) -> float:
        """Return NaN: the bits are compared with those of the component."""
        return np.nan


@dataclass
class EnsembleCase(CoreCase):
    """Members of ``academic``, without its identifier, each of 40 000 steps.

    What counts as a step is a member. Of the rows the last one is kept, and sums over all. Beside
    it stand the kernels alone (``kernels.c``), initialized before the time is measured.
    """

    name: str = "members of academic"
    watched: tuple[str, ...] = ("observer.delta",)
    fixed_steps: int | None = 50
    floor_name: str = "kernels"
    _library: Path = field(init=False, default=Path())

    def build(self, folder: Path) -> None:
        """Compile the loop."""
        self._library = build_program(folder, "kernels.c", shared=True)

    def command(self, contender: str, steps: int) -> Command:
        """Return the process of a contender."""
        if contender == FLOOR:
            return self.floor(steps)
        return driver("drive_ensemble.py", (), {**self.task(steps), "library": None})

    def floor(self, steps: int) -> Command:
        """Return the loop over members."""
        task = {**self.task(steps), "library": str(self._library)}
        return driver("drive_ensemble.py", (), task)

    def keeps(self, contender: str) -> str:
        """Return what a contender keeps."""
        return "sums"

    def error(self, result: Result) -> float:
        """Return NaN: the bits are compared."""
        return np.nan


@dataclass
class ByHandCase(CoreCase):
    """Three FMUs of FMI 2 in a ring, step by step, beside the same by FMPy's classes."""

    name: str = "step(1) ring-3 FMI 2 cs"
    watched: tuple[str, ...] = ()
    floor_name: str = "FMPy"
    _fmus: FmuCase = field(init=False)

    def build(self, folder: Path) -> None:
        """Build the FMUs."""
        self._fmus = FmuCase(ring(3), "2", "cs")
        self._fmus.build(folder)

    def command(self, contender: str, steps: int) -> Command:
        """Return the process that steps a simulation."""
        if contender == FLOOR:
            return self.floor(steps)
        return driver("drive_by_hand.py", (), self._fmus.task(steps))

    def floor(self, steps: int) -> Command:
        """Return the process that steps FMPy's classes."""
        requirements = CONTENDERS["fmpy"].requirements
        return driver("drive_fmpy_by_hand.py", requirements, self._fmus.task(steps))

    def keeps(self, contender: str) -> str:
        """Return what a contender keeps of every step."""
        return "nothing"

    def error(self, result: Result) -> float:
        """Return NaN: both read the same output, and hold their inputs differently."""
        return np.nan


def core_cases() -> list[CoreCase]:
    """Return all cases without FMUs."""
    return [
        LagsCase(10),
        LagsCase(100),
        LagsCase(1000),
        LagsCase(3000),
        ScenarioCase("academic"),
        ScenarioCase(f"academic{WITHOUT_IDENTIFIER}"),
        ScenarioCase("closed-loop"),
        ScenarioCase(f"closed-loop{WITHOUT_IDENTIFIER}"),
        PythonCase("python-cascade"),
        PythonCase("python-loop"),
        PlantCase("2", "cs"),
        PlantCase("3", "cs"),
        PlantCase("2", "rk4"),
        PlantCase("3", "rk4"),
        ByHandCase(),
        EnsembleCase(),
    ]
