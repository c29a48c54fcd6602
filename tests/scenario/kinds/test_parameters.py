"""The parameters of component kinds, as ``cosim list`` shows them."""

import pytest

from cosim.scenario.kinds import KINDS
from cosim.scenario.kinds.parameters import parameters_of


@pytest.mark.parametrize("name", KINDS)
def test_every_parameter_is_explained(name):
    """Of every kind, and of the tables inside; the required ones come first."""
    parameters = parameters_of(KINDS[name])
    assert parameters
    assert all(parameter.description for parameter in parameters)
    required = [parameter.required for parameter in parameters if "." not in parameter.name]
    assert required == sorted(required, reverse=True)
