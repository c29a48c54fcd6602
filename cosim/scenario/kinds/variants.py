"""Variants of a component: methods of an identifier, here, and filters of an observer.

A key of the table names the variant. Each is declared once, with what only it and some others take.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final, Literal, TypeAlias, TypeVar

from cosim.arrays import NAN
from cosim.theory.estimators import defaults

VariantName = TypeVar("VariantName", bound=str)


@dataclass(frozen=True, kw_only=True)
class Variant:
    """What a variant takes beside what every variant of its component takes.

    Parameters
    ----------
    inputs : frozenset of str
        Signals.
    needed : tuple of str
        Keys that must be given.
    own : mapping of key to float
        Keys that are refused with a variant that does not have them, with their defaults; NaN:
        there is none.
    """

    inputs: frozenset[str] = frozenset()
    needed: tuple[str, ...] = ()
    own: Mapping[str, float] = field(default_factory=dict)


# methods whose regression is linear in what they estimate
LINEAR_METHODS: Final = ("least-squares", "gradient", "drem")


def without_default(*keys: str) -> dict[str, float]:
    """Return keys of a variant that have no default."""
    return dict.fromkeys(keys, NAN)


def foreign_keys(variants: Mapping[VariantName, Variant], name: VariantName) -> list[str]:
    """Return the keys that other variants have and this variant has not, as they are declared."""
    keys: dict[str, None] = {}
    for variant in variants.values():
        keys |= dict.fromkeys(variant.own)
    return [key for key in keys if key not in variants[name].own]


def variants_with(variants: Mapping[VariantName, Variant], key: str) -> list[VariantName]:
    """Return the variants that have a key of their own."""
    return [name for name, variant in variants.items() if key in variant.own]


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
            inputs=frozenset({"alpha", "delta"}), own=without_default("window", "bounds")
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
