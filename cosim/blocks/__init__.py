"""Components made of the theory and the core.

Sources, plant, observer, regressor, identifier, controller, and small parts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from cosim.lazy import lazy_names

if TYPE_CHECKING:
    from cosim.blocks.arithmetic import gain, limit, sum_of
    from cosim.blocks.dynamics import Delay, lag
    from cosim.blocks.identifier import LeastSquaresIdentifier
    from cosim.blocks.look_up import LookUpTable
    from cosim.blocks.observer import observer_model
    from cosim.blocks.plant import descriptor_model
    from cosim.blocks.regressor import Regressor
    from cosim.blocks.renamed import Renamed
    from cosim.blocks.replay import Replay
    from cosim.blocks.sampled import Decimated, Sampled
    from cosim.blocks.source import Expression, Noise, Table, chirp, constant, ramp, sine, step
    from cosim.blocks.state_space import controller

_HOMES = {
    "chirp": "cosim.blocks.source",
    "constant": "cosim.blocks.source",
    "controller": "cosim.blocks.state_space",
    "Decimated": "cosim.blocks.sampled",
    "Delay": "cosim.blocks.dynamics",
    "descriptor_model": "cosim.blocks.plant",
    "Expression": "cosim.blocks.source",
    "gain": "cosim.blocks.arithmetic",
    "lag": "cosim.blocks.dynamics",
    "LeastSquaresIdentifier": "cosim.blocks.identifier",
    "limit": "cosim.blocks.arithmetic",
    "LookUpTable": "cosim.blocks.look_up",
    "Noise": "cosim.blocks.source",
    "observer_model": "cosim.blocks.observer",
    "ramp": "cosim.blocks.source",
    "Regressor": "cosim.blocks.regressor",
    "Renamed": "cosim.blocks.renamed",
    "Replay": "cosim.blocks.replay",
    "Sampled": "cosim.blocks.sampled",
    "sine": "cosim.blocks.source",
    "step": "cosim.blocks.source",
    "sum_of": "cosim.blocks.arithmetic",
    "Table": "cosim.blocks.source",
}

__all__ = [
    "Decimated",
    "Delay",
    "Expression",
    "LeastSquaresIdentifier",
    "LookUpTable",
    "Noise",
    "Regressor",
    "Renamed",
    "Replay",
    "Sampled",
    "Table",
    "chirp",
    "constant",
    "controller",
    "descriptor_model",
    "gain",
    "lag",
    "limit",
    "observer_model",
    "ramp",
    "sine",
    "step",
    "sum_of",
]

__getattr__ = lazy_names(__name__, _HOMES)


def __dir__() -> list[str]:
    return list(__all__)
