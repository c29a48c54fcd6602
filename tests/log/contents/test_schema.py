"""Schemas of components: any names make fields that protobuf takes."""

from __future__ import annotations

import re

import numpy as np
from google.protobuf import json_format
from hypothesis import given
from hypothesis import strategies as st

from cosim.log.layout import (
    blank_records,
    group_columns,
)
from cosim.log.messages import component_schema, identifiers
from tests.log.decoding import message_class

MESSAGE_HEADER = 31  # bytes before the protobuf message
NASTY = [
    "der(x)",
    "der_x",
    "x[1]",
    "x_1",
    "x1",
    "a_b",
    "aB",
    "AB",
    "1x",
    "",
    "_",
    "π",
    "θ̂",
    "class",
    "None",
    "message",
    "x.y",
    "x y",
]


names = st.lists(st.one_of(st.sampled_from(NASTY), st.text(max_size=6)), unique=True, max_size=12)


@given(names)
def test_identifiers_differ_even_without_underscores_and_case(signal_names):
    """Every name has a legal identifier of its own, also in protobuf's JSON."""
    made = identifiers(signal_names)
    assert all(re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) for name in made)
    folded = {name.replace("_", "").lower() for name in made}
    assert len(folded) == len(signal_names)


def test_legal_names_are_kept_and_the_others_stay_readable():
    """What reads well keeps its name."""
    assert identifiers(["x[0]", "x_a", "delta", "der(x)", "x_0"]) == [
        "x_0_2",
        "x_a",
        "delta",
        "der_x",
        "x_0",
    ]


@given(names)
def test_any_names_make_a_schema_that_protobuf_takes(signal_names):
    """Stock protobuf decodes the records of a channel with any names, and writes them as JSON."""
    size = len(signal_names)
    values = np.arange(1.0, size + 1)
    kind = message_class("cosim.m", component_schema("m", signal_names))
    records = blank_records(1, size, 1)
    for group, columns in group_columns(size).items():
        records[group]["value"] = values[columns]
    message = kind.FromString(records.tobytes()[MESSAGE_HEADER:])
    decoded = [getattr(message, field.name) for field in kind.DESCRIPTOR.fields]
    assert decoded == list(values)
    assert len(json_format.MessageToDict(message)) == size
