"""FMUs of other tools, run here and in FMPy, each in a child process of its own.

``python -m tests.fmi.collection FOLDER [WORD...]`` runs every FMU below FOLDER whose path contains
one of the words (all where there are none) with constant inputs, prints a line an FMU and interface
type, and how many ran in which of the two. The FMUs themselves are no part of the project.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

from cosim.temporary import TemporaryFolder

STEPS = 10  # communication steps of a run
TIMEOUT = 40.0  # s, of a child
DEFAULT_STEP = 0.01  # s, where the FMU prefers none
RTOL = 1e-9  # of both solvers in model exchange
# FMPy records what its last step reached, with a CVode of its own; both solvers keep RTOL, but an
# event located within their tolerances may move a value by its slope, which is of order 1 to 1e3.
CLOSE = {"cs": 1e-9, "me": 1e-5}
PLATFORMS = ("linux64", "x86_64-linux")


@dataclass(frozen=True)
class Outcome:
    """What a run of one tool gave: rows, or the reason why there are none."""

    rows: Mapping[str, Sequence[float]]  # by variable name
    problem: str = ""


@dataclass(frozen=True)
class Line:
    """One FMU and interface type, in both tools."""

    path: Path
    interface_type: str
    here: Outcome
    fmpy: Outcome

    def largest_difference(self, rows: slice) -> float | None:
        """Return the largest relative difference of a common variable; None: there is none."""
        if self.here.problem or self.fmpy.problem:
            return None
        differences = []
        for name, values in self.fmpy.rows.items():
            if name in self.here.rows:
                here = self.here.rows[name]
                scale = max(1e-9, *(abs(value) for value in (*here, *values)))
                pairs = zip(here[rows], values[rows], strict=True)
                differences.append(max(abs(a - b) for a, b in pairs) / scale)
        return max(differences, default=None)

    @property
    def difference(self) -> float | None:
        """That of all rows."""
        return self.largest_difference(slice(None))

    @property
    def agrees(self) -> bool:
        """Whether nothing that can be compared differs."""
        return (self.difference or 0.0) <= CLOSE[self.interface_type]

    def text(self, folder: Path) -> str:
        """Return the line of the table."""
        place = self.path.relative_to(folder)
        here = self.here.problem or "runs"
        fmpy = self.fmpy.problem or "runs"
        texts = [str(place), self.interface_type, here, fmpy]
        for difference in (self.largest_difference(slice(1)), self.difference):
            texts.append("" if difference is None else f"{difference:.1e}")
        return " | ".join(texts)


def lines(folder: Path, words: Sequence[str] = ()) -> Iterator[Line]:
    """Run all FMUs for this machine below a folder."""
    for path in sorted(folder.rglob("*.fmu")):
        if words and not any(word in str(path) for word in words):
            continue
        for interface_type in interface_types(path):
            here, fmpy = (run_in_child(tool, path, interface_type) for tool in ("here", "fmpy"))
            yield Line(path, interface_type, here, fmpy)


def interface_types(path: Path) -> list[str]:
    """Return the interface types of an FMU with a binary for this machine, as FMPy reads them."""
    from fmpy import read_model_description

    try:
        with ZipFile(path) as archive:
            members = [name.split("/") for name in archive.namelist() if name[-1] != "/"]
        folders = {member[1] for member in members if member[0] == "binaries" and len(member) > 2}
        if folders.isdisjoint(PLATFORMS):
            return []
        description = read_model_description(str(path), validate=False)
    except (BadZipFile, Exception):  # FMPy raises bare Exceptions
        return []
    types = {"me": description.modelExchange, "cs": description.coSimulation}
    return [name for name, found in types.items() if found]


def run_in_child(tool: str, path: Path, interface_type: str) -> Outcome:
    """Run an FMU with one tool."""
    with TemporaryFolder("collection") as folder:
        result = folder / "result.json"
        root = Path(__file__).parents[2]
        arguments = [tool, str(path.resolve()), interface_type, str(result)]
        try:
            child = subprocess.run(
                [sys.executable, "-m", "tests.fmi.collection", "--child", *arguments],
                cwd=folder,
                env={**os.environ, "PYTHONPATH": str(root), "TMPDIR": str(folder)},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                timeout=TIMEOUT,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return Outcome({}, f"hangs: no end within {TIMEOUT} s")
        if not result.exists():
            last = child.stderr.decode(errors="replace").strip().splitlines()[-1:]
            return Outcome({}, f"ends with {child.returncode}: {' '.join(last)[:200]}")
        return Outcome(**json.loads(result.read_text()))


def grid(path: Path, interface_type: str) -> tuple[float, int]:
    """Return the communication step [s], in whole nanoseconds, and the number of steps."""
    from fmpy import read_model_description

    description: Any = read_model_description(str(path), validate=False)
    experiment = description.defaultExperiment
    step = DEFAULT_STEP
    if experiment is not None:
        with suppress(TypeError, ValueError):
            step = min(1.0, float(experiment.stopTime)) / 100
        with suppress(TypeError, ValueError):
            step = float(experiment.stepSize)
    if interface_type == "cs":
        with suppress(TypeError, ValueError):
            step = float(description.coSimulation.fixedInternalStepSize)
    return max(1, round(step * 1e9)) / 1e9, STEPS


def run_here(path: Path, interface_type: str) -> dict[str, list[float]]:
    """Run an FMU here; return its outputs at the communication points."""
    import cosim
    from cosim.core.recorders import Memory
    from cosim.fmi.reading.model_description import read

    h, steps = grid(path, interface_type)
    stop = round(h * 1e9) * steps / 1e9
    fmu_table = f'kind = "fmu"\npath = "{path}"\ninterface_type = "{interface_type}"'
    solver = f"\ntolerance = {RTOL}" if interface_type == "me" else ""
    text = (
        f'[scenario]\nname = "one"\nstop = {stop!r}\nstep = {h!r}\n'
        f"[components.fmu]\n{fmu_table}{solver}\n[connections]\n"
    )
    scenario = Path("one.toml")
    scenario.write_text(text)
    memory = Memory()
    cosim.run(scenario, recorder=memory)
    rows: dict[str, list[float]] = {}
    for signal, variables in read(path).description.ports("output"):
        values = memory[f"fmu.{signal.name}"].reshape(steps + 1, signal.size)
        column = 0
        for variable in variables:
            if variable.size == 1:
                rows[variable.name] = values[:, column].tolist()
            column += variable.size
    return rows


def run_in_fmpy(path: Path, interface_type: str) -> dict[str, list[float]]:
    """Run an FMU in FMPy, by the same calls; return what it records at the communication points.

    Inputs have their start values; the FMU gets no stop time, and in co-simulation no tolerance.
    There is one step more, as rounding may make FMPy do a tiny one before the end.
    """
    import numpy as np
    from fmpy import read_model_description, simulate_fmu

    description: Any = read_model_description(str(path), validate=False)
    if description.defaultExperiment is not None:
        description.defaultExperiment.tolerance = None
    inputs = [v for v in description.modelVariables if v.causality == "input"]
    # FMPy does not read every spelling of the other types' values
    numbers = [v for v in inputs if v.type in ("Real", "Float64", "Integer", "Int32")]
    starts = {v.name: v.start for v in numbers if v.start is not None}

    h, steps = grid(path, interface_type)
    kind = {"me": "ModelExchange", "cs": "CoSimulation"}[interface_type]
    result = simulate_fmu(
        str(path),
        validate=False,
        start_time=0.0,
        stop_time=h * (steps + 1),
        output_interval=h,
        fmi_type=kind,
        relative_tolerance=RTOL if interface_type == "me" else None,
        record_events=False,
        model_description=description,
        start_values=starts,
        set_stop_time=False,
    )
    time = result["time"]
    wanted = [int(np.argmin(abs(time - k * h))) for k in range(steps + 1)]
    if abs(time[wanted] - np.arange(steps + 1) * h).max() > 1e-6 * h:
        raise ValueError(f"records {len(time)} rows up to t = {time[-1]} s only")
    rows = {}
    for name in result.dtype.names:
        if name != "time" and result[name].ndim == 1:
            rows[name] = result[name][wanted].astype(np.float64).tolist()
    for name, values in rows.items():
        if not np.isfinite(values).all():
            raise ValueError(f"{name} is not finite")
    return rows


def child(tool: str, path: str, interface_type: str, result: str) -> None:
    """Run one FMU and write what came out; foreign exit handlers do not count."""
    run = {"here": run_here, "fmpy": run_in_fmpy}[tool]
    outcome: dict[str, Any] = {"rows": {}, "problem": ""}
    try:
        outcome["rows"] = run(Path(path), interface_type)
    except Exception as error:  # of a foreign tool: anything
        outcome["problem"] = f"{type(error).__name__}: {error}"[:500].replace("\n", "; ")
    Path(result).write_text(json.dumps(outcome))
    os._exit(0)


def summary(table: Sequence[Line]) -> str:
    """Return how many ran where, and which do not run here or differ."""
    here = sum(not line.here.problem for line in table)
    fmpy = sum(not line.fmpy.problem for line in table)
    compared = [line for line in table if line.difference is not None]
    agreeing = sum(line.agrees for line in compared)
    return (
        f"{len(table)} FMUs and interface types: {here} run here, {fmpy} in FMPy; "
        f"{agreeing} of {len(compared)} compared agree"
    )


def main(arguments: Sequence[str]) -> None:
    """Print the table."""
    folder = Path(arguments[0])
    table = []
    for line in lines(folder, arguments[1:]):
        table.append(line)
        print(line.text(folder), flush=True)
    print(summary(table))


if __name__ == "__main__":
    if sys.argv[1] == "--child":
        child(*sys.argv[2:])
    else:
        main(sys.argv[1:])
