"""Variants of a component: methods of an identifier, filters of an observer.

A key of the table names the variant. Each is declared once, with what only it and some others take.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeVar

from cosim.arrays import NAN

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
