"""What 'cosim list' says of the ports of the kinds is what their components have."""

from contextlib import ExitStack

import pytest

import cosim
from cosim.scenario.building.build import Builder
from cosim.scenario.kinds import KINDS
from tests.scenario.kinds.parts import DEPENDENT, PARTS


def names_of(side, present):
    """Return the names of the first alternative; those in brackets only where they are present."""
    first, _, _ = side.partition(", or ")
    names = [name.strip() for name in first.split(",") if name.strip()]
    absent = [f"[{name.strip('[]')}]" for name in names if name.strip("[]") not in present]
    return [name.strip("[]") for name in names if name not in absent]


@pytest.fixture(scope="module")
def interfaces(tmp_path_factory):
    """Return the interface of one component of each kind."""
    file = tmp_path_factory.mktemp("parts") / "parts.toml"
    file.write_text(PARTS)
    interfaces = {}
    for source in ("compensation", file, "academic", "closed-loop"):
        scenario = cosim.load(source)
        with ExitStack() as resources:
            builder = Builder(scenario, resources)
            for name, spec in scenario.specs.items():
                interfaces[spec.kind] = builder.components[name].interface
    return interfaces


def test_ports_are_those_of_the_component(interfaces):
    """Inputs before the arrow, outputs after it; where there may be more, the first ones."""
    mismatches = []
    for kind in (kind for kind in KINDS if kind not in DEPENDENT):
        inputs, outputs = KINDS[kind].ports.split("->")
        interface = interfaces[kind]
        for side, signals in ((inputs, interface.inputs), (outputs, interface.outputs)):
            names = [signal.name for signal in signals]
            shown = names_of(side, names)
            if "..." in shown:
                shown.remove("...")
                names = names[: len(shown)]
            if shown != names:
                mismatches.append((kind, shown, names))
    assert mismatches == []
