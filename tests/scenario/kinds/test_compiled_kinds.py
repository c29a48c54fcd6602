"""Every kind of component advances in compiled code."""

from __future__ import annotations

from contextlib import ExitStack

import numpy as np
import pytest

import cosim
from cosim.core.contracts import prepare
from cosim.scenario.building.build import Builder
from cosim.scenario.kinds import KINDS
from tests.scenario.kinds.parts import DEPENDENT, PARTS

# "python" is a class of the user; what depends on a file has tests of its own: replays and field
# data in tests/blocks/test_contract.py, FMUs in tests/fmi
WITHOUT_EXAMPLE = DEPENDENT


@pytest.fixture(scope="module")
def steps(tmp_path_factory):
    """Return the compiled step of one component of each kind, with its interface."""
    file = tmp_path_factory.mktemp("parts") / "parts.toml"
    file.write_text(PARTS)
    steps = {}
    for source in ("compensation", file, "academic"):
        scenario = cosim.load(source)
        with ExitStack() as resources:
            builder = Builder(scenario, resources)
            for name, spec in scenario.specs.items():
                component = builder.components[name]
                steps.setdefault(spec.kind, (component.interface, compiled(component)))
    return steps


def compiled(component):
    """Return the compiled step of a component that is initialized."""
    n_u = component.interface.n_u
    prepare(component, 1e-3, np.zeros(n_u, np.bool_), {})
    component.initialize(0.0, np.ones(n_u))
    return component.native()


def test_every_kind_has_a_compiled_step(steps):
    """And compiled outputs where they follow inputs, for an algebraic loop to evaluate again."""
    for kind in (kind for kind in KINDS if kind not in WITHOUT_EXAMPLE):
        interface, step = steps[kind]
        assert interface.native, kind
        assert step is not None, kind
        if any(interface.feeds(signal.name) for signal in interface.outputs):
            assert step.outputs, kind
