"""Identifiers as models to export."""

import numpy as np

from cosim.fmi.exporting.identifier import output_error as kernel_of_output_error
from cosim.fmi.exporting.kernels import DiscreteModel
from tests.scenario.online import COARSE
from tests.scenario.online import identifier as online


def output_error():
    """Return the identifier of the example for a run of 1 s; estimates begin before its end."""
    settings = {**COARSE, "scenario.stop": 1.0, "identifier.start": 3.5}
    component = online("academic", {**settings, "identifier.period": 0.01})
    held = np.zeros(component.interface.n_u, np.bool_)
    constants = component.method.constants(0.01, held, component.method.design(0.01, held))
    kernel = kernel_of_output_error(constants)
    return DiscreteModel(component.interface, kernel, 1_000_000, "it is discrete")
