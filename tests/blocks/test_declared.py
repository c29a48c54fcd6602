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


def test_each_element_may_have_a_unit_of_its_own():
    """One for all elements is kept as one; another number of them is refused."""
    component = Linear(lag(time_constant=0.1, size=2))
    declared = with_units(component, {"u": ["mm", "mm"], "y": ["mm", "m/s"]})
    assert [signal.unit for signal in declared.interface.signals] == ["mm", ("mm", "m/s")]
    check_component(lambda: with_units(Linear(lag(time_constant=0.1, size=2)), {"y": ["mm", "N"]}))
    with pytest.raises(GraphError, match=r"unit of 'y': expected 2 units.*got \['m', 's', 'm'\]"):
        with_units(component, {"y": ["m", "s", "m"]})
    with pytest.raises(GraphError, match=r"unit of 'y':.*\['mm', 'N'\].*declares 'mm, m/s'"):
        with_units(declared, {"y": ["mm", "N"]})


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
