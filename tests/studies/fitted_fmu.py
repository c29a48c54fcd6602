"""An FMU x' = A x + B u, y = x with u = 1, and a recording of it with 1 % noise."""

from pathlib import Path

import numpy as np

from tests.fmi.small import able, compiled

A = -1.6
B = 2.4
SCENARIO = """
scenario = { name = "fit", stop = 5.0, step = 0.01 }
[components]
plant = { kind = "fmu", path = "plant.fmu", start = { A = -1.0, B = 1.0, C = 1.0 } }
one = { kind = "constant", value = 1.0 }
measured = { kind = "field-data", path = "measured.csv" }
[connections]
"plant.u" = "one.y"
"""


def response(t, a, b):
    """Return y in closed form."""
    return -b / a * (1.0 - np.exp(a * t))


def write_fit(folder: Path, spacing: float = 0.01) -> tuple[np.ndarray, np.ndarray]:
    """Write fit.toml, its FMU and a recording of more than 5 s; return what was recorded."""
    build = folder / "build"
    build.mkdir()
    able(compiled(build), folder / "plant.fmu", A=-1.0, B=1.0, C=1.0)
    (folder / "fit.toml").write_text(SCENARIO)
    t = np.round(np.arange(0.0, 5.0 + spacing, spacing), 6)
    y = response(t, A, B) + 0.01 * (-B / A) * np.random.default_rng(1).standard_normal(t.size)
    rows = zip(t.tolist(), y.tolist(), strict=True)
    (folder / "measured.csv").write_text("t,y\n" + "".join(f"{a!r},{b!r}\n" for a, b in rows))
    return t, y
