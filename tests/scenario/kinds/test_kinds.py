"""Kinds of scenario files: their table, and how to add one."""

import importlib.util
import sys
import textwrap
from contextlib import ExitStack
from typing import Literal

import numpy as np
import pytest
from fmpy.validation import validate_fmu

import cosim
from cosim.core.contracts import prepare
from cosim.errors import ScenarioError
from cosim.fmi.reading.model_description import read
from cosim.scenario import kinds
from cosim.scenario.building.build import Builder, parse
from cosim.scenario.document.document import Document
from cosim.scenario.exporting import export_component
from cosim.scenario.kinds import KINDS, parameters_of
from cosim.scenario.kinds.base import PeriodicKind

DEAD = """
scenario = {{ name = "dead", stop = 1.0, step = 0.25 }}
components.u = {{ kind = "ramp", slope = 1.0 }}
[components.dead]
kind = "dead-zone"
width = {width}

[connections]
"dead.u" = "u.y"
"""


@pytest.fixture
def dead_zone(tmp_path, monkeypatch):
    """Add the example of the package's docstring to the kinds."""
    _, _, after = kinds.__doc__.partition("for example::\n")
    example, _, _ = after.partition("\nWith the class")
    path = tmp_path / "dead_zone.py"
    path.write_text(textwrap.dedent(example))
    spec = importlib.util.spec_from_file_location("dead_zone", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setitem(sys.modules, "cosim.scenario.kinds.dead_zone", module)
    monkeypatch.setitem(KINDS.homes, "dead-zone", "dead_zone.DeadZoneKind")


def dead(folder, width):
    return parse(Document(DEAD.format(width=width), "dead", folder))


def test_the_example_of_a_kind_runs(dead_zone, tmp_path):
    """With the entry that the docstring names, a file may use it, and a log replays."""
    log = cosim.run(dead(tmp_path, 0.5), out=tmp_path / "dead.mcap")
    assert log["dead.y"].tolist() == [0.0, 0.0, 0.0, 0.25, 0.5]
    assert cosim.diff(log, cosim.replay(tmp_path / "dead.mcap")).equal


def test_a_usage_error_of_the_example_is_a_problem_of_the_file(dead_zone, tmp_path):
    """With the line of the component; a missing key shows the description of its field."""
    with pytest.raises(ScenarioError) as error:
        cosim.run(dead(tmp_path, -1.0))
    assert "dead:4: components.dead: width: expected a number >= 0, got -1.0" in str(error.value)
    text = DEAD.format(width=1.0).replace("width = 1.0", "")
    with pytest.raises(ScenarioError) as error:
        parse(Document(text, "dead", tmp_path))
    assert "'width' is missing (half the width of the zone" in str(error.value)


# --- all kinds ---

# one component of every kind that depends on no file
PARTS = """
scenario = { name = "parts", stop = 1.0, step = 0.1 }
[components]
constant = { kind = "constant", value = 1.0 }
step = { kind = "step", time = 0.5 }
ramp = { kind = "ramp", slope = 0.5, offset = 0.5 }
chirp = { kind = "chirp", rate = 1.0, sweep = 1.0 }
expression = { kind = "expression", y = "t" }
table = { kind = "table", t = [0.0, 1.0], y = [0.0, 1.0] }
noise = { kind = "noise", deviation = 1.0, seed = 1 }
sum = { kind = "sum", signs = [1.0, -1.0] }
gain = { kind = "gain", K = 2.0 }
limit = { kind = "limit", lower = 0.0, upper = 0.75 }
lag = { kind = "lag", time_constant = 1.0 }
delay = { kind = "delay", delay = 0.1 }
sensor = { kind = "sensor", dropout = 0.1, seed = 1 }
product = { kind = "product", operations = "*/" }
switch = { kind = "switch" }
integrator = { kind = "integrator", initial = 0.01, upper = 0.5 }
transfer = { kind = "transfer-function", numerator = [1.0, 3.0], denominator = [1.0, 1.0, 9.0] }
pid = { kind = "pid", gain = 2.0, integral_time = 0.5, derivative_time = 0.1, upper = 0.6 }
digital = { kind = "pid", gain = 2.0, integral_time = 0.5, derivative_time = 0.1, period = 0.2 }
look = { kind = "look-up-table", u = [0.0, 1.0], y = [0.0, 1.0] }
controller = { kind = "controller", A = [[-1.0]], B = [[1.0]], C = [[1.0]] }
sampled = { kind = "discrete-state-space", period = 0.2, A = [[0.5]], B = [[1.0]], C = [[1.0]] }
[connections]
"pid.measurement" = "transfer.y"
"digital.measurement" = "transfer.y"
"""
INPUTS = {"sum": "u1 u2", "product": "u1 u2", "switch": "u1 u2 control"}
INPUTS |= {"pid": "setpoint", "digital": "setpoint"}
OF_ONE = "gain limit lag delay sensor integrator transfer look controller sampled"
INPUTS |= dict.fromkeys(OF_ONE.split(), "u")
DEPENDENT = {"fmu", "recording", "field-data", "python"}  # on a file


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """Write the scenario of all parts; return its path."""
    file = tmp_path_factory.mktemp("parts") / "parts.toml"
    ports = [f"{name}.{port}" for name in INPUTS for port in INPUTS[name].split()]
    file.write_text(PARTS + "\n".join(f'"{port}" = "ramp.y"' for port in ports))
    return file


@pytest.fixture(scope="module")
def components(file):
    """Return a component of each kind that depends on no file, initialized, and its step."""
    components = {}
    for source in ("compensation", file, "academic", "closed-loop"):
        scenario = cosim.load(source)
        with ExitStack() as resources:
            builder = Builder(scenario, resources)
            for name, spec in scenario.specs.items():
                component = builder.components[name]
                n_u = component.interface.n_u
                prepare(component, 1e-3, np.zeros(n_u, np.bool_), {})
                component.initialize(0.0, np.ones(n_u))
                components[spec.kind] = (component.interface, component.native())
    assert components.keys() == set(KINDS) - DEPENDENT
    return components


def names_of(side, present):
    """Return the names of the first alternative; those in brackets only where they are present."""
    first, _, _ = side.partition(", or ")
    names = [name.strip() for name in first.split(",") if name.strip()]
    absent = [f"[{name.strip('[]')}]" for name in names if name.strip("[]") not in present]
    return [name.strip("[]") for name in names if name not in absent]


def test_ports_are_those_of_the_component(components):
    """Inputs before the arrow, outputs after it; where there may be more, the first ones."""
    mismatches = []
    for kind, (interface, _) in components.items():
        inputs, outputs = KINDS[kind].ports.split("->")
        for side, signals in ((inputs, interface.inputs), (outputs, interface.outputs)):
            names = [signal.name for signal in signals]
            shown = names_of(side, names)
            if "..." in shown:
                shown.remove("...")
                names = names[: len(shown)]
            if shown != names:
                mismatches.append((kind, shown, names))
    assert mismatches == []


def test_every_kind_has_a_compiled_step(components):
    """And compiled outputs where they follow inputs, for an algebraic loop to evaluate again."""
    for kind, (interface, step) in components.items():
        assert interface.native, kind
        assert step is not None, kind
        if any(interface.feeds(signal.name) for signal in interface.outputs):
            assert step.outputs, kind


def test_a_log_of_all_parts_replays_bit_for_bit(file, tmp_path):
    """All that can be computed again is, with blocks of one size or another."""
    log = cosim.run(file, out=tmp_path / "parts.mcap")
    assert cosim.diff(log, cosim.replay(log)).equal
    assert cosim.diff(log, cosim.run(file, block=1)).equal


@pytest.mark.slow
def test_as_fmus_they_are_the_same(file, tmp_path):
    """A run with FMUs in their places records what the run recorded.

    The inputs at the end of a step are u0 + h (u1 - u0)/h there, which is u1 but for its rounding.
    """
    names = ("switch", "integrator", "transfer", "sampled")
    swaps = {name: tmp_path / f"{name}.fmu" for name in names}
    for name, fmu in swaps.items():
        export_component(str(file), name, fmu, fmi="3")
        assert validate_fmu(str(fmu)) == []
        assert ("me" in read(fmu).description.capabilities) == (name == "transfer")
    expected = cosim.run(file)
    run = cosim.run(file, swap=swaps, set={f"{name}.interface_type": "cs" for name in names})
    for name in names:
        known = expected[f"{name}.y"]
        difference = abs(run[f"{name}.y"][:: 2 if name == "sampled" else 1] - known)
        assert difference.max() <= 1e-14 * abs(known).max(), name


def test_every_kind_has_the_name_it_is_listed_under_and_explains_its_parameters():
    """Those of tables inside too; the required ones come first."""
    for name, kind in KINDS.items():
        assert kind.model_fields["kind"].annotation == Literal[name]
        parameters = parameters_of(kind)
        assert all(parameter.description for parameter in parameters), name
        required = [parameter.required for parameter in parameters if "." not in parameter.name]
        assert required == sorted(required, reverse=True), name


def test_a_periodic_kind_must_say_how_its_period_is_kept():
    """Else it would accept ``period`` and ignore it."""

    class Forgetful(PeriodicKind):
        kind: Literal["forgetful"]

        def build(self, name, context):
            raise NotImplementedError

    with pytest.raises(TypeError, match="with_period"):
        Forgetful.model_validate({"kind": "forgetful", "period": 0.5})
