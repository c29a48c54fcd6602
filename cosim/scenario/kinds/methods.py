"""The methods of an identifier: which signals they take, which keys are theirs."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal, TypeAlias

from cosim.scenario.kinds.variants import Variant, without_default
from cosim.theory.estimators import defaults

IdentificationMethod: TypeAlias = Literal[
    "output-error",
    "least-squares",
    "projection",
    "rayleigh",
    "augmented-kalman",
    "extended-kalman",
    "drem",
    "gradient",
]

# The inputs are those beside the regressor: alphas that are signals, and what drives the observer.
METHODS: Mapping[IdentificationMethod, Variant] = MappingProxyType(
    {
        "output-error": Variant(
            inputs=frozenset({"alpha", "delta", "y", "u"}),
            own=without_default(
                "offset", "window", "forgetting", "bounds", "deviation", "covariance"
            ),
        ),
        "least-squares": Variant(own=without_default("P0")),
        "projection": Variant(
            inputs=frozenset({"alpha", "delta"}),
            own=without_default("window", "bounds"),
        ),
        "rayleigh": Variant(inputs=frozenset({"alpha"})),
        "augmented-kalman": Variant(
            inputs=frozenset({"alpha", "y", "u"}),
            own={
                "deviation": defaults.AUGMENTED_DEVIATION,
                **without_default("covariance"),
                "size": defaults.KALMAN_SIZE,
                "intensity": defaults.AUGMENTED_INTENSITY,
            },
        ),
        "extended-kalman": Variant(
            inputs=frozenset({"alpha", "y", "u"}),
            own={
                "deviation": defaults.EXTENDED_DEVIATION,
                **without_default("covariance"),
                "size": defaults.KALMAN_SIZE,
            },
        ),
        "drem": Variant(own={"gain": defaults.DREM_GAIN, "forgetting": defaults.DREM_FORGETTING}),
        "gradient": Variant(own={"gain": defaults.GRADIENT_GAIN}),
    }
)
