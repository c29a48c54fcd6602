"""An FMU x' = A x + B u, y = x with u = 1, and a recording of it with 1 % noise."""

from pathlib import Path

import numpy as np

from tests.fmi.small import able, compiled

A = -1.6
B = 2.4
EXPRESSION = "rms(plant.y - measured.y)"
SCENARIO = """
scenario = { name = "fit", stop = 5.0, step = 0.01 }
[components]
plant = { kind = "fmu", path = "plant.fmu", start = { A = -1.0, B = 1.0, C = 1.0 } }
one = { kind = "constant", value = 1.0 }
measured = { kind = "field-data", path = "measured.csv" }
[connections]
"plant.u" = "one.y"
"""
TIMES = np.round(np.arange(501) * 0.01, 2)


def response(t, a, b):
    """Return y in closed form."""
    return -b / a * (1.0 - np.exp(a * t))


def record(folder: Path, seed: int) -> np.ndarray:
    """Write a recording with noise of 1 % of the last value."""
    noise = np.random.default_rng(seed).standard_normal(TIMES.size)
    return write(folder, response(TIMES, A, B) + 0.01 * (-B / A) * noise)


def write(folder: Path, y: np.ndarray) -> np.ndarray:
    """Write a recording."""
    rows = [f"{t!r},{value!r}\n" for t, value in zip(TIMES.tolist(), y.tolist(), strict=True)]
    (folder / "measured.csv").write_text("time,y\n" + "".join(rows))
    return y


def write_fit(folder: Path) -> Path:
    """Write the scenario, its FMU and a recording."""
    build = folder / "build"
    build.mkdir()
    able(compiled(build), folder / "plant.fmu", A=-1.0, B=1.0, C=1.0)
    record(folder, 1)
    scenario = folder / "fit.toml"
    scenario.write_text(SCENARIO)
    return scenario
