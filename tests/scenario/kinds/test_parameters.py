"""The parameters of component kinds, as ``cosim list`` shows them."""

from cosim.scenario.kinds import KINDS, parameters_of


def test_every_parameter_is_explained():
    """Of every kind, and of the tables inside; the required ones come first."""
    for name in KINDS:
        parameters = parameters_of(KINDS[name])
        assert parameters, name
        assert all(parameter.description for parameter in parameters), name
        required = [parameter.required for parameter in parameters if "." not in parameter.name]
        assert required == sorted(required, reverse=True), name
