"""What is measured: a case is a system that several contenders run, one of them the C program."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

from tests.bench.masters.building import binary, build_fmus, build_loop
from tests.bench.masters.environments import Command, Result, driver
from tests.bench.masters.systems import STEP_NS, System

FLOOR = "floor"  # stands for what all are compared with
LONGEST_SAMPLED = 20_000  # steps: the errors of short and of long runs are to be comparable
SAMPLE_DISTANCE = 250  # steps


@dataclass(frozen=True)
class Contender:
    """A master: its driver, the packages that it needs in an environment of its own, what it keeps.

    Without requirements it runs in the environment of the benchmark.
    """

    driver: str
    requirements: tuple[str, ...]
    keeps: str


CONTENDERS: Mapping[str, Contender] = MappingProxyType(
    {
        "cosim": Contender("drive_cosim.py", (), "u, y"),
        "ecos": Contender("drive_ecos.py", ("ecospy", "tbb"), "nothing"),
        "libcosim": Contender("drive_libcosim.py", ("libcosimpy",), "u, y"),
        "fmpy": Contender("drive_fmpy.py", ("fmpy",), "u, y"),
        "fmpy-ssp": Contender("drive_fmpy_ssp.py", ("fmpy",), "u, y"),
        "cofmupy": Contender("drive_cofmupy.py", ("cofmupy",), "y"),
        "pathsim": Contender("drive_pathsim.py", ("pathsim-fmi",), "u, y"),
    }
)


class Case(Protocol):
    """One row of the table for each of its contenders."""

    @property
    def name(self) -> str:
        """Its name."""
        ...

    @property
    def contenders(self) -> tuple[str, ...]:
        """Who runs it, without the floor."""
        ...

    @property
    def floor_name(self) -> str:
        """What all are compared with."""
        ...

    @property
    def fixed_steps(self) -> int | None:
        """The number of steps of the longer run, of all contenders; None: it is chosen."""
        ...

    def build(self, folder: Path) -> None:
        """Compile what it needs."""
        ...

    def command(self, contender: str, steps: int) -> Command:
        """Return the process of a contender, or of what all are compared with (``FLOOR``)."""
        ...

    def keeps(self, contender: str) -> str:
        """Return what a contender keeps of every step."""
        ...

    def error(self, result: Result) -> float:
        """Return the largest error of the sampled outputs."""
        ...


def sampled_steps(steps: int) -> list[int]:
    """Return the steps whose outputs are compared with the closed form."""
    end = min(steps, LONGEST_SAMPLED)
    return [*range(SAMPLE_DISTANCE, end, SAMPLE_DISTANCE), end]


@dataclass
class FmuCase:
    """A system of FMUs.

    Parameters
    ----------
    system : System
    fmi_version : {"2", "3"}
    method : {"cs", "rk4", "RK45"}
        Co-simulation, or the solver of model exchange.
    """

    system: System
    fmi_version: str
    method: str
    contenders: tuple[str, ...] = tuple(CONTENDERS)
    fixed_steps: int | None = None
    floor_name: str = "C"
    _loop: Path = field(init=False, default=Path())
    _fmus: list[Path] = field(init=False, default_factory=list)

    @property
    def interface_type(self) -> str:
        """``cs`` or ``me``."""
        return "cs" if self.method == "cs" else "me"

    @property
    def name(self) -> str:
        """Such as ``ring-3 FMI 2 cs``."""
        return f"{self.system.name} FMI {self.fmi_version} {self.method}"

    def build(self, folder: Path) -> None:
        """Compile FMUs and the loop."""
        self._loop = build_loop(self.fmi_version, folder)
        self._fmus = build_fmus(self.system, self.fmi_version, self.interface_type, folder)

    def command(self, contender: str, steps: int) -> Command:
        """Return the process of a contender."""
        if contender == FLOOR:
            return self._floor(steps)
        master = CONTENDERS[contender]
        return driver(master.driver, master.requirements, self.task(steps))

    def _floor(self, steps: int) -> Command:
        samples = ",".join(map(str, sampled_steps(steps)))
        arguments = [str(self._loop), self.method, str(STEP_NS), str(steps), samples]
        for lag, fmu in zip(self.system.lags, self._fmus, strict=True):
            arguments += [str(binary(fmu)), str(-1 if lag.source is None else lag.source)]
        return Command(tuple(arguments))

    def task(self, steps: int) -> dict[str, Any]:
        """Return what a driver reads."""
        lags = []
        for i, (lag, fmu) in enumerate(zip(self.system.lags, self._fmus, strict=True)):
            lags.append({"name": f"lag{i}", "fmu": str(fmu), "source": lag.source})
        return {
            "lags": lags,
            "fmi_version": self.fmi_version,
            "interface_type": self.interface_type,
            "method": self.method,
            "step_ns": STEP_NS,
            "steps": steps,
            "samples": sampled_steps(steps),
        }

    def keeps(self, contender: str) -> str:
        """Return what a contender keeps of every step."""
        return CONTENDERS[contender].keeps

    def error(self, result: Result) -> float:
        """Return the largest distance of the sampled outputs from the closed form."""
        return self.system.error(result.samples)
