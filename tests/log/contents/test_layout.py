"""Names, schemas, records and metadata of a component's channels."""

from __future__ import annotations

import json
import re
import struct
from dataclasses import replace

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import FOOTER_SIZE as MCAP_FOOTER_SIZE
from mcap.writer import MCAP0_MAGIC

from cosim.core.signals import Channel, Interface, Signal
from cosim.errors import GraphError
from cosim.log.contents.layout import (
    blank_records,
    copy_values,
    group_columns,
    read_part,
    record_dtype,
    signals_json,
    split_channel,
)
from cosim.log.contents.messages import decode_log, encode_log
from cosim.log.contents.metadata import add_checksum, decode_design, encode_design, verify_checksum
from cosim.log.contents.schema import component_schema, identifiers
from cosim.log.mcap_file.records import FOOTER_SIZE, MAGIC
from cosim.units import BASE, BaseUnit
from tests.log.recordings import layout, plan, same_bits

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
MESSAGE_HEADER = 31  # bytes before the protobuf message
names = st.lists(st.one_of(st.sampled_from(NASTY), st.text(max_size=6)), unique=True, max_size=12)


def message_class(name, data):
    """Return the message class that a FileDescriptorSet describes, as a stock decoder does."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(data).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


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


@pytest.mark.parametrize("size", [0, 1, 15, 16, 2047, 2048, 4096])
def test_records_are_protobuf_at_every_width_of_tags(size):
    """Stock protobuf finds the values, and they come back from the records bit for bit."""
    values = np.random.default_rng(1).normal(size=(3, size))
    records = blank_records(7, size, 3)
    for group, columns in group_columns(size).items():
        records[group]["value"] = values[:, columns]
    fields = [f"v{i}" for i in range(size)]
    kind = message_class("cosim.m", component_schema("m", fields))
    data = records[1].tobytes()
    assert struct.unpack_from("<BQH", data) == (5, len(data) - 9, 7)
    message = kind.FromString(data[MESSAGE_HEADER:])
    assert [getattr(message, field) for field in fields] == list(values[1])
    copied = np.empty_like(values)
    copy_values(records, copied)
    assert same_bits(copied, values)


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
    name=st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=8),
    size=st.integers(1, 5000),
    unit=st.none() | st.text(max_size=3),
    variability=st.sampled_from(["continuous", "discrete"]),
    optional=st.booleans(),
    type=st.sampled_from(["real", "integer", "boolean"]),
    role=st.sampled_from(["input", "output", "state", "estimate"]),
    base=st.none() | bases,
    connection=st.sampled_from(["required", "optional", "forbidden"]),
    first=st.integers(0, 9),
)
numbers = st.floats(allow_nan=False)
signals = plain | st.builds(
    lambda signal, x: replace(signal, start=(x,) * signal.size), plain, numbers
)


@st.composite
def channels(draw):
    """Draw any component with at least one signal."""
    lists = st.lists(signals, min_size=1, max_size=5, unique_by=lambda signal: signal.name)
    drawn = tuple(draw(lists))
    cut = draw(st.integers(0, len(drawn)))
    inputs = drawn[:cut]
    outputs = drawn[cut:]
    input_names = st.just(())
    if inputs:
        input_names = st.lists(st.sampled_from([s.name for s in inputs]), unique=True).map(tuple)
    dependencies = st.fixed_dictionaries(
        {}, optional={signal.name: st.none() | input_names for signal in outputs}
    )
    interface = Interface(inputs, outputs, draw(dependencies), draw(dependencies))
    name = draw(st.text(st.characters(exclude_characters="."), min_size=1, max_size=5))
    start = draw(st.integers(0, 9))
    period = draw(st.integers(1, 1000))
    return Channel(name, interface, start, period)


@given(channels(), st.integers(1, 10**12))
def test_metadata_describe_the_whole_component(channel, step_ns):
    """Every part of a component knows the whole component, and the parts tile its row."""
    elements = []
    for part in split_channel(channel, kind="some", step_ns=step_ns):
        back = read_part(part.metadata)
        assert (back.channel, back.kind, back.step_ns) == (channel, "some", step_ns)
        assert record_dtype(back.size).itemsize <= MESSAGE_HEADER + 11 * 4096
        elements += back.elements
    declared = []
    for signal in channel.signals:
        declared += signal.elements
    assert elements == declared


def test_a_declaration_has_defaults_only_of_the_first_fields():
    """The text that the hash covers stays what the first logs have, until a new field is used."""
    plain = '"name":"u","size":1,"unit":null,"variability":"continuous","optional":false,'
    plain += '"type":"real","role":"output"'
    assert signals_json(Interface((Signal("u"),))) == f'[{{"causality":"input",{plain}}}]'
    driven = Signal("u", start=(1.0,), connection="optional", first=1)
    added = '"start":[1.0],"connection":"optional","first":1'
    assert signals_json(Interface((driven,))) == f'[{{"causality":"input",{plain},{added}}}]'


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("name", ""),
        ("size", 0),
        ("size", 2**63),
        ("unit", 5),
        ("variability", 5),
        ("optional", 1),
        ("type", "text"),
        ("role", None),
        ("base", {"exponents": [1], "factor": 1.0, "offset": 0.0}),
        ("base", {"exponents": [0.5] * len(BASE), "factor": 1.0, "offset": 0.0}),
        ("start", {}),
        ("start", ["1"]),
        ("start", [True]),
        ("connection", 5),
        ("first", "x"),
        ("first", -1),
    ],
)
def test_a_declaration_of_anything_else_is_refused(name, value):
    """Every field that is read has the type and one of the values that a signal may have."""
    (part,) = split_channel(layout()["plant"], kind="", step_ns=1)
    items = part.metadata
    signals = json.loads(items["cosim.signals"])
    signals[-1][name] = value
    items["cosim.signals"] = json.dumps(signals)
    items.pop("cosim.sha256")
    with pytest.raises((GraphError, ValueError), match=rf"{name}|exponents"):
        read_part(add_checksum("cosim.channel", items))


def test_a_changed_channel_is_noticed():
    """Metadata of a channel carries a checksum."""
    (part,) = split_channel(layout()["plant"], kind="", step_ns=1)
    with pytest.raises(ValueError, match="damaged"):
        read_part({**part.metadata, "cosim.start": "1"})


def test_checksums_cover_name_keys_and_values_of_our_maps_only():
    """Whatever changes in a map of ours is noticed; a map of another tool passes."""
    checked = add_checksum("cosim.run", {"a": "1"})
    assert verify_checksum("cosim.run", checked) == {"a": "1"}
    assert verify_checksum("theirs", {"a": "1"}) == {"a": "1"}
    wrong = {
        "cosim.rum": checked,
        "theirs": checked,
        "cosim.run": {**checked, "a": "2"},
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
    for name, array in design.items():
        assert same_bits(back[name], array)


def test_log_messages_survive():
    """Level, source and text come back from a foxglove.Log."""
    message = ("warning", "plant", "hei\nße")
    assert decode_log(encode_log(1_500_000_000, *message)) == message


def test_magic_and_footer_are_those_of_mcap():
    """They stand here, as the modules of mcap that have them load every compressor."""
    assert MAGIC == MCAP0_MAGIC
    assert FOOTER_SIZE == MCAP_FOOTER_SIZE
