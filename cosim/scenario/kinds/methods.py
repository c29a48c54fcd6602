"""The methods of an identifier: which signals they take, which keys are theirs."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal, TypeAlias, get_args

from cosim.arrays import NAN
from cosim.theory.estimators import augmented_kalman, drem, extended_kalman, gradient

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
METHODS: tuple[IdentificationMethod, ...] = get_args(IdentificationMethod)

# What a method takes beside the regressor, from what drives the observer.
INPUTS: Mapping[IdentificationMethod, frozenset[str]] = MappingProxyType(
    {
        "output-error": frozenset({"delta", "y", "u"}),
        "least-squares": frozenset(),
        "projection": frozenset({"delta"}),
        "rayleigh": frozenset(),
        "augmented-kalman": frozenset({"y", "u"}),
        "extended-kalman": frozenset({"y", "u"}),
        "drem": frozenset(),
        "gradient": frozenset(),
    }
)

# The keys of each method, beside those that all have, with their defaults; NaN: without it.
OPTIONS: Mapping[IdentificationMethod, Mapping[str, float]] = MappingProxyType(
    {
        "output-error": dict.fromkeys(
            ("offset", "window", "forgetting", "bounds", "deviation", "covariance"), NAN
        ),
        "least-squares": {"P0": NAN},
        "projection": dict.fromkeys(("window", "bounds"), NAN),
        "rayleigh": {},
        "augmented-kalman": {
            "deviation": augmented_kalman.DEVIATION,
            "covariance": NAN,
            "size": augmented_kalman.SIZE,
            "intensity": augmented_kalman.INTENSITY,
        },
        "extended-kalman": {
            "deviation": extended_kalman.DEVIATION,
            "covariance": NAN,
            "size": extended_kalman.SIZE,
        },
        "drem": {"gain": drem.GAIN, "forgetting": drem.FORGETTING},
        "gradient": {"gain": gradient.GAIN},
    }
)


def all_options() -> list[str]:
    """Return the keys that some methods have and others have not."""
    keys: dict[str, None] = {}
    for options in OPTIONS.values():
        keys |= dict.fromkeys(options)
    return list(keys)
