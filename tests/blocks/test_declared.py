"""Units that a scenario declares for the ports of a component."""

import pytest

from cosim.blocks.declared import Declared, with_units
from cosim.blocks.dynamics import lag
from cosim.core.linear import Linear
from cosim.errors import GraphError
from cosim.testing import check_component


def make(unit=None):
    return Linear(lag(time_constant=0.1, unit=unit))


def test_a_declared_component_keeps_the_contract():
    """It is the component, bit for bit, and passes on what it can do."""
    check_component(lambda: with_units(make(), {"u": "m", "y": "mm"}))
    declared = with_units(make(), {"y": "mm"})
    assert isinstance(declared, Declared)
    assert [signal.unit for signal in declared.interface.signals] == [None, "mm"]


def test_components_that_declare_their_units_need_no_adapter():
    """The component itself is returned."""
    component = make("m")
    assert with_units(component, {"y": "m"}) is component
    assert with_units(component, {}) is component


@pytest.mark.parametrize(
    ("units", "text"),
    [
        ({"x": "m"}, "unit: there is no port 'x'"),
        ({"y": "mm"}, r"unit of 'y':.*'mm', but the component itself declares 'm'"),
    ],
)
def test_a_contradiction_is_refused(units, text):
    """Values in the unit that a component declares are never taken for values in another."""
    with pytest.raises(GraphError, match=text):
        with_units(make("m"), units)
