"""A scenario whose plant is an FMU that does wrong in one way or another."""

from tests.fmi.compiled import compile_fmu
from tests.fmi.rogues import STATELESS

SCENARIO = """
scenario = { name = "x", stop = 0.1, step = 0.01 }
[components]
plant = { kind = "fmu", path = "LIES.fmu" }
"""


def rogue_plants(folder, *names):
    """Write it, with FMUs of these names; return its path, and theirs."""
    fmus = [folder / f"{name}.fmu" for name in names]
    for fmu in fmus:
        compile_fmu(fmu, STATELESS, "rogue2.c", defines=(f"ROGUE={fmu.stem}",))
    (folder / "x.toml").write_text(SCENARIO)
    return folder / "x.toml", list(map(str, fmus))
