"""Variants: methods of an identifier, filters of an observer, and the keys that are theirs."""

from typing import get_args

import pytest

from cosim.scenario.kinds.identification import IdentifierKind
from cosim.scenario.kinds.observers import UnknownInputObserverKind
from cosim.scenario.kinds.reconstruction import FILTERS
from cosim.scenario.kinds.variants import METHODS, Variant, foreign_keys, variants_with

KINDS = {"method": (IdentifierKind, METHODS), "filter": (UnknownInputObserverKind, FILTERS)}


@pytest.mark.parametrize("key", KINDS)
def test_every_variant_that_a_table_may_name_is_declared(key):
    """In the order in which the schema has them; their keys can be left out of the table."""
    kind, variants = KINDS[key]
    assert list(variants) == list(get_args(kind.model_fields[key].annotation))
    for variant in variants.values():
        for name in (*variant.needed, *variant.own):
            assert not kind.model_fields[name].is_required()


def test_a_key_is_foreign_where_others_have_it_alone():
    """Each once, in order of declaration; a key that is only needed belongs to nobody."""
    variants = {
        "a": Variant(own={"x": 1.0, "y": 2.0}),
        "b": Variant(needed=("w",), own={"y": 3.0, "z": 4.0}),
        "c": Variant(needed=("w",)),
    }
    assert foreign_keys(variants, "a") == ["z"]
    assert foreign_keys(variants, "b") == ["x"]
    assert foreign_keys(variants, "c") == ["x", "y", "z"]
    assert variants_with(variants, "y") == ["a", "b"]
    assert variants_with(variants, "w") == []
