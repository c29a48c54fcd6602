"""Names, schemas, records and metadata of a component's channels."""

from __future__ import annotations

import re
import struct
from dataclasses import replace

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory
from hypothesis import given
from hypothesis import strategies as st

from cosim.core.signals import Channel, Interface, Signal
from cosim.log.layout import (
    blank_records,
    copy_values,
    group_columns,
    read_part,
    record_dtype,
    split_channel,
)
from cosim.log.metadata import add_checksum, decode_design, encode_design, verify_checksum
from cosim.log.schema import component_schema, decode_log, encode_log, identifiers
from cosim.units import BASE, BaseUnit

from .recordings import layout, plan, same_bits

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


def message_class(name, data):
    """Make the message class that a FileDescriptorSet describes, as a stock decoder does."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(data).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


@given(names)
def test_identifiers_differ_even_without_underscores_and_case(found):
    """Every name gets a legal identifier of its own, also in protobuf's JSON."""
    made = identifiers(found)
    assert all(re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) for name in made)
    assert len({name.replace("_", "").lower() for name in made}) == len(found)


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
def test_any_names_make_a_schema_that_protobuf_takes(found):
    """Stock protobuf decodes the records of a channel with any names, and writes them as JSON."""
    kind = message_class("cosim.m", component_schema("m", found))
    records = blank_records(1, len(found), 1)
    for name, columns in group_columns(len(found)).items():
        records[name]["value"] = np.arange(1.0, len(found) + 1)[columns]
    message = kind.FromString(records.tobytes()[31:])
    assert [getattr(message, field.name) for field in kind.DESCRIPTOR.fields] == list(
        range(1, len(found) + 1)
    )
    assert len(json_format.MessageToDict(message)) == len(found)


@pytest.mark.parametrize("size", [0, 1, 15, 16, 2047, 2048, 4096])
def test_records_are_protobuf_at_every_width_of_tags(size):
    """Stock protobuf finds the values, and they come back from the records bit for bit."""
    values = np.random.default_rng(1).normal(size=(3, size))
    records = blank_records(7, size, 3)
    for name, columns in group_columns(size).items():
        records[name]["value"] = values[:, columns]
    kind = message_class("cosim.m", component_schema("m", [f"v{i}" for i in range(size)]))
    data = records[1].tobytes()
    assert struct.unpack_from("<BQH", data) == (5, len(data) - 9, 7)
    message = kind.FromString(data[31:])
    assert [getattr(message, f"v{i}") for i in range(size)] == list(values[1])
    back = np.empty_like(values)
    copy_values(records, back)
    assert same_bits(back, values)


def test_records_with_other_fields_are_refused():
    """Messages of the right size are checked for their tags too."""
    records = blank_records(1, 3, 2)
    records["short"]["tag"][1, 0, 0] = 0x11
    with pytest.raises(ValueError, match="other fields than declared"):
        copy_values(records, np.empty((2, 3)))


bases = st.builds(
    BaseUnit,
    st.tuples(*[st.integers(-3, 3)] * len(BASE)),
    st.floats(1e-9, 1e9),
    st.floats(-1e3, 1e3),
)
plain = st.builds(
    Signal,
    name=st.text(st.characters(exclude_categories=["Cs"]), max_size=8),
    size=st.integers(1, 5000),
    unit=st.none() | st.text(max_size=3),
    variability=st.sampled_from(["continuous", "discrete"]),
    optional=st.booleans(),
    kind=st.sampled_from(["real", "integer", "boolean"]),
    role=st.sampled_from(["input", "output", "state", "estimate"]),
    base=st.none() | bases,
)
numbers = st.floats(-1e9, 1e9)
signals = plain | st.builds(
    lambda signal, x: replace(signal, start=(x,) * signal.size), plain, numbers
)


@st.composite
def channels(draw):
    """Make any component with at least one signal."""
    found = tuple(
        draw(st.lists(signals, min_size=1, max_size=5, unique_by=lambda signal: signal.name))
    )
    cut = draw(st.integers(0, len(found)))
    inputs, outputs = found[:cut], found[cut:]
    feeds = (
        st.lists(st.sampled_from(inputs), unique=True).map(lambda some: tuple(s.name for s in some))
        if inputs
        else st.just(())
    )
    known = st.fixed_dictionaries(
        {}, optional={signal.name: st.none() | feeds for signal in outputs}
    )
    interface = Interface(inputs, outputs, draw(known), draw(known))
    return Channel(
        draw(st.text(max_size=5)), interface, draw(st.integers(0, 9)), draw(st.integers(1, 1000))
    )


@given(channels(), st.integers(1, 10**12))
def test_metadata_gives_the_component_back(channel, step_ns):
    """Every part of a component knows the whole component, and the parts tile its row."""
    parts = [
        read_part(part.metadata) for part in split_channel(channel, kind="some", step_ns=step_ns)
    ]
    assert all(
        part.channel == channel and part.kind == "some" and part.step_ns == step_ns
        for part in parts
    )
    elements = [element for part in parts for element in part.elements]
    assert elements == [element for signal in channel.signals for element in signal.elements]
    assert all(record_dtype(part.size).itemsize <= 31 + 11 * 4096 for part in parts)


def test_a_changed_channel_is_noticed():
    """Metadata of a channel carries a checksum."""
    (part,) = split_channel(layout()["plant"], kind="", step_ns=1)
    with pytest.raises(ValueError, match="damaged"):
        read_part({**part.metadata, "cosim.start": "1"})


def test_seals_cover_name_keys_and_values_and_leave_others_alone():
    """Whatever changes in a map of ours is noticed; a map of another tool passes."""
    sealed = add_checksum("cosim.run", {"a": "1"})
    assert verify_checksum("cosim.run", sealed) == {"a": "1"}
    assert verify_checksum("theirs", {"a": "1"}) == {"a": "1"}
    wrong = {
        "cosim.rum": sealed,
        "theirs": sealed,
        "cosim.run": {**sealed, "a": "2"},
        "cosim.env": {"a": "1"},
    }
    for name, items in wrong.items():
        with pytest.raises(ValueError, match=f"{name!r} is damaged"):
            verify_checksum(name, items)


def test_designs_keep_every_bit():
    """Shape and bits of every array survive the JSON."""
    design = plan().designs["plant"]
    back = decode_design(encode_design(design))
    assert list(back) == list(design)
    assert all(same_bits(back[name], design[name]) for name in design)


def test_log_messages_survive():
    """A foxglove.Log gives back what was said."""
    assert decode_log(encode_log(1_500_000_000, "warning", "plant", "hei\nße")) == (
        "warning",
        "plant",
        "hei\nße",
    )
