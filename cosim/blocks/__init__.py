"""Components made of the theory and the core.

Sources, plant, sensor, observer, regressor, identifier, controller, and small parts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from cosim.lazy import lazy_names

if TYPE_CHECKING:
    from cosim.blocks.arithmetic import gain, limit, sum_of, switch
    from cosim.blocks.compiled import CompiledFunction
    from cosim.blocks.dynamics import Delay, integrator, lag
    from cosim.blocks.identifier import LeastSquaresIdentifier
    from cosim.blocks.limited_integrator import LimitedIntegrator
    from cosim.blocks.look_up import LookUpTable
    from cosim.blocks.measurement import SensorParameters
    from cosim.blocks.observer import observer_model
    from cosim.blocks.pid import Pid, PidParameters
    from cosim.blocks.plant import descriptor_model
    from cosim.blocks.port_map import PortMap
    from cosim.blocks.product import Product
    from cosim.blocks.regressor import Regressor
    from cosim.blocks.renamed import Renamed
    from cosim.blocks.renaming import Renaming, map_ports
    from cosim.blocks.replay import Replay
    from cosim.blocks.sampled import Decimated, Sampled
    from cosim.blocks.sensor import Sensor
    from cosim.blocks.source import Expression, Noise, Table, chirp, constant, ramp, sine, step
    from cosim.blocks.state_space import (
        DiscreteStateSpace,
        SystemMatrices,
        controller,
        system_matrices,
    )
    from cosim.blocks.transfer import transfer_function

_HOMES = {
    "chirp": "cosim.blocks.source",
    "CompiledFunction": "cosim.blocks.compiled",
    "constant": "cosim.blocks.source",
    "controller": "cosim.blocks.state_space",
    "Decimated": "cosim.blocks.sampled",
    "Delay": "cosim.blocks.dynamics",
    "descriptor_model": "cosim.blocks.plant",
    "DiscreteStateSpace": "cosim.blocks.state_space",
    "Expression": "cosim.blocks.source",
    "gain": "cosim.blocks.arithmetic",
    "integrator": "cosim.blocks.dynamics",
    "lag": "cosim.blocks.dynamics",
    "LeastSquaresIdentifier": "cosim.blocks.identifier",
    "limit": "cosim.blocks.arithmetic",
    "LimitedIntegrator": "cosim.blocks.limited_integrator",
    "LookUpTable": "cosim.blocks.look_up",
    "Noise": "cosim.blocks.source",
    "map_ports": "cosim.blocks.renaming",
    "observer_model": "cosim.blocks.observer",
    "Pid": "cosim.blocks.pid",
    "PidParameters": "cosim.blocks.pid",
    "PortMap": "cosim.blocks.port_map",
    "Product": "cosim.blocks.product",
    "ramp": "cosim.blocks.source",
    "Regressor": "cosim.blocks.regressor",
    "Renamed": "cosim.blocks.renamed",
    "Renaming": "cosim.blocks.renaming",
    "Replay": "cosim.blocks.replay",
    "Sampled": "cosim.blocks.sampled",
    "Sensor": "cosim.blocks.sensor",
    "SensorParameters": "cosim.blocks.measurement",
    "sine": "cosim.blocks.source",
    "step": "cosim.blocks.source",
    "sum_of": "cosim.blocks.arithmetic",
    "switch": "cosim.blocks.arithmetic",
    "system_matrices": "cosim.blocks.state_space",
    "SystemMatrices": "cosim.blocks.state_space",
    "Table": "cosim.blocks.source",
    "transfer_function": "cosim.blocks.transfer",
}

__all__ = [
    "CompiledFunction",
    "Decimated",
    "Delay",
    "DiscreteStateSpace",
    "Expression",
    "LeastSquaresIdentifier",
    "LimitedIntegrator",
    "LookUpTable",
    "Noise",
    "Pid",
    "PidParameters",
    "PortMap",
    "Product",
    "Regressor",
    "Renamed",
    "Renaming",
    "Replay",
    "Sampled",
    "Sensor",
    "SensorParameters",
    "SystemMatrices",
    "Table",
    "chirp",
    "constant",
    "controller",
    "descriptor_model",
    "gain",
    "integrator",
    "lag",
    "limit",
    "map_ports",
    "observer_model",
    "ramp",
    "sine",
    "step",
    "sum_of",
    "switch",
    "system_matrices",
    "transfer_function",
]

__getattr__ = lazy_names(__name__, _HOMES)


def __dir__() -> list[str]:
    return list(__all__)
