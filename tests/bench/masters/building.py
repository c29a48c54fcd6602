"""Build what the masters run: FMUs of ``lag.c``, and the C program of ``loop.c``."""

from __future__ import annotations

import subprocess
from pathlib import Path

from cosim.fmi.platforms import SUFFIX
from cosim.native import build
from tests.bench.masters.systems import Lag, System
from tests.fmi.compiled import HEADERS, compile_fmu

HERE = Path(__file__).parent
HEADER = '<?xml version="1.0" encoding="UTF-8"?>'
INTERFACE_TYPES = {"cs": "CoSimulation", "me": "ModelExchange"}
ANY_STEP = {"cs": ' canHandleVariableCommunicationStepSize="true"', "me": ""}


def description(version: str, interface_type: str) -> str:
    """Return the modelDescription.xml of a lag."""
    element = INTERFACE_TYPES[interface_type]
    entry = f'<{element} modelIdentifier="model"{ANY_STEP[interface_type]}/>'
    return HEADER + (_fmi2(entry) if version == "2" else _fmi3(entry))


def _fmi2(entry: str) -> str:
    return f"""
<fmiModelDescription fmiVersion="2.0" modelName="lag" guid="lag" numberOfEventIndicators="0">
{entry}
<ModelVariables>
<ScalarVariable name="u" valueReference="0" causality="input"><Real start="0"/></ScalarVariable>
<ScalarVariable name="y" valueReference="1" causality="output" initial="exact"><Real start="0"/>
</ScalarVariable>
<ScalarVariable name="der(y)" valueReference="2" causality="local" initial="calculated">
<Real derivative="2"/></ScalarVariable>
</ModelVariables>
<ModelStructure>
<Outputs><Unknown index="2" dependencies=""/></Outputs>
<Derivatives><Unknown index="3" dependencies="1 2"/></Derivatives>
<InitialUnknowns><Unknown index="3" dependencies="1 2"/></InitialUnknowns>
</ModelStructure>
</fmiModelDescription>"""


def _fmi3(entry: str) -> str:
    return f"""
<fmiModelDescription fmiVersion="3.0" modelName="lag" instantiationToken="lag">
{entry}
<ModelVariables>
<Float64 name="u" valueReference="0" causality="input" start="0"/>
<Float64 name="y" valueReference="1" causality="output" initial="exact" start="0"/>
<Float64 name="der(y)" valueReference="2" causality="local" initial="calculated" derivative="1"/>
<Float64 name="time" valueReference="3" causality="independent" variability="continuous"/>
</ModelVariables>
<ModelStructure>
<Output valueReference="1" dependencies=""/>
<ContinuousStateDerivative valueReference="2" dependencies="0 1"/>
<InitialUnknown valueReference="2" dependencies="0 1"/>
</ModelStructure>
</fmiModelDescription>"""


def build_fmus(system: System, version: str, interface_type: str, folder: Path) -> list[Path]:
    """Build the FMUs of a system; return one path for each lag.

    Lags that are alike share one. Beside an FMU stands its binary.
    """
    paths: dict[tuple[float, float], Path] = {}
    for lag in system.lags:
        if (lag.gain, lag.bias) not in paths:
            name = f"{system.name}-fmi{version}-{interface_type}-{len(paths)}"
            path = folder / f"{name}.fmu"
            _build_fmu(lag, version, interface_type, path)
            paths[lag.gain, lag.bias] = path
    return [paths[lag.gain, lag.bias] for lag in system.lags]


def _build_fmu(lag: Lag, version: str, interface_type: str, path: Path) -> None:
    defines = (f"FMI={version}", f"GAIN={lag.gain!r}", f"BIAS={lag.bias!r}")
    xml = description(version, interface_type)
    compile_fmu(path, xml, HERE / "lag.c", "unused.c", defines=defines)


def binary(fmu: Path) -> Path:
    """Return the binary of an FMU, as it was compiled."""
    return fmu.with_suffix(SUFFIX)


def build_program(
    folder: Path,
    source: str,
    *kernels: str,
    name: str = "",
    defines: tuple[str, ...] = (),
    shared: bool = False,
) -> Path:
    """Compile a C source of this folder together with kernels of cosim; a program or a library.

    Raises
    ------
    RuntimeError
        With the words of the compiler.
    """
    program = folder / (name or Path(source).stem)
    sources = [HERE / source, *map(build.source, kernels)]
    flags = ["-std=c11", "-ffp-contract=off", *build.OPTIONS, "-D_POSIX_C_SOURCE=200809L"]
    flags += [f"-I{HEADERS}", *(f"-D{define}" for define in defines)]
    if shared:
        flags += ["-shared", "-fPIC"]
    command = [*build.compiler(), *flags, *map(str, sources), "-o", str(program), "-ldl", "-lm"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        raise RuntimeError(f"{source}: {result.stderr}")
    return program


def build_loop(version: str, folder: Path) -> Path:
    """Compile ``loop.c`` for a version of FMI."""
    kernels = ("runge_kutta.c", "elementary.c")
    defines = (f"FMI={version}",)
    return build_program(folder, "loop.c", *kernels, name=f"loop{version}", defines=defines)
